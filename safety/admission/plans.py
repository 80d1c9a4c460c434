"""Checks of plans that the vehicle makes itself: take-off, landing, go-to.

They are made here as the firmware will make them, from where its planner begins, and looked at
along their whole way: inside fence and zones, within the limits of speed and acceleration, and
cut anywhere. What is too fast gets more time; what leads out ends earlier.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.safety.admission.agility import overtaxed
from crazyarena.safety.admission.memory import VehicleMemory
from crazyarena.safety.admission.room import Room, text
from crazyarena.safety.fence import Fence
from crazyarena.safety.link_loss import largest_share
from crazyarena.safety.observation import Point, as_point
from crazyarena.safety.planner import Motion, Plan, to_rest

_SAMPLES, _SAMPLE_STEP = 24, 0.1
_STRETCH, _STRETCHES = 1.15, 24  # up to 25 times as long
_BISECTIONS = 8
_LEAST_WAY = 0.02  # m, of a plan that was cut short: less is none
_SWING = 0.1  # s of the speed at the beginning by which a vehicle may swing out further
_SLACK = 1.02  # what sampling may overlook
_FALLS = 0.1  # m, above where it stood, at which a landing may end
_SINKS, _SINKING = 3.0, 1.5  # m/s2 and m/s of a landing


def takeoff(
    room: Room, m: c.Takeoff, memory: VehicleMemory, now: float
) -> tuple[c.Command, list[str]]:
    reasons: list[str] = []
    seen = room.seen(memory.vehicle)
    x, y, z = (*_middle(room.fence), 0.0) if seen is None else seen.position
    height = float(m.height)
    top = _highest(room, x, y, z, height)
    if top is None:
        raise memory.refusal(
            m, f"there is no room above {text((x, y, z))} m; a take-off is upright"
        )
    if top != height:
        reasons.append(f"height {height:.2f} m leads out of the fence, lowered to {top:.2f}")
    start = Motion((x, y, z))
    duration = room.duration(abs(top - z), float(m.duration), reasons)
    duration = room.turned_in(m.yaw, False, memory.vehicle, duration, reasons)
    plan = to_rest(start, (x, y, top), max(duration, 1e-3))
    memory.then = lambda: memory.takes_off(plan, now, m.group_mask)
    return (replace(m, height=top, duration=duration) if reasons else m), reasons


def _highest(room: Room, x: float, y: float, z: float, height: float) -> float | None:
    """Up to where a vehicle may rise or sink from z on its way to ``height``; None: nowhere."""
    fence = room.fence
    begin = fence.room(x, y, max(z, fence.floor))
    share = room.clear_share((x, y, z), (x, y, height), min(begin, 0.0))
    if share >= 1.0:
        return height
    top = z + share * (height - z)
    # Back to where the soft limit has room as well: the climb overshoots a little.
    top -= math.copysign(min(fence.soft_margin, abs(top - z)), height - z)
    return None if abs(top - z) < _LEAST_WAY else top


def land(room: Room, m: c.Land, memory: VehicleMemory, now: float) -> tuple[c.Command, list[str]]:
    reasons: list[str] = []
    low, high = room.fence.bounds
    height = min(max(float(m.height), low[2] - 0.5), high[2] - room.fence.soft_margin)
    if height != m.height:
        reasons.append(f"height {m.height:g} m is outside the fence")
    if memory.stood is not None and height > memory.stood + _FALLS:
        reasons.append(f"motors stop at the end of a landing, at {height:.2f} m")
        height = memory.stood + _FALLS
    seen = room.seen(memory.vehicle)
    begin = memory.planner.last_known(now, seen)
    drop = 0.0 if begin is None else abs(begin[2] - height)
    # It may come from anywhere, however fast, and what is late is still high when motors stop.
    duration = room.duration(drop, float(m.duration), reasons, _SINKS, _SINKING)
    duration = room.turned_in(m.yaw, False, memory.vehicle, duration, reasons)
    plan = None
    if begin is not None:
        below = (begin[0], begin[1], height)
        room_now = room.fence.room(begin[0], begin[1], max(begin[2], room.fence.floor))
        if room.clear_share(begin, below, min(room_now, 0.0)) < 1.0:
            raise memory.refusal(
                m, f"there is no room below {text(begin)} m; fly to where there is first"
            )
        plan = to_rest(Motion(begin), below, max(duration, 1e-3))
    memory.then = lambda: memory.follows(plan, now, m.group_mask, landing=True)
    return (replace(m, height=height, duration=duration) if reasons else m), reasons


def go_to(room: Room, m: c.GoTo, memory: VehicleMemory, now: float) -> tuple[c.Command, list[str]]:
    reasons: list[str] = []
    seen = room.seen(memory.vehicle)
    origin = memory.planner.origin(now, seen)
    asked = as_point(m.position)
    if m.relative:
        if origin is None or seen is None:
            raise memory.refusal(
                m,
                "relative, but nobody knows where the vehicle is; it cannot be checked against "
                "the fence",
            )
        asked = _plus(asked, origin.position)
    room.near_its_plan(m, memory, None if origin is None else origin.position, seen)
    goal = room.inside(asked, memory.vehicle, reasons, "goal")
    duration = float(m.duration)
    if origin is None:
        memory.then = lambda: memory.follows(None, now, m.group_mask)
        return (replace(m, position=goal) if reasons else m), reasons
    duration = room.duration(math.dist(goal, origin.position), duration, reasons)
    duration = room.turned_in(float(m.yaw), m.relative, memory.vehicle, duration, reasons)
    plan = _fitting(room, origin, goal, duration)
    if plan is None:
        goal, plan = _cut_short(room, origin, goal, duration)
        if plan is None:
            raise memory.refusal(
                m, f"the way from {text(origin.position)} m leads out of the fence from the start"
            )
        reasons.append(f"the way to {text(asked)} m leads out of the fence, ended at {text(goal)}")
    if plan.duration > duration * (1.0 + 1e-9):
        reasons.append(
            f"in less than {plan.duration:.2f} s it would be too fast, or leave the fence if it "
            "were cut on the way"
        )
    memory.then = lambda: memory.follows(plan, now, m.group_mask)
    if not reasons:
        return m, reasons
    position = _minus(goal, origin.position) if m.relative else goal
    return replace(m, position=position, duration=plan.duration), reasons


def _fitting(room: Room, origin: Motion, goal: Point, duration: float) -> Plan | None:
    """The plan with the shortest good duration; None if the way leads out with any."""
    best: tuple[float, Plan | None] = (math.inf, None)
    for _ in range(_STRETCHES):
        plan = to_rest(origin, goal, max(duration, 1e-3))
        excess = _excess(room, plan, origin)
        if excess <= 0.0:
            return plan
        if math.isfinite(excess) and excess < best[0]:
            best = excess, plan
        duration = max(duration, 0.05) * _STRETCH
    # One who is fast already may come down outside whatever it is told: the least bad.
    return best[1]


def _excess(room: Room, plan: Plan, origin: Motion) -> float:
    """0 for a good plan; inf for one that leads out; m outside for one that must not be cut."""
    places, velocities, accelerations = plan.samples(_SAMPLES, _SAMPLE_STEP)
    n = room.limits
    begun = math.hypot(*origin.velocity), math.hypot(*origin.acceleration)
    for rows, limit, now in (
        (velocities, n.setpoint_speed, begun[0]),
        (accelerations, n.setpoint_acceleration, begun[1]),
    ):
        if np.linalg.norm(rows, axis=1).max() > _SLACK * max(limit, now):
            return math.inf
    if overtaxed(plan, n.vehicle, _SAMPLES, _SAMPLE_STEP, origin.acceleration) is not None:
        return math.inf
    fence = room.fence
    # No nearer to the fence than where it begins and ends, or the soft limit; one who is fast has
    # the tilt to go with it, of which the plan knows nothing.
    begin, end = (fence.room(x, y, max(z, fence.floor)) for x, y, z in (origin.position, plan.end))
    least = min(fence.soft_margin + _SWING * begun[0], begin, max(end, 0.0))
    if any(fence.room(x, y, max(z, fence.floor)) < least - 1e-6 for x, y, z in places.tolist()):
        return math.inf
    if not room.link_loss.on:
        return 0.0
    worst = max(
        room.link_loss.ballistic_excess(as_point(place), as_point(velocity))
        for place, velocity in zip(places[1:-1], velocities[1:-1], strict=True)
    )
    return max(0.0, worst - n.link_loss_margin)


def _cut_short(
    room: Room, origin: Motion, goal: Point, duration: float
) -> tuple[Point, Plan | None]:
    """The furthest place towards ``goal`` that can be flown to, and how; no plan if none can."""

    def towards(share: float) -> Point:
        x, y, z = (a + share * (b - a) for a, b in zip(origin.position, goal, strict=True))
        return x, y, z

    def good(share: float) -> bool:
        return _fitting(room, origin, towards(share), duration) is not None

    share = largest_share(good, _BISECTIONS)
    near = towards(share)
    if math.dist(near, origin.position) < _LEAST_WAY:
        return near, None
    # Not up to the edge itself: whoever follows a plan overshoots a little.
    margin = room.fence.soft_margin / math.dist(goal, origin.position)
    near = towards(max(share - margin, 0.5 * share))
    return near, _fitting(room, origin, near, duration)


def _middle(fence: Fence) -> tuple[float, float]:
    low, high = fence.bounds
    return 0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1])


def _plus(a: Point, b: Point) -> Point:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _minus(a: Point, b: Point) -> Point:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]
