"""The rules of lsy_drone_racing, at the rate of its environment, and ours beside them.

Gates and obstacles are counted from 0, as its observations do.

Theirs decide: what is looked at is the state at the end of a step. Ours look at every physics
tick and at the real race, and only say where they would have decided otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from crazyarena.levels.lsy.draw import LsyDraw
from crazyarena.levels.lsy.schema import MAX_STEPS, LsyLevel
from crazyarena.sim_backend.physics.successor_scene import GATE_OUTSIDE
from crazyarena.sim_backend.trace import (
    TR_CONTACT,
    TR_OMEGA,
    TR_POS,
    TR_QUAT,
    TR_TIME,
    TR_TUMBLED,
    TR_VEL,
)

Array = NDArray[np.float64]

WINDOW = 0.45
"""Side of the square in a gate's plane that counts as passed, m."""
OPENING = 0.40
"""Side of the opening, m."""
BOUNDS = (np.array([-3.0, -3.0, 0.0]), np.array([3.0, 3.0, 2.5]))
"""What the simulation lets fly in, m; the level's safety limits are held in a real race only."""
_ON_PLATFORM = 0.02  # m from the start, in x and in y
GONE = np.full(3, -1.0)
"""Where a drone is put that is out, m."""
_BAR = 0.08  # m, beyond the outside of a gate that is still its bars: half of the drone

GATES_PASSED, COLLISION, OUT_OF_BOUNDS, FLOOR = (
    "GATES PASSED",
    "COLLISION",
    "OUT OF BOUNDS",
    "FLOOR",
)
TIME_LIMIT = "TIME LIMIT"
SAFETY_LIMITS, TUMBLED = "SAFETY LIMITS", "TUMBLED"


# As the referee of 2022 calls them.
VIOLATED, SATISFIED = "constraint violated", "constraint satisfied again"


@dataclass(slots=True)
class LsyEvent:
    """Something that happened: s since the first step, and words."""

    time: float
    name: str
    detail: str = ""


@dataclass(slots=True)
class LsyVerdict:
    """What a step comes to."""

    obs: dict[str, Any]
    reward: float
    terminated: bool
    truncated: bool
    reason: str | None
    events: list[LsyEvent] = field(default_factory=list)


class LsyReferee:
    """Judges one episode after the other of a level.

    real: a race on real ground, which ends where the level's safety limits are left, and whose
    drone stays where it is.
    """

    def __init__(self, level: LsyLevel, real: bool = False) -> None:
        self._real = real
        order = np.array(level.env.track.order)
        self._level = level
        self._sequence = np.abs(order) - 1
        self._direction = np.sign(order)
        self._range = level.env.sensor_range
        limits = level.env.track.safety_limits
        self._limits = np.array(limits.pos_limit_low), np.array(limits.pos_limit_high)

    def begin(self, draw: LsyDraw, state: Array) -> dict[str, Any]:
        """Start an episode at ``state`` (13,); returns the first observation."""
        self._draw = draw
        self._turns = Rotation.from_quat(draw.gates[:, 3:]).inv().as_matrix()
        self._last = state[:3].copy()
        self._start = state[:3].copy()
        self._ticked = state[:3].copy()
        self.passed = 0
        self.steps = 0
        self.gate_times: list[float] = []
        self.notes: list[str] = []
        self._left_limits = self._touched_between = False
        self._gates_seen = np.zeros(len(draw.gates), bool)
        self._obstacles_seen = np.zeros(len(draw.obstacles), bool)
        self._touching = -1
        self._outside = ""
        self._found = self._look(state[:3])
        return self._obs(state)

    @property
    def gates(self) -> int:
        """How many passes make a run."""
        return len(self._sequence)

    def judge(self, rows: Array) -> LsyVerdict:
        """Judge the ticks (k, TRACE_SIZE) of a step."""
        row = rows[-1]
        place = row[TR_POS : TR_POS + 3]
        time = float(row[TR_TIME])
        self._found += self._look(place)
        events = [LsyEvent(time, *found) for found in self._found]
        self._found.clear()
        events += self._contacts(rows)
        reason = self._disabled(row)
        self._compare(rows, reason, events)
        if reason is None and self.passed < self.gates:
            crossing = self._crossing(self._last, place)
            if crossing is not None:
                y, z = crossing
                number = int(self._sequence[self.passed])
                self.passed += 1
                self.gate_times.append(time)
                events.append(LsyEvent(time, "gate passed", f"gate {number}"))
                if max(abs(y), abs(z)) > OPENING / 2:
                    self.notes.append(
                        f"gate {number} counted at {y:+.3f} m, {z:+.3f} m from its centre: "
                        f"outside of its opening of {OPENING:g} m"
                    )
                    events.append(LsyEvent(time, "note", self.notes[-1]))
        self.steps += 1
        truncated = self.steps >= MAX_STEPS
        if reason is not None:
            events.append(LsyEvent(time, reason.lower(), self._where_out(reason, place)))
        elif truncated:
            reason = TIME_LIMIT
        self._last = place.copy()
        state = np.concatenate(
            [
                place,
                row[TR_VEL : TR_VEL + 3],
                row[TR_QUAT : TR_QUAT + 4],
                row[TR_OMEGA : TR_OMEGA + 3],
            ]
        )
        terminated = reason is not None and reason != TIME_LIMIT
        if terminated and not self._real:
            state[:3] = GONE
        reward = -1.0 if self.passed == self.gates else 0.0
        return LsyVerdict(self._obs(state), reward, terminated, truncated, reason, events)

    def _disabled(self, row: Array) -> str | None:
        """Why the drone is out at the end of a step; the gates are those of the step before, so
        that the last pass ends the run one step later."""
        place = row[TR_POS : TR_POS + 3]
        if row[TR_CONTACT] >= 0.0:
            return COLLISION
        if self._real:
            return self._ended_for_real(row)
        low, high = BOUNDS
        if place[2] < low[2] and np.abs(place[:2] - self._start[:2]).max() > _ON_PLATFORM:
            return FLOOR
        if (place[:2] < low[:2]).any() or (place > high).any():
            return OUT_OF_BOUNDS
        return GATES_PASSED if self.passed == self.gates else None

    def _ended_for_real(self, row: Array) -> str | None:
        place = row[TR_POS : TR_POS + 3]
        if row[TR_TUMBLED] == 1.0:
            return TUMBLED
        low, high = self._limits
        # The floor below the start is no way out.
        if (place[:2] < low[:2]).any() or (place > high).any():
            return SAFETY_LIMITS
        return GATES_PASSED if self.passed == self.gates else None

    def _contacts(self, rows: Array) -> list[LsyEvent]:
        """Contacts that begin or end at one of these ticks."""
        codes = rows[:, TR_CONTACT]
        if self._touching < 0 and not (codes >= 0.0).any():
            return []
        events = []
        for row in rows:
            code, time = int(row[TR_CONTACT]), float(row[TR_TIME])
            if code == self._touching:
                continue
            if self._touching >= 0:
                events.append(LsyEvent(time, "contact ended", self._named(self._touching)))
            if code >= 0:
                events.append(LsyEvent(time, "contact", self._touched(row)))
            self._touching = code
        return events

    def _named(self, code: int) -> str:
        """What is touched; the drones of a race come behind gates and obstacles."""
        gates, obstacles = len(self._draw.gates), len(self._draw.obstacles)
        if code < gates:
            return f"gate {code}"
        code -= gates
        return f"obstacle {code}" if code < obstacles else f"drone {code - obstacles}"

    def _touched(self, row: Array) -> str:
        """What is touched at a tick; of a gate the part, as seen by who flies through."""
        code = int(row[TR_CONTACT])
        name = self._named(code)
        if code >= len(self._draw.gates):
            return name
        turn = self._turns[code]
        _, y, z = turn @ (row[TR_POS : TR_POS + 3] - self._draw.gates[code, :3])
        if z < -(GATE_OUTSIDE / 2 + _BAR):
            return f"{name} (stand)"
        if abs(z) > abs(y):
            side, far = ("above", z) if z > 0.0 else ("below", -z)
            return f"{name} ({'top' if z > 0.0 else 'bottom'} bar, {far:.2f} m {side} its centre)"
        ahead = math.copysign(1.0, float((turn @ row[TR_VEL : TR_VEL + 3])[0]))
        side = "left" if y * ahead > 0.0 else "right"
        return f"{name} ({side} bar, {abs(y):.2f} m {side} of its centre)"

    def _where_out(self, reason: str, place: Array) -> str:
        if reason == OUT_OF_BOUNDS:
            return _beyond(place, *BOUNDS)
        return _beyond(place, *self._limits) if reason == SAFETY_LIMITS else ""

    def _look(self, place: Array) -> list[tuple[str, str]]:
        """Look around; names and details of what is seen for the first time."""
        found = []
        for what, seen, objects in (
            ("gate", self._gates_seen, self._draw.gates),
            ("obstacle", self._obstacles_seen, self._draw.obstacles),
        ):
            if seen.all():
                continue
            offset = objects[:, :2] - place[:2]
            near = ((offset * offset).sum(axis=1) < self._range**2) & ~seen
            if near.any():
                seen |= near
                found += [(f"{what} seen", f"{what} {k}") for k in np.flatnonzero(near)]
        return found

    def _crossing(self, before: Array, after: Array) -> tuple[float, float] | None:
        """Where (m, in the gate's plane) the way between two places passes the next gate."""
        number = self._sequence[self.passed]
        turn, centre = self._turns[number], self._draw.gates[number, :3]
        a, b = turn @ (before - centre), turn @ (after - centre)
        sign = self._direction[self.passed]
        if not (sign * a[0] < 0.0 < sign * b[0]):
            return None
        share = -a[0] / (b[0] - a[0])
        y, z = a[1:] + share * (b[1:] - a[1:])
        half = WINDOW / 2
        return (float(y), float(z)) if abs(y) < half and abs(z) < half else None

    def _compare(self, rows: Array, reason: str | None, events: list[LsyEvent]) -> None:
        """Note where a look at every tick, or the real race, would have decided otherwise."""
        codes = rows[:, TR_CONTACT]
        if reason is None and not self._touched_between and (codes >= 0.0).any():
            self._touched_between = True
            first = rows[int(np.argmax(codes >= 0.0))]
            self.notes.append(
                f"touched something at {first[TR_TIME]:.3f} s, between two looks of the referee: "
                "a collision by every tick"
            )
        if not self._real:
            places = rows[:, TR_POS : TR_POS + 3]
            low, high = self._limits
            # The floor below the start is no way out.
            out = (places[:, :2] < low[:2]).any(axis=1) | (places > high).any(axis=1)
            if not out.any():
                if self._outside:
                    satisfied = LsyEvent(float(rows[-1, TR_TIME]), SATISFIED, self._outside)
                    events.append(satisfied)
                    self._outside = ""
                return
            first = rows[int(np.argmax(out))]
            if not self._outside:
                self._outside = _beyond(first[TR_POS : TR_POS + 3], low, high)
                events.append(LsyEvent(float(first[TR_TIME]), VIOLATED, self._outside))
            if not self._left_limits:
                self._left_limits = True
                where = ", ".join(f"{v:.2f}" for v in first[TR_POS : TR_POS + 3])
                self.notes.append(
                    f"left the safety limits at {first[TR_TIME]:.2f} s, at [{where}] m: a real "
                    "race would have ended there"
                )

    def _obs(self, state: Array) -> dict[str, Any]:
        draw = self._draw
        seen, near = self._gates_seen[:, None], self._obstacles_seen[:, None]
        gates = np.where(seen, draw.gates, draw.nominal_gates).astype(np.float32)
        obstacles = np.where(near, draw.obstacles, draw.nominal_obstacles).astype(np.float32)
        done = self.passed == self.gates
        target = -1 if done else int(self._sequence[self.passed])
        return {
            "pos": state[:3].astype(np.float32),
            "quat": state[6:10].astype(np.float32),
            "vel": state[3:6].astype(np.float32),
            "ang_vel": state[10:13].astype(np.float32),
            "target_gate": np.array(target, np.int32),
            "gates_pos": gates[:, :3].copy(),
            "gates_quat": gates[:, 3:].copy(),
            "gates_visited": self._gates_seen.copy(),
            "obstacles_pos": obstacles,
            "obstacles_visited": self._obstacles_seen.copy(),
            "n_gates_passed": np.array(self.passed, np.int32),
            "gate_sequence": self._sequence.astype(np.int32),
            "gate_sequence_direction": self._direction.astype(np.int32),
            # Of some weeks in between.
            "race_progress": np.array(-1 if done else self.passed, np.int32),
            "target_gate_reverse": np.array(not done and self._direction[self.passed] < 0),
        }


def _beyond(place: Array, low: Array, high: Array) -> str:
    """The first limit that a place is beyond; the floor is none."""
    for k, axis in enumerate("xyz"):
        if place[k] > high[k]:
            return f"{axis} above {high[k]:g} m"
        if k < 2 and place[k] < low[k]:
            return f"{axis} below {low[k]:g} m"
    return ""


def lsy_why(
    reason: str,
    events: Sequence[Any],
    error: str | None,
    passed: int,
    gates: int,
    ended: float,
) -> str:
    """Why an episode ended, in one line.

    events: have ``time``, ``name`` and ``detail``. ended: s, when the episode did.
    """
    if error:
        return f"{reason}: {error.strip().splitlines()[-1].strip()}"
    if reason == COLLISION:
        touched = next((e for e in reversed(events) if e.name == "contact"), None)
        if touched is not None:
            return f"{reason} with {touched.detail} at {touched.time:.2f} s"
    out = next((e for e in reversed(events) if e.name == reason.lower() and e.detail), None)
    if out is not None:
        return f"{reason}: {out.detail} at {out.time:.2f} s, {passed} of {gates} gates"
    if reason == FLOOR:
        return (
            f"{reason}: came down away from its start at {ended:.2f} s, {passed} of {gates} gates"
        )
    if reason != GATES_PASSED and passed < gates:
        return f"{reason}: {passed} of {gates} gates at {ended:.2f} s"
    return reason
