"""Contestants that fly by attitude and go wrong."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.runner.campaign.strikes.directions import outwards
from crazyarena.runner.campaign.strikes.struck import Struck
from crazyarena.safety.attitude_path import FULL, tilt_of

_HOVER = 0.62  # share of full thrust, about
_Policy = Callable[[float], tuple[float, float, float, float]]


def _asked(roll: float, pitch: float, yaw: float, share: float) -> c.RollPitchYawThrust:
    return c.RollPitchYawThrust(roll, pitch, yaw, int(min(max(share, 0.0), 1.0) * FULL))


def tilted(f: Struck) -> None:
    """Lean as far as goes, towards a wall, at full thrust."""
    roll, pitch = _towards(outwards(f), 1.2)
    f.contestant = lambda now: _asked(roll, pitch, 0.0, 1.0)


def up(f: Struck) -> None:
    """Straight up at full thrust."""
    f.contestant = lambda now: _asked(0.0, 0.0, 0.0, 1.0)


def fall(f: Struck) -> None:
    """Let go of the thrust."""
    f.contestant = lambda now: _asked(0.0, 0.0, 0.0, 0.0)


def spin(f: Struck) -> None:
    """Ask for the opposite heading all the time."""
    f.contestant = lambda now: _asked(0.0, 0.0, math.pi * (int(now * 10) % 2), _HOVER)


def flip(f: Struck) -> None:
    """Lean from one side to the other."""
    period = f.rng.uniform(0.1, 0.6)
    f.contestant = lambda now: _asked(1.4 if (now // period) % 2 else -1.4, 0.0, 0.0, 0.8)


def _towards(direction: np.ndarray, tilt: float) -> tuple[float, float]:
    side = math.sin(tilt) * direction[:2] / max(float(np.hypot(*direction[:2])), 1e-6)
    return tilt_of(float(side[0]), float(side[1]), 0.0, 1.0)


def hostile(f: Struck) -> None:
    """One bad idea after the other, each for a while."""
    rng = f.rng
    until, policy = -math.inf, _fixed(0.0, 0.0, 0.0, _HOVER)

    def fly(now: float) -> c.Command:
        nonlocal until, policy
        if now >= until:
            until = now + rng.uniform(0.05, 1.5)
            policy = rng.choice(_IDEAS)(f)
        roll, pitch, yaw, share = policy(now)
        if f.seed % 5 == 4:  # some with a rate of yaw
            return c.Attitude(roll, pitch, 3.0 * yaw, int(min(max(share, 0.0), 1.0) * FULL))
        return _asked(roll, pitch, yaw, share)

    f.contestant = fly


def _fixed(roll: float, pitch: float, yaw: float, share: float) -> _Policy:
    return lambda now: (roll, pitch, yaw, share)


def _anything(f: Struck) -> _Policy:
    r = f.rng
    return _fixed(
        r.uniform(-2.0, 2.0), r.uniform(-2.0, 2.0), r.uniform(-7.0, 7.0), r.uniform(0.0, 1.0)
    )


def _noise(f: Struck) -> _Policy:
    r = f.rng
    return lambda now: (r.gauss(0, 0.8), r.gauss(0, 0.8), r.gauss(0, 2.0), r.uniform(0.2, 1.0))


def _dash(f: Struck) -> _Policy:
    """To the nearest wall, as fast as goes at a height."""
    roll, pitch = _towards(outwards(f), f.rng.uniform(0.3, 1.2))
    lean = max(0.5, math.cos(roll) * math.cos(pitch))
    height = float(f.position()[2])
    return lambda now: (
        roll, pitch, 0.0, _HOVER / lean + 0.6 * (height - float(f.position()[2])),
    )  # fmt: skip


def _corner(f: Struck) -> _Policy:
    """To a corner of the ceiling."""
    low, high = f.fence.bounds
    away = np.array([*(high[:2] if f.rng.random() < 0.5 else low[:2]), high[2]]) - f.position()
    roll, pitch = _towards(away, f.rng.uniform(0.2, 0.9))
    return _fixed(roll, pitch, 0.0, 1.0)


def _climb(f: Struck) -> _Policy:
    return _fixed(0.0, 0.0, 0.0, f.rng.uniform(0.7, 1.0))


def _drop(f: Struck) -> _Policy:
    """Fall, and catch it with everything."""
    begin: list[float] = []
    fall = f.rng.uniform(0.1, 0.4)
    roll, pitch = _towards(outwards(f), f.rng.uniform(0.0, 1.0))

    def policy(now: float) -> tuple[float, float, float, float]:
        begin.append(now)
        return (0.0, 0.0, 0.0, 0.0) if now - begin[0] < fall else (roll, pitch, 0.0, 1.0)

    return policy


def _swing(f: Struck) -> _Policy:
    period, tilt = f.rng.uniform(0.06, 0.6), f.rng.uniform(0.3, 1.5)
    along = f.rng.random() < 0.5
    share = f.rng.uniform(0.5, 1.0)

    def policy(now: float) -> tuple[float, float, float, float]:
        lean = tilt if (now // period) % 2 else -tilt
        return (lean, 0.0, 0.0, share) if along else (0.0, lean, 0.0, share)

    return policy


def _turning(f: Struck) -> _Policy:
    rate = f.rng.choice((-1.0, 1.0)) * f.rng.uniform(2.0, 20.0)
    roll, pitch = _towards(outwards(f), f.rng.uniform(0.0, 0.8))
    return lambda now: (roll, pitch, rate * now, 0.7)


def _inward(f: Struck) -> _Policy:
    """Back to the middle, to have room for the next."""
    roll, pitch = _towards(-outwards(f), 0.3)
    return _fixed(roll, pitch, 0.0, _HOVER)


_IDEAS = (
    _anything, _noise, _dash, _dash, _corner, _climb, _drop, _swing, _turning, _inward, _inward,
)  # fmt: skip
