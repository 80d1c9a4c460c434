"""Judges a flight by poses alone, so that simulation and reality are judged by the same code.

One :class:`Referee` a level; :meth:`Referee.begin` with the true track of an episode, then
:meth:`Referee.judge` with the trace rows (:mod:`crazyarena.sim_backend.trace`) of each control
step. A source that knows no rotor forces leaves NaN: the input constraint then never breaks.
A source that knows no contacts leaves UNKNOWN_CONTACT: they are computed from the geometry.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crazyarena.levels.schema import Level, Profile
from crazyarena.runner.judging import referee_kernel as rules_kernel
from crazyarena.runner.judging.referee_kernel import (
    EVENT_SIZE,
    MAX_EVENTS,
    MEMORY_SIZE,
    RULES_SIZE,
)
from crazyarena.runner.judging.verdict_row import (
    SIZE,
    VD_AT_GOAL,
    VD_COMPLETED,
    VD_CONSTRAINTS,
    VD_CONTACT,
    VD_DONE,
    VD_GATE,
    VD_GATE_TYPE,
    VD_IN_RANGE,
    VD_MSE,
    VD_REWARD,
    VD_TRUNCATED,
    VD_TUMBLED,
    VD_VIOLATION,
)
from crazyarena.sim_backend.physics.geometry import (
    forget,
    gate_rays_blocked,
    make_workspace,
)
from crazyarena.sim_backend.physics.scene import build_scene, fill_scene
from crazyarena.sim_backend.trace import (
    NO_CONTACT,
    TR_CONTACT,
    TR_OMEGA,
    TR_POS,
    TR_QUAT,
    TR_RPY,
    TR_TIME,
    TR_VEL,
    TRACE_SIZE,
    UNKNOWN_CONTACT,
)

Array = NDArray[np.float64]

LIFT_OFF = 0.1  # m; arena vehicles stand on the ground when their time starts
VISIBLE_RANGE = 0.45  # m, surface to surface
BLIND_TIME = 0.5  # s from the start in which no gate is looked at

# Rotor force limits: kf (0.2685 pwm + 4070.3)^2 at pwm 20000 and 65535, as float32.
FORCE_LOW = float(np.float32(3.16e-10 * (0.2685 * 20000 + 4070.3) ** 2))
FORCE_HIGH = float(np.float32(3.16e-10 * (0.2685 * 65535 + 4070.3) ** 2))

COLLISION = "COLLISION"
TASK_COMPLETION = "TASK COMPLETION"
CONSTRAINT_VIOLATION = "CONSTRAINT VIOLATION"
MAX_EPISODE_DURATION = "MAX EPISODE DURATION"
TUMBLED = "TUMBLED"

_EVENT_NAMES = {
    rules_kernel.EV_GATE: "gate passed",
    rules_kernel.EV_AT_GOAL: "goal reached",
    rules_kernel.EV_LEFT_GOAL: "goal left",
    rules_kernel.EV_COMPLETED: "task completed",
    rules_kernel.EV_CONTACT: "contact",
    rules_kernel.EV_CONTACT_END: "contact ended",
    rules_kernel.EV_VIOLATION: "constraint violated",
    rules_kernel.EV_VIOLATION_END: "constraint satisfied again",
    rules_kernel.EV_TUMBLED: "tumbled",
    rules_kernel.EV_TIME_LIMIT: "time limit",
}
_CONSTRAINT_NAMES = [
    *(f"rotor {i} force below the minimum" for i in range(4)),
    *(f"rotor {i} force above the maximum" for i in range(4)),
    *(f"{axis} below the arena" for axis in "xyz"),
    *(f"{axis} above the arena" for axis in "xyz"),
]


class Event(NamedTuple):
    """Something that happened at one tick; ``time`` in s since the episode began."""

    name: str
    tick: int
    time: float
    detail: str


class Verdict:
    """The referee's word on one control step: that of its last tick.

    Attributes
    ----------
    obs: list of 12, velocities and rates are 0, as the competition's contestants get it.
    info: the dictionary of the competition's per-step information.
    reward, done: of the last tick.
    collided, violated, completed: of the last tick (completion is sticky).
    gate: next gate, -1 when all are passed.
    events: what happened in any of the ticks.
    row: (SIZE,) see :mod:`crazyarena.runner.judging.verdict_row`; reused by the next judgement.
    """

    __slots__ = (
        "_last",
        "collided",
        "completed",
        "done",
        "events",
        "gate",
        "info",
        "obs",
        "reward",
        "row",
        "tumbled",
        "violated",
    )

    obs: list[Any]
    info: dict[str, Any]
    reward: float
    done: bool
    collided: bool
    violated: bool
    completed: bool
    tumbled: bool
    gate: int
    events: Sequence[Event]
    row: Array
    _last: Array

    def state(self) -> Array:
        """(12,) x, vx, y, vy, z, vz, phi, theta, psi, p, q, r with true velocities and rates."""
        last = self._last
        state = np.empty(12)
        state[0:6:2] = last[TR_POS : TR_POS + 3]
        state[1:6:2] = last[TR_VEL : TR_VEL + 3]
        state[6:9] = last[TR_RPY : TR_RPY + 3]
        state[9:12] = last[TR_OMEGA : TR_OMEGA + 3]
        return state


def observation(state: Array) -> list[Any]:
    """What a contestant is told of a (12,) state: velocities and rates are 0."""
    return [state[0], 0, state[2], 0, state[4], 0, state[6], state[7], state[8], 0, 0, 0]


class Referee:
    """See the module's text."""

    def __init__(self, level: Level) -> None:
        self._level = level
        self._rules = _rules(level)
        self._nominal_rows = [gate.row[:6] for gate in level.track.gates]
        n = max(1, len(self._nominal_rows))
        self._memory = np.zeros(MEMORY_SIZE)
        self._blocked = np.zeros(n)
        self._events = np.zeros((MAX_EVENTS, EVENT_SIZE))
        self._out = np.zeros(SIZE)
        self._work = make_workspace()
        self._first_constraint = 0 if level.constraints.input else 8
        self._last_constraint = 14 if level.constraints.state else 8
        self._constrained = self._last_constraint > self._first_constraint
        self._n_gates = len(self._nominal_rows)
        self._n_obstacles = len(level.track.obstacles)

    def begin(
        self, gates: Array, obstacles: Array, follow: Callable[[float], Array] | None = None
    ) -> None:
        """Begin an episode on a track.

        Parameters
        ----------
        gates: (n, 7) true x, y, z of the centre, roll, pitch, yaw, type.
        obstacles: (m, 6) true x, y, z, roll, pitch, yaw.
        follow: where gates move, their (n, 7) at a time in s, the same array while nothing has
            moved; asked with the time of every row that is judged.
        """
        self._follow = follow
        self._seen: Array | None = None
        self._gates = np.array(gates, dtype=np.float64).reshape(-1, 7)
        self._nominal = np.array(self._nominal_rows, dtype=np.float64).reshape(-1, 6)
        obstacles = np.array(obstacles, dtype=np.float64).reshape(-1, 6)
        self._obstacles = obstacles
        self._scene = build_scene(self._gates, obstacles)
        self._ground = self._n_gates + self._n_obstacles
        self._memory[:] = 0.0
        self._memory[rules_kernel.ME_CONTACT] = NO_CONTACT
        if self._n_gates == 0:
            self._memory[rules_kernel.ME_GATE] = -1.0
        self._look_at_gates()
        self._verdict: Verdict | None = None

    def _look_at_gates(self) -> None:
        """What follows from the places of the gates."""
        self._pose_lists = [list(row[:6]) for row in self._gates]
        forget(self._work)
        for gate in range(self._n_gates):
            self._blocked[gate] = gate_rays_blocked(self._scene, gate, self._work)

    def _move(self, gates: Array) -> None:
        if gates is self._seen:
            return
        self._seen = gates
        self._gates[:] = gates
        fill_scene(self._gates, self._obstacles, self._scene)
        self._look_at_gates()

    def warm_up(self, state: Array) -> None:
        """Load what judging needs, which takes some 40 ms, before the present episode starts.

        state: (12,) as :func:`observation` takes it.
        """
        row = np.zeros((1, TRACE_SIZE))
        row[0, TR_POS : TR_POS + 3] = state[0:6:2]
        row[0, TR_QUAT + 3] = 1.0
        row[0, TR_CONTACT] = UNKNOWN_CONTACT
        self.judge(row)
        self.begin(self._gates, self._obstacles, self._follow)

    def _apply(self, rows: Array) -> list[list[float]]:
        """Apply the rules to ticks; returns the events, as rows."""
        count = rules_kernel.judge(
            self._rules,
            self._memory,
            rows,
            self._scene,
            self._ground,
            self._blocked,
            self._gates,
            self._nominal,
            self._work,
            self._out,
            self._events,
        )
        return self._events[:count].tolist() if count else []

    def _apply_following(self, rows: Array, follow: Callable[[float], Array]) -> list[list[float]]:
        """The same, each tick with the gates where they are at its time."""
        found: list[list[float]] = []
        last = len(rows) - 1
        for k in range(len(rows)):
            self._move(follow(float(rows[k, TR_TIME])))
            events = self._apply(rows[k : k + 1])
            # The end of time is looked at once a control step.
            found += [e for e in events if k == last or e[0] != rules_kernel.EV_TIME_LIMIT]
        return found

    def judge(self, rows: Array) -> Verdict:
        """Judge the ticks of one control step, (k, TRACE_SIZE).

        With no rows (no pose arrived) the previous verdict stands, without its events.
        """
        if len(rows) == 0:
            if self._verdict is None:
                raise ValueError("the first control step of an episode needs at least one pose")
            self._verdict.events = ()
            return self._verdict
        out, follow = self._out, self._follow
        found = self._apply(rows) if follow is None else self._apply_following(rows, follow)
        verdict = Verdict()
        self._verdict = verdict
        last = rows[-1]
        value = out.tolist()
        gate = int(value[VD_GATE])
        verdict._last = last
        verdict.row = out
        verdict.gate = gate
        verdict.reward = value[VD_REWARD]
        verdict.done = value[VD_DONE] > 0.0
        verdict.collided = collided = value[VD_CONTACT] != NO_CONTACT
        verdict.violated = value[VD_VIOLATION] > 0.0
        verdict.completed = value[VD_COMPLETED] > 0.0
        verdict.tumbled = value[VD_TUMBLED] > 0.0
        verdict.obs = [
            last[TR_POS],
            0,
            last[TR_POS + 1],
            0,
            last[TR_POS + 2],
            0,
            last[TR_RPY],
            last[TR_RPY + 1],
            last[TR_RPY + 2],
            0,
            0,
            0,
        ]
        in_range = value[VD_IN_RANGE] > 0.0
        if gate < 0:
            pose: list[float] = []
        elif in_range:
            pose = self._pose_lists[gate].copy()
        else:
            pose = self._nominal_rows[gate].copy()
        info: dict[str, Any] = {
            "current_target_gate_id": gate,
            "current_target_gate_type": int(value[VD_GATE_TYPE]),
            "current_target_gate_in_range": in_range,
            "current_target_gate_pos": pose,
            "at_goal_position": value[VD_AT_GOAL] > 0.0,
            "task_completed": verdict.completed,
            "collision": (self.body_id(value[VD_CONTACT]), True) if collided else (None, False),
            "mse": out[VD_MSE],
        }
        if self._constrained:
            first = VD_CONSTRAINTS + self._first_constraint
            info["constraint_values"] = out[first : VD_CONSTRAINTS + self._last_constraint].copy()
            info["constraint_violation"] = int(verdict.violated)
        truncated = value[VD_TRUNCATED]
        if truncated == truncated:  # not NaN: only on the step that meets the time limit
            info["TimeLimit.truncated"] = truncated > 0.0
        verdict.info = info
        verdict.events = [self._event(row) for row in found] if found else ()
        return verdict

    def reason(self, verdict: Verdict) -> str:
        """Why an episode that is done has ended, tested in the competition's order."""
        level = self._level
        if verdict.collided and level.done_on_collision:
            return COLLISION
        if verdict.completed and level.done_on_completion:
            return TASK_COMPLETION
        if verdict.violated and level.done_on_violation:
            return CONSTRAINT_VIOLATION
        return TUMBLED if verdict.tumbled else MAX_EPISODE_DURATION

    @property
    def ticks(self) -> int:
        """Ticks judged so far in the present episode."""
        return int(self._memory[rules_kernel.ME_TICKS])

    def body_id(self, code: float) -> int:
        """Body number, as the competition's simulator counts, of a contact code."""
        number = int(code)
        if number < self._n_gates:
            return 2 + self._n_obstacles + number
        if number < self._ground:
            return 2 + number - self._n_gates
        return 0

    @property
    def level(self) -> Level:
        """What it judges by."""
        return self._level

    @property
    def true_gates(self) -> Array:
        """(n, 7) where the gates truly are."""
        return self._gates

    @property
    def gates(self) -> int:
        """How many gates the track has."""
        return self._n_gates

    @property
    def gates_passed(self) -> int:
        """How many gates the present episode has passed."""
        gate = int(self._memory[rules_kernel.ME_GATE])
        return self._n_gates if gate < 0 else gate

    def _object(self, code: float) -> str:
        number = int(code)
        if number < 0:
            return ""
        if number < self._n_gates:
            return f"gate {number}"
        if number < self._ground:
            return f"obstacle {number - self._n_gates}"
        return "ground"

    def _event(self, row: list[float]) -> Event:
        kind, tick, time, value = row
        detail = ""
        if kind == rules_kernel.EV_GATE:
            detail = f"gate {int(value)}"
        elif kind in (rules_kernel.EV_CONTACT, rules_kernel.EV_CONTACT_END):
            detail = self._object(value)
        elif kind == rules_kernel.EV_VIOLATION:
            detail = _CONSTRAINT_NAMES[int(value)]
        return Event(_EVENT_NAMES[int(kind)], int(tick), time, detail)


def _rules(level: Level) -> Array:
    rules = np.zeros(RULES_SIZE)
    rate = float(level.physics_frequency)
    k = rules_kernel
    rules[k.RU_TICK_RATE] = rate
    rules[k.RU_GATES] = len(level.track.gates)
    rules[k.RU_BLIND_TICKS] = BLIND_TIME * rate
    rules[k.RU_RANGE] = VISIBLE_RANGE
    rules[k.RU_GOAL : k.RU_GOAL + 3] = level.goal.position
    rules[k.RU_GOAL_RADIUS] = level.goal.tolerance
    rules[k.RU_HOLD_TICKS] = level.goal.hold * rate
    rules[k.RU_MAX_TICKS] = level.episode_length * rate
    rules[k.RU_DONE_COLLISION] = level.done_on_collision
    rules[k.RU_DONE_COMPLETION] = level.done_on_completion
    rules[k.RU_DONE_VIOLATION] = level.done_on_violation
    rules[k.RU_INPUT] = level.constraints.input
    rules[k.RU_STATE] = level.constraints.state
    rules[k.RU_FORCE_LOW] = FORCE_LOW
    rules[k.RU_FORCE_HIGH] = FORCE_HIGH
    rules[k.RU_LOW : k.RU_LOW + 3] = level.arena.low
    rules[k.RU_HIGH : k.RU_HIGH + 3] = level.arena.high
    # The competition's vehicles started in the air: the ground counted at once.
    rules[k.RU_LIFT_OFF] = LIFT_OFF if level.profile is Profile.ARENA else -np.inf
    return rules
