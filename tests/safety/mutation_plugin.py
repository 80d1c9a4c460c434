"""Pytest plugin that takes one safeguard out, named by the environment.

``SAFETY_MUTATION`` is ``rule:<name>`` for a monitor, ``gate:<command>`` for a check of the
command gate, or a name in :data:`OTHERS`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import Any

from crazyarena.runner.contestant.compute import Budget
from crazyarena.safety import (
    estop_socket,
    gate,
    guard,
    heading,
    preflight,
    steerable,
    tipping,
    watchdog,
)
from crazyarena.safety.admission import (
    attitudes,
    memory,
    parameters,
    plans,
    room,
    setpoints,
    trajectories,
)
from crazyarena.safety.admission.fitters import FITTERS
from crazyarena.safety.admission.memory import VehicleMemory
from crazyarena.safety.admission.room import Room
from crazyarena.safety.admission.trajectory_memory import TrajectoryMemory
from crazyarena.safety.attitude_path import AttitudeLoss
from crazyarena.safety.estop import EmergencyStop
from crazyarena.safety.flight_model import FlightModel
from crazyarena.safety.gate import CommandGate
from crazyarena.safety.heading import HeadingWatch, Turned
from crazyarena.safety.link_loss import LinkLoss
from crazyarena.safety.lookout import Lookout
from crazyarena.safety.pairing import Pairing
from crazyarena.safety.pilot import SafePilot
from crazyarena.safety.planner import Planner
from crazyarena.safety.take_off import TakeOffCheck


def rules() -> list[str]:
    return [rule.name for rule in guard.RULES]


def checks() -> list[str]:
    return [command.__name__ for command in FITTERS]


def _without(owner: Any, name: str, value: Any) -> Callable[[], None]:
    return lambda: setattr(owner, name, value)


def _no_slots() -> None:
    follow = Planner.follow

    def forgetful(self: Planner, plan: Any, now: float, landing: bool = False, slots: Any = ()):
        follow(self, plan, now, landing)

    Planner.follow = forgetful  # type: ignore[method-assign]


def _of_any_moment(self: Pairing, told: Any) -> Any:
    while self._poses:
        yield *self._poses.popleft(), tuple(told.state.angular_velocity)


def _generous(self: Budget, *args: Any, **limits: Any) -> None:
    for name in ("step", "episode", "trial"):
        object.__setattr__(self, name, 5.0)


def _deaf_to_avoidance() -> None:
    sent = VehicleMemory.sent

    def deaf(self: VehicleMemory, command: Any, now: float) -> None:
        sent(self, command, now)
        self.avoiding = False

    VehicleMemory.sent = deaf  # type: ignore[method-assign]


# What is taken out, and the tests that must notice.
OTHERS: dict[str, tuple[Callable[[], None], str]] = {
    # What would be if the link were lost.
    "link_loss": (_without(LinkLoss, "on", False), "test_gate.py"),
    # A pilot that does nothing.
    "pilot": (_without(SafePilot, "update", lambda self, action, obs: []), "test_watchdog.py"),
    # Relative goals are added to where the vehicle is.
    "planner": (_without(Planner, "origin", lambda self, now, seen: seen), "test_gate.py"),
    # Memory that is being flown may be overwritten.
    "slots": (_no_slots, "test_gate.py"),
    # An id is flown, whatever its memory holds.
    "overwritten": (
        _without(TrajectoryMemory, "overwritten_by", lambda self, ident: None),
        "test_gate.py",
    ),
    # Only ends are looked at, not the way to them.
    "way": (_without(Room, "clear_share", lambda self, begin, end, least: 1.0), "test_gate.py"),
    "plan": (_without(plans, "_excess", lambda room, plan, origin: 0.0), "test_gate.py"),
    "near_its_plan": (_without(Room, "near_its_plan", lambda self, *args: None), "test_gate.py"),
    # A plan after a stream is not flown.
    "relax": (_without(CommandGate, "_word_before", lambda self, *args: None), "test_gate.py"),
    # Commands for another group are taken for heard, also those that end a stream or stop.
    "groups": (_without(VehicleMemory, "addressed", lambda self, group: True), "test_release.py"),
    "mask_read": (_without(gate, "GROUP_MASK", "nobodys.own"), "test_release.py"),
    "mask_written": (_without(memory, "is_group_mask", lambda name: False), "test_release.py"),
    # A stream that ends on the ground is missed as one in the air.
    "low": (_without(watchdog.Watchdog, "_is_low", lambda *args: False), "test_release.py"),
    # Velocities for a controller that follows none.
    "velocity": (_without(setpoints, "MELLINGER", None), "test_release.py"),
    # Landings that end in the air, or sooner than a vehicle can follow.
    "falls": (_without(plans, "_FALLS", math.inf), "test_release.py"),
    "sinks": (_without(plans, "_SINKS", math.inf), "test_release.py"),
    "sinking": (_without(plans, "_SINKING", math.inf), "test_release.py"),
    "range": (_without(parameters, "_TUNED", {}), "test_gate.py"),
    "controller": (
        _without(parameters, "_refuse_unknown_braking", lambda *args: None),
        "test_gate.py",
    ),
    "jitter": (
        _without(watchdog, "repeats", lambda last, pose, flying: False),
        "test_watchdog.py",
    ),
    "old_poses": (_without(gate, "repeats", lambda last, pose, flying: False), "test_gate.py"),
    "slow_cameras": (
        _without(watchdog.Watchdog, "_grounded", lambda self: None),
        "test_watchdog.py",
    ),
    "neighbours": (_without(watchdog, "nearest", lambda *args: None), "test_watchdog.py"),
    "heading": (
        _without(HeadingWatch, "update", lambda self, *args: self.now),
        "test_heading.py",
    ),
    # Poses are compared with the rates that were told last, of whatever moment.
    "pairing": (_without(Pairing, "told", _of_any_moment), "test_pairing.py"),
    # What turns much within half a second tells nothing.
    "wild": (_without(heading, "_WILD", 0.3), "test_heading.py"),
    "nudge": (_without(TakeOffCheck, "nudged", lambda self, pose, *args: pose), "test_nudge.py"),
    "nudges_on": (_without(TakeOffCheck, "_needed", lambda self, now: True), "test_nudge.py"),
    # A turned body is told before anybody knows how far it is turned.
    "known": (_without(Turned, "known", True), "test_monitors.py"),
    "lookout": (_without(Lookout, "_judge", lambda self, *args: None), "test_lookout.py"),
    # Attitude setpoints: how far out a lost link carries, falls, headings that jump, and what is
    # asked for before it shows.
    "attitude_loss": (
        _without(AttitudeLoss, "held_back", lambda self, *args: None),
        "test_attitudes.py",
    ),
    "kept_up": (
        _without(attitudes, "_kept_up", lambda room, memory, asked, reasons: asked),
        "test_attitudes.py",
    ),
    "turned": (
        _without(attitudes, "_turned", lambda room, yaw, *args: yaw),
        "test_attitudes.py",
    ),
    "pushed": (_without(CommandGate, "pushed", lambda self, vehicle: None), "test_attitudes.py"),
    # The stop socket: nobody puts it back, strangers are heeded, hung programs are waited for.
    "mend": (
        _without(estop_socket._Door, "mend", lambda self: None),
        "safety/test_estop_socket.py::test_a_socket_that_was_removed_is_put_back",
    ),
    "strangers_stop": (
        _without(estop_socket, "sender_of", lambda extra: os.getuid() + 1),
        "test_estop_socket.py",
    ),
    "confirmed": (
        _without(EmergencyStop, "outcome", lambda self, final=False: "stopped"),
        "test_estop_socket.py",
    ),
    # Poses that repeat are not called so.
    "frozen": (_without(CommandGate, "frozen", lambda self: []), "test_gate.py"),
    # Whoever skims along the floor is taken for one that stands.
    "skims": (
        _without(watchdog, "_SKIMS", math.inf),
        "runner/campaign/test_attitude_faults.py::test_skimming_along_the_floor_is_flying",
    ),
    # Collision avoidance on board goes on under the watchdog.
    "avoiding": (_deaf_to_avoidance, "test_gate.py"),
    # A vehicle that tips may be sent up and turned with all it has.
    "upright": (_without(Room, "upright", lambda self, point, *args: point), "test_gate.py"),
    "facing": (_without(Room, "facing", lambda self, yaw, *args: yaw), "test_gate.py"),
    "turning": (_without(Room, "turning", lambda self, rate, *args: rate), "test_gate.py"),
    # Anybody may be spun about the vertical: by a stream, a plan or a trajectory.
    "spins": (_without(room, "_SPINS", math.inf), "test_turning.py"),
    "turned_in": (
        _without(Room, "turned_in", lambda self, yaw, relative, vehicle, duration, *_: duration),
        "test_turning.py",
    ),
    "refuse_spins": (
        _without(trajectories, "_refuse_spins", lambda *args: None),
        "test_turning.py",
    ),
    "jumps": (_without(trajectories, "_JUMPS", math.inf), "test_turning.py"),
    # A place far below asks for no lift.
    "carried": (_without(Room, "carried", lambda self, point, *args: point), "test_turning.py"),
    # The watchdog's own hold asks for all thrust, or for none.
    "steerable": (
        _without(SafePilot, "_steerable", lambda self, setpoint, obs: setpoint),
        "test_pilot.py",
    ),
    # Two that were taken land at the same time, one above the other.
    "step_aside": (_without(SafePilot, "_step_aside", lambda self, obs: None), "test_pilot.py"),
    "floats": (
        _without(FlightModel, "floats", property(lambda self: 0.0)),
        "test_steerable.py",
    ),
    "calm_lift": (_without(steerable, "CALM_LIFT", 0.0), "test_pilot.py"),
    # Four pieces of memory that the vehicle does not have.
    "beyond_memory": (
        _without(trajectories, "beyond_memory", lambda *args: None),
        "test_gate.py",
    ),
    "level_off": (
        _without(SafePilot, "_level_off", lambda self, height, climb: climb / 2.5),
        "test_pilot.py",
    ),
    # Plans for more than motors and attitude have.
    "overtaxed": (_without(plans, "overtaxed", lambda *args: None), "test_gate.py"),
    "overtaxed_upload": (_without(trajectories, "overtaxed", lambda *args: None), "test_gate.py"),
    "in_sight": (
        _without(Room, "_in_sight", lambda self, where, point, reasons: point),
        "test_gate.py",
    ),
    # What a contestant may use up.
    "budget": (
        _without(Budget, "__init__", _generous),
        "runner/contestant/test_hostile.py::test_a_contestant_may_not_use_up_everybodys_day",
    ),
    "nose": (_without(tipping, "nose_between", lambda own, body: 0.0), "test_preflight.py"),
    "axes": (_without(preflight, "explain_axes", lambda *args: None), "test_preflight.py"),
    "lean": (_without(preflight, "_LEANS", math.inf), "test_preflight.py"),
    "frame_rate": (
        _without(
            preflight,
            "MACHINE_CHECKS",
            tuple(c for c in preflight.MACHINE_CHECKS if c is not preflight.check_cameras),
        ),
        "test_preflight.py",
    ),
}


def pytest_configure(config: Any) -> None:
    mutation = os.environ.get("SAFETY_MUTATION", "")
    kind, _, name = mutation.partition(":")
    if kind == "rule":
        assert name in rules()
        guard.RULES = tuple(rule for rule in guard.RULES if rule.name != name)
    elif kind == "gate":
        assert name in checks()
        for command in list(FITTERS):
            if command.__name__ == name:
                del FITTERS[command]
    elif kind:
        OTHERS[kind][0]()
