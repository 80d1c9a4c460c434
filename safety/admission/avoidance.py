"""Collision avoidance on board moves setpoints after the gate has seen them: it gets a box."""

from __future__ import annotations

from dataclasses import replace

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.safety.admission.memory import VehicleMemory
from crazyarena.safety.admission.room import Room, text
from crazyarena.safety.observation import as_point


def collision_avoidance(
    room: Room, m: c.CollisionAvoidance, memory: VehicleMemory, now: float
) -> tuple[c.Command, list[str]]:
    """Cut the box, out of which no neighbour pushes a vehicle, down to that of the fence."""
    if not m.enable:
        return m, []
    margin = room.fence.soft_margin
    (lx, ly, lz), (hx, hy, hz) = room.fence.bounds
    low, high = as_point(m.bbox_min), as_point(m.bbox_max)
    inner_low, inner_high = (lx + margin, ly + margin, lz), (hx - margin, hy - margin, hz - margin)
    fitted_low = tuple(map(max, low, inner_low))
    fitted_high = tuple(map(min, high, inner_high))
    if not all(a < b for a, b in zip(fitted_low, fitted_high, strict=True)):
        raise memory.refusal(m, f"its box {text(low)} .. {text(high)} m lies outside the fence")
    where = room.where(memory.vehicle)
    if where is not None and not all(
        a - margin <= p <= b + margin
        for a, p, b in zip(fitted_low, where, fitted_high, strict=True)
    ):
        raise memory.refusal(
            m, f"its box {text(low)} .. {text(high)} m would drag the vehicle from {text(where)}"
        )
    speed = min(float(m.max_speed), room.limits.setpoint_speed)
    reasons = []
    if speed != m.max_speed:
        reasons.append(f"speed of {m.max_speed:g} is above {speed:g}")
    # A box that reaches beyond the fence asks for nothing that the fence does not give.
    return replace(m, bbox_min=fitted_low, bbox_max=fitted_high, max_speed=speed), reasons
