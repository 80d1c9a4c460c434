"""Contestants that go wrong."""

from __future__ import annotations

import math

import numpy as np

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.runner.campaign.strikes.directions import outwards
from crazyarena.runner.campaign.strikes.struck import Struck


def outside(f: Struck) -> None:
    """Ask for a place outside at once."""
    target = f.position() + 5.0 * outwards(f)
    f.contestant = lambda now: c.FullState(target, np.zeros(3), np.zeros(3), 0.0, np.zeros(3))


def _ramp(f: Struck, direction: np.ndarray, speed: float) -> None:
    """Accelerate from the present setpoint to ``speed`` along ``direction``, and never stop."""
    start = f.setpoint
    place = np.array(start.position, dtype=float)
    velocity = np.array(start.velocity, dtype=float)
    last = f.clock.now()

    def fly(now: float) -> c.Command:
        nonlocal last
        dt, last = now - last, now
        change = speed * direction - velocity
        size = float(np.linalg.norm(change))
        push = change * min(1.0, 4.0 * dt / size) if size > 1e-9 and dt > 0 else np.zeros(3)
        velocity[:] += push
        place[:] += velocity * dt
        acceleration = push / dt if dt > 0 else np.zeros(3)
        return c.FullState(place.copy(), velocity.copy(), acceleration, 0.0, np.zeros(3))

    f.contestant = fly


def up(f: Struck) -> None:
    """Accelerate straight up."""
    _ramp(f, np.array([0.0, 0.0, 1.0]), f.rng.uniform(0.5, 2.0))


def wall(f: Struck) -> None:
    """Accelerate towards a wall."""
    _ramp(f, outwards(f), 2.0)


def wall_velocity(f: Struck) -> None:
    """Ask for a velocity towards a wall."""
    velocity = 2.0 * outwards(f)
    f.contestant = lambda now: c.VelocityWorld(velocity)


def position_step(f: Struck) -> None:
    """Ask for a place outside, by the position controller."""
    target = f.position() + 5.0 * outwards(f)
    f.contestant = lambda now: c.Position(target)


def go_to_wall(f: Struck) -> None:
    """A plan of the vehicle's own, to the fence at up to 2 m/s."""
    place = f.position()
    out = outwards(f)
    away = 0.1
    while f.fence.clearance(*(place + (away + 0.05) * out).tolist()) > 0.0:
        away += 0.05
    plan = c.GoTo(place + away * out, 0.0, max(0.5, 35.0 / 16.0 * away / 2.0))
    orders = iter((c.NotifySetpointsStop(), plan))
    f.silence_is_an_answer = True
    f.contestant = lambda now: next(orders, None)


def tilt(f: Struck) -> None:
    """Ask for an attitude and stay tilted."""
    roll, pitch = f.rng.choice(((0.4, 0.0), (-0.4, 0.0), (0.0, 0.4), (0.0, -0.4)))
    f.contestant = lambda now: c.Attitude(roll, pitch, 0.0, 42000)


def nan(f: Struck) -> None:
    """Ask for what is no number."""
    broken = np.array([math.nan, 0.0, 1.0])
    f.contestant = lambda now: c.FullState(broken, np.zeros(3), np.zeros(3), 0.0, np.zeros(3))


def silent(f: Struck) -> None:
    """Ask for nothing more."""
    f.contestant = lambda now: None


def stuck(f: Struck) -> None:
    """Ask for the same again and again."""
    last = f.setpoint
    f.contestant = lambda now: last


def oscillating(f: Struck) -> None:
    """Ask for two places in turns."""
    middle = np.array(f.setpoint.position, dtype=float)
    step = f.rng.uniform(0.3, 1.5) * outwards(f)
    period = f.rng.uniform(0.1, 0.6)

    def swing(now: float) -> c.Command:
        side = 1.0 if (now // period) % 2 else -1.0
        return c.FullState(middle + side * step, np.zeros(3), np.zeros(3), 0.0, np.zeros(3))

    f.contestant = swing
