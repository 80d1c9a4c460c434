"""Random flights of every call that a script can make, with hostile arguments, under a guard.

What the command gate lets pass must keep the vehicle inside the fence, whoever asked for it. A
flight is a list of calls drawn from a seed; it can be flown again without some of them, which is
how a flight that gets out is shrunk to the fewest calls.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from crazyarena.crazyswarm_compat import crazyswarm1, crazyswarm2
from crazyarena.crazyswarm_compat.uav_trajectory import Polynomial4D, Trajectory
from crazyarena.errors import BackendError, CommandError
from crazyarena.runner.campaign.excursion import Excursion
from crazyarena.safety.fence import Fence

_REST = 12.0  # s after the calls, for whatever flies to come down
_STEP = 0.01

ARENAS = {
    "box": "arena: {low: [-3, -3, -0.1], high: [3, 3, 2]}\n",
    # A room with a notch in one wall, which straight ways between its arms lead through.
    "notch": """
arena:
  low: [-3, -3, -0.1]
  high: [3, 3, 2]
  shapes:
  - {kind: prism, bottom: -0.1, top: 2,
     points: [[-3, -3], [3, -3], [3, 3], [0.7, 3], [0.7, -0.3], [-0.7, -0.3], [-0.7, 3], [-3, 3]]}
""",
    "people": """
arena:
  low: [-3, -3, -0.1]
  high: [3, 3, 2]
  keep_out:
  - {name: stand, people: true, margin: 0.2,
     shape: {kind: box, low: [-1, 0.8, -0.1], high: [1, 1.8, 2]}}
  - {name: desk, people: true, margin: 0.2,
     shape: {kind: cylinder, x: -1.2, y: -1.5, radius: 0.3, bottom: -0.1, top: 2}}
  - {name: pillar, shape: {kind: cylinder, x: 1.5, y: -0.5, radius: 0.1, bottom: -0.1, top: 1}}
""",
}
_STARTS = {"box": (0.0, 0.0), "notch": (-1.8, 1.0), "people": (0.0, -0.5)}
_ONE = "crazyflies:\n- {{id: 1, channel: 100, initialPosition: [{x:g}, {y:g}, 0]}}\n"
_ROBOT = """
robots:
  cf1: {{uri: "radio://0/80/2M/E7E7E7E701", initial_position: [{x:g}, {y:g}, 0], type: cf}}
robot_types: {{cf: {{connection: crazyflie}}}}
all: {{firmware_params: {{stabilizer: {{controller: {controller}}}}}}}
"""


@dataclass(frozen=True, slots=True)
class Call:
    """One call of a script, and how long it sleeps afterwards, s."""

    name: str
    args: tuple[Any, ...]
    wait: float
    swarm: bool = False

    def __str__(self) -> str:
        who = "allcfs" if self.swarm else "cf"
        return f"{who}.{self.name}{self.args!r}; sleep({self.wait:.3f})"


@dataclass(frozen=True, slots=True)
class Script:
    """A flight: where, how guarded, with which controller and API, and its calls."""

    seed: int
    arena: str
    policy: str
    controller: int
    api: int
    options: str
    calls: tuple[Call, ...]


@dataclass(slots=True)
class Outcome:
    """What became of a flight.

    Attributes
    ----------
    excursion: m beyond the hard fence, at most; negative: inside.
    into_people: m into a zone for people, at most; negative: outside of them.
    into_margin: the same with the zones' margins.
    ended: why the watchdog took the vehicle, or "".
    passed, refused: calls.
    """

    script: Script
    excursion: float = -math.inf
    into_people: float = -math.inf
    into_margin: float = -math.inf
    ended: str = ""
    passed: int = 0
    refused: int = 0
    said: list[str] = field(default_factory=list)

    @property
    def badness(self) -> float:
        """m; what flights are ranked by."""
        return max(self.excursion, self.into_people)

    def is_bad(self, allowed: float) -> bool:
        """Too far out, or among people at all."""
        return self.excursion > allowed or self.into_people > 0.0


# Drawing


class _Drawer:
    """Draws arguments."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def number(self, low: float, high: float) -> float:
        return round(float(self.rng.uniform(low, high)), 3)

    def hostile(self, usual: float) -> float:
        """Mostly a usual number, sometimes one that nobody should send."""
        odd = (0.0, -1.0, 1e-6, 1e3, -1e9, 3e38, 1e39, math.nan, math.inf, -math.inf)
        return usual if self.rng.random() < 0.96 else float(self.rng.choice(odd))

    def point(self) -> list[float]:
        """Within the arena, at its edge, or beyond."""
        reach = self.rng.choice([0.9, 1.0, 1.3])
        x, y = self.number(-3 * reach, 3 * reach), self.number(-3 * reach, 3 * reach)
        return [self.hostile(x), self.hostile(y), self.hostile(self.number(0.1, 2.1 * reach))]

    def near(self, reach: float) -> list[float]:
        return [self.number(-reach, reach) for _ in range(2)] + [self.number(-0.3, 0.3)]

    def vector(self, size: float) -> list[float]:
        return [self.hostile(self.number(-size, size)) for _ in range(3)]

    def trajectory(self) -> Trajectory:
        pieces = []
        for _ in range(int(self.rng.integers(1, 5))):
            duration = self.number(0.3, 4.0)
            axes = np.zeros((4, 8))
            kind = self.rng.random()
            if kind < 0.7:  # from rest to rest
                for axis, reach in enumerate((2.0, 2.0, 0.5)):
                    way = self.number(-reach, reach)
                    powers = duration ** np.arange(4, 8)
                    axes[axis, 4:] = np.array([35.0, -84.0, 70.0, -20.0]) * way / powers
            else:
                scale = self.number(0.1, 3.0)
                axes[:3] = self.rng.normal(0.0, scale, (3, 8)) / (1.0 + np.arange(8)) ** 2
            axes[3, 1] = self.number(-2, 2)
            pieces.append(Polynomial4D(duration, *axes))
        trajectory = Trajectory()
        trajectory.polynomials = pieces
        trajectory.duration = sum(piece.duration for piece in pieces)
        return trajectory


_PARAMETERS = [
    "ctrlMel.kp_xy",
    "ctrlMel/kd_xy",
    "ctrlMel.ki_xy",
    "ctrlMel.kp_z",
    "ctrlMel.kd_z",
    "ctrlMel.mass",
    "ctrlMel.massThrust",
    "ctrlMel.kR_xy",
    "ctrlMel.kR_z",
    "ctrlMel.kw_xy",
    "ctrlMel.kw_z",
    "ctrlMel.i_range_xy",
    "ctrlMel.kd_omega_rp",
    "posCtlPid.xKp",
    "posCtlPid/yKp",
    "posCtlPid.zKp",
    "posCtlPid.xVelMax",
    "posCtlPid.rLimit",
    "posCtlPid.thrustBase",
    "posCtlPid.thrustMin",
    "velCtlPid.vxKp",
    "velCtlPid.vzKp",
    "pid_attitude.roll_kp",
    "pid_rate.pitch_kp",
    "pid_rate.yaw_kd",
    "stabilizer.controller",
    "stabilizer/estimator",
    "stabilizer.stop",
    "kalman.resetEstimation",
    "kalman.pNAcc_xy",
    "kalman.initialX",
    "locSrv.extPosStdDev",
    "supervisor.tmblChckEn",
    "motorPowerSet.enable",
    "powerDist.idleThrust",
    "hlCommander.vtoff",
    "hlCommander.groupmask",
    "colAv.enable",
    "colAv.bboxMinX",
    "commander.enHighLevel",
    "ring.effect",
    "nobodys.own",
]
_BOOT = {
    "kp_xy": 0.4, "kd_xy": 0.2, "kp_z": 1.25, "kd_z": 0.4, "mass": 0.029, "massThrust": 132000.0,
    "kR_xy": 70000.0, "kw_xy": 20000.0, "kR_z": 60000.0, "kw_z": 12000.0, "xKp": 2.0, "yKp": 2.0,
    "zKp": 2.0, "vxKp": 25.0, "vzKp": 25.0, "roll_kp": 6.0, "pitch_kp": 250.0, "rLimit": 20.0,
    "thrustBase": 36000.0, "thrustMin": 20000.0, "xVelMax": 1.0, "kd_omega_rp": 200.0,
}  # fmt: skip


def _parameter(d: _Drawer) -> tuple[Any, ...]:
    name = str(d.rng.choice(_PARAMETERS))
    boot = _BOOT.get(name.replace("/", ".").partition(".")[2], 1.0)
    factor = d.rng.choice([0.0, 0.5, 0.8, 0.85, 1.0, 1.2, 1.25, 1.5, 3.0, -1.0, -10.0])
    return name, d.hostile(float(boot * factor))


def _hover(d: _Drawer) -> tuple[Any, ...]:
    return d.number(-2, 2), d.number(-2, 2), d.number(-3, 3), d.number(0, 2.5)


def _tilt(d: _Drawer) -> tuple[Any, ...]:
    return d.number(-30, 30), d.number(-30, 30), d.number(-99, 99), d.number(0, 65535)


def _id(d: _Drawer) -> int:
    return int(d.rng.integers(0, 4))


def _upload(d: _Drawer) -> tuple[Any, ...]:
    return _id(d), int(d.rng.integers(0, 6)), d.trajectory()


def _start(d: _Drawer) -> tuple[Any, ...]:
    reverse, relative = d.rng.random() < 0.3, d.rng.random() < 0.8
    return _id(d), d.hostile(d.number(0.4, 3)), bool(reverse), bool(relative)


# Name, weight, how its arguments are drawn, and with which API (0: both).
_CALLS: tuple[tuple[str, float, Callable[[_Drawer], tuple[Any, ...]], int], ...] = (
    ("takeoff", 4, lambda d: (d.hostile(d.number(0.2, 2.5)), d.hostile(d.number(0.3, 3))), 0),
    ("land", 2, lambda d: (d.hostile(d.number(-0.2, 1)), d.hostile(d.number(0.3, 3))), 0),
    ("goTo", 12, lambda d: (d.point(), d.number(-4, 4), d.hostile(d.number(0, 4))), 0),
    ("relative", 8, lambda d: (d.near(2.0), d.number(-4, 4), d.hostile(d.number(0, 3))), 0),
    ("stop", 0.4, lambda d: (), 1),
    ("emergency", 0.15, lambda d: (), 2),
    ("fullState", 6, lambda d: (d.number(0.1, 2.0), d.point(), d.vector(3), d.vector(9)), 0),
    ("cmdPosition", 5, lambda d: (d.point(), d.number(-4, 4)), 0),
    ("cmdVelocityWorld", 5, lambda d: (d.vector(2.5), d.number(-3, 3)), 1),
    ("cmdHover", 5, _hover, 2),
    ("cmdVel", 1, _tilt, 1),
    ("cmdStop", 0.3, lambda d: (), 1),
    ("notifySetpointsStop", 4, lambda d: (), 0),
    ("uploadTrajectory", 6, _upload, 0),
    ("startTrajectory", 8, _start, 0),
    ("setParam", 8, _parameter, 0),
    ("setGroupMask", 1, lambda d: (_id(d),), 0),
    ("setLEDColor", 0.5, lambda d: (1.0, d.hostile(0.5), 0.0), 1),
    ("enableCollisionAvoidance", 1, lambda d: (d.point(), d.point()), 1),
    ("arm", 0.3, lambda d: (bool(d.rng.random() < 0.8),), 2),
)
_BROADCAST = ("takeoff", "land", "goTo", "startTrajectory")
_STREAMS = ("cmdPosition", "cmdVelocityWorld", "cmdHover", "cmdVel")


def draw_script(seed: int, policy: str | None = None) -> Script:
    """The flight of a seed."""
    rng = np.random.default_rng(seed)
    arena = str(rng.choice(list(ARENAS)))
    d = _Drawer(rng)
    api = int(rng.integers(1, 3))
    chosen = str(rng.choice(["clamp", "refuse"]))
    controller = int(rng.integers(1, 3)) if api == 2 else 2
    options = "" if rng.random() < 0.7 else ",tune_in_flight=true"
    known = [row for row in _CALLS if row[3] in (0, api)]
    weights = np.array([row[1] for row in known])
    calls = []
    for _ in range(int(rng.integers(0, 3))):
        calls.append(Call("setParam", _parameter(d), 0.0))
    calls.append(Call("takeoff", (d.number(0.4, 1.6), d.number(1.0, 2.5)), d.number(0.2, 3.5)))
    for _ in range(int(rng.integers(4, 14))):
        name, _weight, draw, _api = known[rng.choice(len(known), p=weights / weights.sum())]
        args = draw(d)
        wait = float(rng.choice([0.0, d.number(0, 0.2), d.number(0, 1.0), d.number(0.5, 3.5)]))
        swarm = name in _BROADCAST and rng.random() < 0.15
        if name in _STREAMS:
            times = int(rng.integers(1, 40))
            calls += [Call(name, args, d.number(0.01, 0.1)) for _ in range(times)]
            if rng.random() < 0.6:  # a stream that is not followed up is soon taken
                calls.append(Call("notifySetpointsStop", (), d.number(0, 0.2)))
                calls.append(Call("goTo", (d.point(), 0.0, d.number(0, 4)), d.number(0, 3)))
        else:
            calls.append(Call(name, args, wait, swarm))
    return Script(seed, arena, policy or chosen, controller, api, options, tuple(calls))


# Flying


class _Watch:
    """How far out the vehicle truly gets."""

    def __init__(self, fence: Fence, outcome: Outcome) -> None:
        self._fence = fence
        self._outcome = outcome
        self._excursion = Excursion(fence)

    def see(self, state: Any, off: bool) -> None:
        self._excursion.see(state, off)
        self._outcome.excursion = self._excursion.worst
        x, y, z = state.position.tolist()
        for zone in self._fence.people_zones:
            distance = zone.distance(x, y, z)
            self._outcome.into_margin = max(self._outcome.into_margin, -distance)
            self._outcome.into_people = max(self._outcome.into_people, -distance - zone.margin)


def _head_for(cf: Any, sleep: Callable[[float], None], args: tuple[Any, ...]) -> None:
    """A stream of full states that heads for a place, for so long."""
    seconds, place, velocity, acceleration = args
    begin = np.array(cf._state().position, dtype=float)
    for k in range(int(seconds * 30)):
        share = min(1.0, (k + 1) / (seconds * 30))
        with contextlib.suppress(CommandError):
            at = begin + share * (np.array(place) - begin)
            cf.cmdFullState(at.tolist(), velocity, acceleration, 0.0, [0.0, 0.0, 0.0])
        sleep(1.0 / 30.0)


def _make(cf: Any, allcfs: Any, sleep: Callable[[float], None], call: Call) -> None:
    if call.name == "fullState":
        _head_for(cf, sleep, call.args)
    elif call.name == "relative":
        cf.goTo(*call.args, relative=True)
    elif call.name == "enableCollisionAvoidance":
        low, high = call.args
        cf.enableCollisionAvoidance([], [0.3, 0.3, 0.9], bboxMin=low, bboxMax=high)
    elif call.swarm and call.name == "startTrajectory":
        allcfs.startTrajectory(call.args[0], timescale=call.args[1], reverse=call.args[2])
    else:
        getattr(allcfs if call.swarm or call.name == "emergency" else cf, call.name)(*call.args)


def fly(script: Script) -> Outcome:
    """Fly a script in simulation, under its guard."""
    outcome = Outcome(script)
    x, y = _STARTS[script.arena]
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        arena = Path(folder) / "arena.yaml"
        arena.write_text(ARENAS[script.arena])
        api, text = (crazyswarm1, _ONE) if script.api == 1 else (crazyswarm2, _ROBOT)
        guard = f"{arena},policy={script.policy},seed={script.seed}{script.options}"
        swarm = api.Crazyswarm(
            crazyflies_yaml=text.format(x=x, y=y, controller=script.controller),
            args=["--sim", "--vis", "null", "--guard", guard],
        )
        try:
            _fly(script, swarm, outcome)
        finally:
            swarm.allcfs.close()
    return outcome


def _fly(script: Script, swarm: Any, outcome: Outcome) -> None:
    guard, sleep = swarm.allcfs.guard, swarm.timeHelper.sleep
    fleet, clock = guard._link._fleet, guard._clock
    watch = _Watch(guard.fence, outcome)
    undo = clock.on_advance(
        lambda now: watch.see(fleet.true_state(0), not fleet.rows(0).motors.any())
    )
    cf = swarm.allcfs.crazyflies[0]
    try:
        for call in script.calls:
            try:
                _make(cf, swarm.allcfs, sleep, call)
                outcome.passed += 1
            except (CommandError, ArithmeticError, TypeError, ValueError, KeyError) as error:
                outcome.refused += 1
                outcome.said.append(f"{call.name}: {error}")
            if call.wait:
                sleep(call.wait)
        sleep(2.0)
    except (BackendError, AssertionError) as error:  # whatever a script dies of
        outcome.ended = str(error)
    end = clock.now() + _REST
    with contextlib.suppress(BackendError, CommandError):
        guard.finish()
    while clock.now() < end and fleet.rows(0).motors.any():
        clock.sleep_until(clock.now() + _STEP)
    settle = clock.now() + 1.5
    while clock.now() < settle:
        clock.sleep_until(clock.now() + _STEP)
    undo()


# Shrinking


def shrink(script: Script, bad: Callable[[Outcome], bool]) -> Script:
    """The script without whatever it does not need to be bad (delta debugging, Zeller 1999)."""
    parts = 2
    calls: Sequence[Call] = script.calls
    while len(calls) > 1:
        size = math.ceil(len(calls) / parts)
        for begin in range(0, len(calls), size):
            fewer = tuple(calls[:begin]) + tuple(calls[begin + size :])
            if fewer and bad(fly(replace(script, calls=fewer))):
                calls, parts = fewer, max(parts - 1, 2)
                break
        else:
            if size == 1:
                break
            parts = min(2 * parts, len(calls))
    return replace(script, calls=tuple(calls))
