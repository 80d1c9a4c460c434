"""The competition's rules as a compiled kernel over the ticks of one control step.

Rows in, rows out; :mod:`crazyarena.runner.judging.referee` is the thin class around it. Evaluation
rules of the IROS 2022 Safe Robot Learning Competition, including what looks odd in them.
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.jit import kernel
from crazyarena.runner.judging.verdict_row import (
    VD_AT_GOAL,
    VD_COMPLETED,
    VD_CONSTRAINTS,
    VD_CONTACT,
    VD_DONE,
    VD_GATE,
    VD_GATE_POSE,
    VD_GATE_TYPE,
    VD_IN_RANGE,
    VD_MSE,
    VD_REWARD,
    VD_TICKS,
    VD_TIME,
    VD_TRUNCATED,
    VD_TUMBLED,
    VD_VIOLATION,
)
from crazyarena.sim_backend.physics.geometry import (
    first_contact,
    gate_in_range,
    gate_ray_hit,
)
from crazyarena.sim_backend.physics.scene import GATE_ROWS, S_CENTRE, S_RADIUS
from crazyarena.sim_backend.trace import (
    NO_CONTACT,
    TR_ACTION,
    TR_CONTACT,
    TR_POS,
    TR_QUAT,
    TR_TIME,
    TR_TUMBLED,
    UNKNOWN_CONTACT,
)

# The rules of a level.
RU_TICK_RATE = 0  # Hz
RU_GATES = 1  # how many
RU_BLIND_TICKS = 2  # gates are not looked at until more ticks than these are complete
RU_RANGE = 3  # m, surface distance within which the target gate's true pose is told
RU_GOAL = 4  # m
RU_GOAL_RADIUS = 7  # m
RU_HOLD_TICKS = 8  # the task is completed when the goal was held for more than these
RU_MAX_TICKS = 9
RU_DONE_COLLISION = 10
RU_DONE_COMPLETION = 11
RU_DONE_VIOLATION = 12
RU_INPUT = 13  # 1.0 when the rotor forces are constrained
RU_STATE = 14  # 1.0 when the position is
RU_FORCE_LOW = 15  # N
RU_FORCE_HIGH = 16
RU_LOW = 17  # m
RU_HIGH = 20
RU_LIFT_OFF = 23  # m: the ground counts as touched only after the vehicle was this high
RULES_SIZE = 24

# What the referee remembers between control steps.
ME_TICKS = 0
ME_GATE = 1
ME_BONUS = 2  # the last gate test was positive; cleared by the next one only
ME_GOAL_TICKS = 3
ME_COMPLETED = 4
ME_VIOLATED = 5  # at the previous tick
ME_CONTACT = 6
ME_AT_GOAL = 7
ME_TUMBLED = 8
ME_LIFTED = 9
MEMORY_SIZE = 10

# Events: rows [kind, tick, time, value].
EV_GATE = 1  # value: the gate passed
EV_AT_GOAL = 2
EV_LEFT_GOAL = 3
EV_COMPLETED = 4
EV_CONTACT = 5  # value: contact code
EV_CONTACT_END = 6
EV_VIOLATION = 7  # value: index into the constraint values
EV_VIOLATION_END = 8
EV_TUMBLED = 9
EV_TIME_LIMIT = 10
EVENT_SIZE = 4
MAX_EVENTS = 64

_ROUND = 1e8  # constraint values are rounded to 8 decimals


@kernel
def _note(events, count, kind, tick, time, value):
    if count < events.shape[0]:
        events[count, 0] = kind
        events[count, 1] = tick
        events[count, 2] = time
        events[count, 3] = value
        return count + 1
    return count


@kernel
def _constraint(rules, row, i):
    """Constraint ``i``: 0..3 low - force, 4..7 force - high, 8..10 low - x, 11..13 x - high."""
    if i < 4:
        return rules[RU_FORCE_LOW] - row[TR_ACTION + i]
    if i < 8:
        return row[TR_ACTION + i - 4] - rules[RU_FORCE_HIGH]
    if i < 11:
        return rules[RU_LOW + i - 8] - row[TR_POS + i - 8]
    return row[TR_POS + i - 11] - rules[RU_HIGH + i - 11]


@kernel
def _first_violation(rules, row):
    """Index of the first violated constraint, -1 if none; what is not known (NaN) is not."""
    first = 0 if rules[RU_INPUT] > 0.0 else 8
    last = 14 if rules[RU_STATE] > 0.0 else 8
    for i in range(first, last):
        if _constraint(rules, row, i) * _ROUND > 0.5:
            return i
    return -1


@kernel
def _describe(rules, memory, row, near, gates, nominal, out):
    """What a verdict tells of the last tick beyond the rules: target gate, distance, margins."""
    gate = int(memory[ME_GATE])
    out[VD_TIME] = row[TR_TIME]
    out[VD_TICKS] = memory[ME_TICKS]
    out[VD_GATE] = gate
    out[VD_IN_RANGE] = 1.0 if near else 0.0
    if gate < 0:
        out[VD_GATE_TYPE] = -1.0
        for i in range(6):
            out[VD_GATE_POSE + i] = math.nan
    else:
        out[VD_GATE_TYPE] = gates[gate, 6]
        for i in range(6):
            out[VD_GATE_POSE + i] = gates[gate, i] if near else nominal[gate, i]
    mse = 0.0
    for i in range(3):
        mse += (row[TR_POS + i] - rules[RU_GOAL + i]) ** 2
    out[VD_MSE] = mse
    for i in range(14):
        out[VD_CONSTRAINTS + i] = np.rint(_constraint(rules, row, i) * _ROUND) / _ROUND


@kernel
def judge(rules, memory, rows, scene, ground, blocked, gates, nominal, work, out, events):
    """Apply the rules to every tick of ``rows``; verdict of the last into ``out``.

    Returns the number of events noted.
    """
    n_events = 0
    n_gates = int(rules[RU_GATES])
    limit2 = rules[RU_GOAL_RADIUS] * rules[RU_GOAL_RADIUS]
    for k in range(rows.shape[0]):
        row = rows[k]
        time = row[TR_TIME]
        px, py, pz = row[TR_POS], row[TR_POS + 1], row[TR_POS + 2]
        qx, qy, qz, qw = row[TR_QUAT], row[TR_QUAT + 1], row[TR_QUAT + 2], row[TR_QUAT + 3]
        # Poses may come at another rate than the simulation's ticks: count by their time.
        tick = math.floor(time * rules[RU_TICK_RATE] + 0.5)
        elapsed = max(1.0, tick - memory[ME_TICKS])
        memory[ME_TICKS] = tick

        # Gates. The bonus flag is cleared only while there are gates left to look for.
        if memory[ME_GATE] >= 0.0 and tick - 1.0 > rules[RU_BLIND_TICKS]:
            gate = int(memory[ME_GATE])
            header = GATE_ROWS * gate
            # A cheap look first: the rays lie within the gate's bounding sphere.
            dx, dy = px - scene[header, S_CENTRE], py - scene[header, S_CENTRE + 1]
            reach = scene[header, S_RADIUS] + 0.1
            passed = blocked[gate] > 0.0
            if not passed and dx * dx + dy * dy < reach * reach:
                passed = gate_ray_hit(scene, gate, px, py, pz, qx, qy, qz, qw, work)
            memory[ME_BONUS] = 0.0
            if passed:
                memory[ME_BONUS] = 1.0
                memory[ME_GATE] = -1.0 if gate + 1 >= n_gates else gate + 1.0
                n_events = _note(events, n_events, EV_GATE, tick, time, gate)

        # Goal.
        at_goal = 0.0
        if memory[ME_GATE] < 0.0:
            dx, dy, dz = px - rules[RU_GOAL], py - rules[RU_GOAL + 1], pz - rules[RU_GOAL + 2]
            if dx * dx + dy * dy + dz * dz < limit2:
                at_goal = 1.0
        if at_goal > 0.0:
            memory[ME_GOAL_TICKS] += elapsed if memory[ME_AT_GOAL] > 0.0 else 1.0
            if memory[ME_AT_GOAL] == 0.0:
                n_events = _note(events, n_events, EV_AT_GOAL, tick, time, 0.0)
            if memory[ME_GOAL_TICKS] > rules[RU_HOLD_TICKS] and memory[ME_COMPLETED] == 0.0:
                memory[ME_COMPLETED] = 1.0
                n_events = _note(events, n_events, EV_COMPLETED, tick, time, 0.0)
        else:
            memory[ME_GOAL_TICKS] = 0.0
            if memory[ME_AT_GOAL] > 0.0:
                n_events = _note(events, n_events, EV_LEFT_GOAL, tick, time, 0.0)
        memory[ME_AT_GOAL] = at_goal

        contact = row[TR_CONTACT]
        if contact == UNKNOWN_CONTACT:
            contact = float(first_contact(scene, ground, px, py, pz, qx, qy, qz, qw, work))
        if memory[ME_LIFTED] == 0.0:
            if pz >= rules[RU_LIFT_OFF]:
                memory[ME_LIFTED] = 1.0
            elif contact == ground:
                contact = NO_CONTACT
        if contact != memory[ME_CONTACT]:
            if contact == NO_CONTACT:
                n_events = _note(events, n_events, EV_CONTACT_END, tick, time, memory[ME_CONTACT])
            else:
                n_events = _note(events, n_events, EV_CONTACT, tick, time, contact)
            memory[ME_CONTACT] = contact

        broken = _first_violation(rules, row)
        violated = 1.0 if broken >= 0 else 0.0
        # The penalty is that of the previous tick.
        reward = 100.0 * memory[ME_BONUS] + 100.0 * at_goal - 100.0 * memory[ME_VIOLATED]
        if contact != NO_CONTACT:
            reward -= 1000.0
        if violated != memory[ME_VIOLATED]:
            kind = EV_VIOLATION if violated > 0.0 else EV_VIOLATION_END
            n_events = _note(events, n_events, kind, tick, time, broken)
        memory[ME_VIOLATED] = violated

        tumbled = 1.0 if row[TR_TUMBLED] > 0.0 else 0.0
        if tumbled > memory[ME_TUMBLED]:
            n_events = _note(events, n_events, EV_TUMBLED, tick, time, 0.0)
        memory[ME_TUMBLED] = tumbled

        if k == rows.shape[0] - 1:
            done = (
                (rules[RU_DONE_COLLISION] > 0.0 and contact != NO_CONTACT)
                or (rules[RU_DONE_COMPLETION] > 0.0 and memory[ME_COMPLETED] > 0.0)
                or (rules[RU_DONE_VIOLATION] > 0.0 and violated > 0.0)
                or tumbled > 0.0
            )
            out[VD_TRUNCATED] = math.nan
            if tick >= rules[RU_MAX_TICKS]:
                out[VD_TRUNCATED] = 0.0 if done else 1.0
                n_events = _note(events, n_events, EV_TIME_LIMIT, tick, time, 0.0)
                done = True
            out[VD_AT_GOAL] = at_goal
            out[VD_COMPLETED] = memory[ME_COMPLETED]
            out[VD_CONTACT] = contact
            out[VD_VIOLATION] = violated
            out[VD_REWARD] = reward
            out[VD_DONE] = 1.0 if done else 0.0
            out[VD_TUMBLED] = tumbled
            gate = int(memory[ME_GATE])
            near = gate >= 0 and gate_in_range(
                scene, gate, rules[RU_RANGE], px, py, pz, qx, qy, qz, qw, work
            )
            _describe(rules, memory, row, near, gates, nominal, out)
    return n_events
