"""Why an episode ended, in one line that a contestant can act on."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from crazyarena.levels.schema import Level
from crazyarena.runner.judging.referee import (
    COLLISION,
    CONSTRAINT_VIOLATION,
    MAX_EPISODE_DURATION,
    TUMBLED,
    Event,
)
from crazyarena.runner.judging.result import CONTROLLER_TIMEOUT
from crazyarena.sim_backend.physics.sizes import (
    BEAM_OFFSET,
    GATE_CENTRE_Z,
)
from crazyarena.sim_backend.trace import TR_POS, TR_TIME, TR_VEL

Array = NDArray[np.float64]

_OFF_THE_GROUND = 0.1  # m
_AXES = "xyz"


def explain(
    reason: str,
    events: Sequence[Event],
    rows: Array,
    gates: Array,
    level: Level,
    *,
    highest: float,
    passed: int,
    first_command: str | None,
    error: str | None,
) -> str:
    """The reason for termination with what the referee knows of it.

    Parameters
    ----------
    reason: as in ``EpisodeResult.termination``.
    events: of the whole episode.
    rows: (k, TRACE_SIZE) of the last control step; may be empty.
    gates: (n, 7) true poses.
    highest: m, that the vehicle ever was; passed: how many gates.
    first_command: name of what the contestant asked for first; None if it never did.
    error: what went wrong on the contestant's or the vehicle's side, if anything did.
    """
    if reason == COLLISION:
        text = _collision(reason, events, rows, gates)
        still = highest < level.start.position[2] + _OFF_THE_GROUND
        return f"{text}: {_never(first_command)}" if still else text
    if reason == CONSTRAINT_VIOLATION:
        return _violation(reason, events, level)
    if reason == TUMBLED:
        event = _last(events, "tumbled")
        return f"{reason} at {event.time:.2f} s" if event is not None else reason
    if reason == MAX_EPISODE_DURATION:
        return _too_long(reason, rows, gates, level, highest, passed, first_command)
    if error:
        # Of a traceback the last line says what it was; where time is up, that is how we ended it.
        line = error.strip().splitlines()[0 if reason == CONTROLLER_TIMEOUT else -1]
        return f"{reason}: {line.strip()}"
    return reason


def _last(events: Sequence[Event], name: str) -> Event | None:
    return next((event for event in reversed(events) if event.name == name), None)


def _collision(reason: str, events: Sequence[Event], rows: Array, gates: Array) -> str:
    event = _last(events, "contact")
    if event is None:
        return reason
    at = f"at {event.time:.2f} s"
    kind, _, number = event.detail.partition(" ")
    if kind != "gate" or len(rows) == 0:
        thing = "the ground" if event.detail == "ground" else event.detail or "something"
        return f"{reason} with {thing} {at}"
    row = rows[int(np.argmin(np.abs(rows[:, TR_TIME] - event.time)))]
    part, where = _at_gate(row[TR_POS : TR_POS + 3], row[TR_VEL : TR_VEL + 3], gates[int(number)])
    return f"{reason} with {event.detail} ({part}) {at}, {where} of its centre"


def _at_gate(place: Array, velocity: Array, gate: Array) -> tuple[str, str]:
    """Which part of a gate is near ``place``, and where that is, as seen by who flies through."""
    centre = _centre(gate)
    across = np.array([math.cos(gate[5]), math.sin(gate[5]), 0.0])
    through = np.array([-math.sin(gate[5]), math.cos(gate[5]), 0.0])
    off = place - centre
    if not np.isfinite(velocity).all() or abs(velocity @ through) < 0.05:
        # It hardly moves: seen from where it is.
        ahead = -math.copysign(1.0, float(off @ through) or 1.0)
    else:
        ahead = math.copysign(1.0, float(velocity @ through))
    right, up = ahead * float(off @ across), float(off[2])
    side = "right" if right > 0.0 else "left"
    if up < -BEAM_OFFSET - 0.1:
        return "post", f"{-up:.2f} m below"
    if abs(right) >= abs(up):
        return f"{side} bar", f"{abs(right):.2f} m {side}"
    bar = "top bar" if up > 0.0 else "bottom bar"
    return bar, f"{abs(up):.2f} m {'above' if up > 0.0 else 'below'}"


def _never(first_command: str | None) -> str:
    began = f", the first command was {first_command}" if first_command else ""
    return f"never took off{began}"


def _centre(gate: Array) -> Array:
    return np.array([gate[0], gate[1], GATE_CENTRE_Z[int(gate[6])]])


def _violation(reason: str, events: Sequence[Event], level: Level) -> str:
    event = _last(events, "constraint violated")
    if event is None:
        return reason
    detail, at = event.detail, f"at {event.time:.2f} s"
    axis, _, side = detail.partition(" ")
    if axis in _AXES and side in ("below the arena", "above the arena"):
        bounds = level.arena.low if side.startswith("below") else level.arena.high
        return f"{reason}: {axis} {side.split()[0]} {bounds[_AXES.index(axis)]:g} m {at}"
    return f"{reason}: {detail} {at}"


def _too_long(
    reason: str,
    rows: Array,
    gates: Array,
    level: Level,
    highest: float,
    passed: int,
    first_command: str | None,
) -> str:
    if highest < level.start.position[2] + _OFF_THE_GROUND:
        return f"{reason}: {_never(first_command)}"
    if len(rows) == 0:
        return reason
    place = rows[-1, TR_POS : TR_POS + 3]
    if passed < len(gates):
        gate = gates[passed]
        return f"{reason}: {np.linalg.norm(place - _centre(gate)):.2f} m from gate {passed}"
    goal = np.array(level.goal.position)
    away = float(np.linalg.norm(place - goal))
    if away <= level.goal.tolerance:
        return f"{reason}: at the goal, but not for {level.goal.hold:g} s"
    return f"{reason}: {away:.2f} m from the goal"
