"""Uploaded trajectories: judged when they start, by the memory that they will read.

The vehicle has one memory for all; an id is but a name of a part of it, which a later upload
may have overwritten. What a flying trajectory reads cannot be overwritten.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.checks import beyond_memory
from crazyarena.safety.admission.agility import overtaxed
from crazyarena.safety.admission.memory import VehicleMemory
from crazyarena.safety.admission.room import Room
from crazyarena.safety.observation import as_point, yaw_of
from crazyarena.safety.planner import uploaded

_IDS = 31
# A polynomial of 7th order has nowhere to hide between so many points.
_SAME_PLACE = 0.05  # m
_JUMPS = 1.8  # rad, of a heading: some more than a quarter turn
_SAMPLES_PER_PIECE, _SAMPLE_STEP = 64, 0.05


def upload(
    room: Room, m: c.UploadTrajectory, memory: VehicleMemory, now: float
) -> tuple[c.Command, list[str]]:
    if not 0 <= int(m.trajectory_id) < _IDS:
        raise memory.refusal(m, f"trajectory id {m.trajectory_id}: there are 0 .. {_IDS - 1}")
    if np.abs(m.pieces).max() > np.finfo(np.float32).max:
        raise memory.refusal(m, "a coefficient is too large for the vehicle")
    too_much = beyond_memory(m)
    if too_much is not None:
        raise memory.refusal(m, too_much)
    offset = int(m.piece_offset)
    read = memory.planner.slots
    if offset < read.stop and read.start < offset + len(m.pieces):
        raise memory.refusal(
            m,
            f"pieces {read.start} .. {read.stop - 1} of its memory are being flown; choose another "
            "pieceOffset, or wait until another command has replaced the trajectory",
        )
    memory.then = lambda: memory.trajectories.write(int(m.trajectory_id), offset, m.pieces)
    return m, []


def start(
    room: Room, m: c.StartTrajectory, memory: VehicleMemory, now: float
) -> tuple[c.Command, list[str]]:
    ident = int(m.trajectory_id)
    part = memory.trajectories.part(ident)
    if part is None:
        raise memory.refusal(
            m,
            f"trajectory {ident} was not uploaded through this gate, so it cannot be checked",
        )
    other = memory.trajectories.overwritten_by(ident)
    if other is not None:
        raise memory.refusal(
            m,
            f"trajectory {other} was uploaded over trajectory {ident}; upload it again, or give "
            "each its own pieceOffset",
        )
    plan = uploaded(memory.trajectories.read(ident), float(m.timescale), bool(m.reverse))
    seen = room.seen(memory.vehicle)
    # From where the planner has the vehicle, and from where it is seen, if that is not the same.
    begins = [memory.planner.last_known(now, seen), None if seen is None else seen.position]
    if m.relative:
        if begins[0] is None or begins[1] is None:
            raise memory.refusal(m, "relative, but nobody knows where the vehicle is")
        first = np.array(plan.at(0.0).position)
        plan, seen_plan = (plan.moved(np.array(begin) - first) for begin in begins)
    else:
        seen_plan = plan
    with np.errstate(over="ignore", invalid="ignore"):  # what is not a number is refused below
        places, velocities, accelerations = plan.samples(_SAMPLES_PER_PIECE, _SAMPLE_STEP)
    n = room.limits
    for what, rows, limit in (
        ("speed", velocities, n.setpoint_speed),
        ("acceleration", accelerations, n.setpoint_acceleration),
    ):
        found = float(np.linalg.norm(rows, axis=1).max())
        if not found <= limit:
            raise memory.refusal(
                m, f"{what} reaches {found:.2f}, above {limit:g}; use a larger timescale"
            )
    _refuse_spins(room, m, memory)
    taxed = overtaxed(plan, n.vehicle, _SAMPLES_PER_PIECE, _SAMPLE_STEP)
    if taxed is not None:
        raise memory.refusal(m, f"{taxed}; use a larger timescale")
    shift = np.array(seen_plan.at(0.0).position) - places[0]
    for away in [np.zeros(3)] if np.abs(shift).max() < _SAME_PLACE else [np.zeros(3), shift]:
        worst = min(room.fence.room(x, y, z) for x, y, z in (places + away).tolist())
        if not worst >= 0.0:
            raise memory.refusal(m, f"it leads {-worst:.2f} m out of the fence")
    room.near_its_plan(m, memory, as_point(places[0]), seen)
    if room.link_loss.on:
        lost = max(
            room.link_loss.ballistic_excess(as_point(place), as_point(velocity))
            for place, velocity in zip(places, velocities, strict=True)
        )
        if not lost <= n.link_loss_margin:
            raise memory.refusal(
                m,
                f"cut on the way the vehicle would end {lost:.2f} m outside the fence; use a "
                "larger timescale or keep away from it",
            )
    memory.then = lambda: memory.follows(plan, now, m.group_mask, slots=part)
    return m, []


def _refuse_spins(room: Room, m: c.StartTrajectory, memory: VehicleMemory) -> None:
    """Refuse a heading that turns or jumps as no vehicle can."""
    pieces = memory.trajectories.read(int(m.trajectory_id))
    pieces[:, 1:9], pieces[:, 9:25] = pieces[:, 25:33], 0.0
    plan = uploaded(pieces, float(m.timescale), bool(m.reverse))
    with np.errstate(over="ignore", invalid="ignore"):
        headings, rates, _ = plan.samples(_SAMPLES_PER_PIECE, _SAMPLE_STEP)
    found, most = float(np.abs(rates[:, 0]).max()), room.limits.setpoint_yaw_rate
    if not found <= most:
        raise memory.refusal(
            m, f"its heading turns with {found:.1f} rad/s, above {most:g}; use a larger timescale"
        )
    state = room.state(memory.vehicle)
    told = headings[:, 0].tolist()
    way = told if state is None else [yaw_of(state.quaternion), *told]
    jump = max(abs(math.remainder(b - a, math.tau)) for a, b in itertools.pairwise(way))
    if not jump <= _JUMPS:
        raise memory.refusal(
            m, f"its heading jumps by {jump:.1f} rad, above {_JUMPS:g}; turn the vehicle first"
        )
