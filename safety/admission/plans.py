"""Checks of plans that the vehicle makes itself: take-off, landing, go-to."""

from __future__ import annotations

import math
from dataclasses import replace

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.safety.admission.memory import VehicleMemory
from crazyarena.safety.admission.room import Room
from crazyarena.safety.fence import Fence
from crazyarena.safety.observation import as_point


def takeoff(
    room: Room, m: c.Takeoff, memory: VehicleMemory, now: float
) -> tuple[c.Command, list[str]]:
    reasons: list[str] = []
    x, y, z = room.where(memory.vehicle) or (*_middle(room.fence), 0.0)
    height = room.inside((x, y, float(m.height)), memory.vehicle, reasons, "height at")[2]
    duration = room.duration(abs(height - z), float(m.duration), reasons)
    return (replace(m, height=height, duration=duration) if reasons else m), reasons


def land(room: Room, m: c.Land, memory: VehicleMemory, now: float) -> tuple[c.Command, list[str]]:
    reasons: list[str] = []
    where = room.where(memory.vehicle)
    low, high = room.fence.bounds
    height = min(max(float(m.height), low[2] - 0.5), high[2] - room.fence.soft_margin)
    if height != m.height:
        reasons.append(f"height {m.height:g} m is outside the fence")
    drop = 0.0 if where is None else abs(where[2] - height)
    duration = room.duration(drop, float(m.duration), reasons)
    return (replace(m, height=height, duration=duration) if reasons else m), reasons


def go_to(room: Room, m: c.GoTo, memory: VehicleMemory, now: float) -> tuple[c.Command, list[str]]:
    reasons: list[str] = []
    where = room.where(memory.vehicle)
    goal = as_point(m.position)
    if m.relative:
        if where is None:
            raise memory.refusal(
                m,
                "relative, but nobody knows where the vehicle is; it "
                "cannot be checked against the fence",
            )
        x, y, z = (a + b for a, b in zip(goal, where, strict=True))
        moved = room.inside((x, y, z), memory.vehicle, reasons, "goal")
        goal = (goal[0] + moved[0] - x, goal[1] + moved[1] - y, goal[2] + moved[2] - z)
        distance = math.hypot(*goal)
    else:
        goal = room.inside(goal, memory.vehicle, reasons, "goal")
        distance = 0.0 if where is None else math.dist(goal, where)
    duration = room.duration(distance, float(m.duration), reasons)
    motion = room.motion(memory.vehicle)
    if motion is not None:
        (x, y, z), _ = motion
        end = (x + goal[0], y + goal[1], z + goal[2]) if m.relative else goal
        longer = room.link_loss.duration(*motion, end, duration)
        if longer > duration:
            reasons.append(f"cut on the way it would leave the fence in less than {longer:.2f} s")
            duration = longer
    return (replace(m, position=goal, duration=duration) if reasons else m), reasons


def _middle(fence: Fence) -> tuple[float, float]:
    low, high = fence.bounds
    return 0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1])
