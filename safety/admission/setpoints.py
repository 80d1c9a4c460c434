"""Checks of streamed setpoints: held inside the fence, near the vehicle, and slow enough."""

from __future__ import annotations

import math
from dataclasses import replace

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.safety.admission.memory import VehicleMemory
from crazyarena.safety.admission.room import OUT_IF_LOST, Room, towards
from crazyarena.safety.flight_model import MELLINGER
from crazyarena.safety.observation import as_point, yaw_of


def full_state(
    room: Room, m: c.FullState, memory: VehicleMemory, now: float
) -> tuple[c.Command, list[str]]:
    n = room.limits
    reasons: list[str] = []
    asked = as_point(m.position)
    place = room.inside(asked, memory.vehicle, reasons, "position")
    place = room.reachable(place, memory, now, reasons, as_point(m.velocity))
    velocity = room.slowed(as_point(m.velocity), reasons, "speed", n.setpoint_speed)
    acceleration = room.slowed(
        as_point(m.acceleration), reasons, "acceleration", n.setpoint_acceleration
    )
    if place != asked:
        # A setpoint held back must not go on pushing outwards.
        velocity, acceleration = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    omega = room.slowed(as_point(m.omega), reasons, "body rate", 30.0)
    motion = room.motion(memory.vehicle)
    if motion is not None:
        slower = room.link_loss.full_state(motion, place, velocity, acceleration, omega)
        if slower is not None:
            reasons.append(OUT_IF_LOST)
            place, velocity, omega = slower
    if velocity[2] == 0.0 and acceleration[2] == 0.0:
        place = room.carried(place, memory, reasons)
    place = room.upright(place, memory, reasons, velocity, acceleration)
    yaw = room.facing(float(m.yaw), memory, now, reasons)
    if not reasons:
        return m, reasons
    return c.FullState(place, velocity, acceleration, yaw, omega), reasons


def position(
    room: Room, m: c.Position, memory: VehicleMemory, now: float
) -> tuple[c.Command, list[str]]:
    reasons: list[str] = []
    place = room.inside(as_point(m.position), memory.vehicle, reasons, "position")
    place = room.reachable(place, memory, now, reasons)
    place = room.carried(place, memory, reasons)
    place = room.upright(place, memory, reasons)
    motion = room.motion(memory.vehicle)
    if motion is not None:
        nearer = room.link_loss.position(motion, place)
        if nearer is not None:
            reasons.append(OUT_IF_LOST)
            place = nearer
    yaw = room.facing(float(m.yaw), memory, now, reasons)
    return (replace(m, position=place, yaw=yaw) if reasons else m), reasons


def velocity_world(
    room: Room, m: c.VelocityWorld, memory: VehicleMemory, now: float
) -> tuple[c.Command, list[str]]:
    if room.controller(memory.vehicle) == MELLINGER:
        raise memory.refusal(
            m,
            "Mellinger's controller follows no velocity, and the vehicle would fall; stream "
            "positions, or set stabilizer.controller to 1 in the vehicle list",
        )
    reasons: list[str] = []
    velocity = room.slowed(as_point(m.velocity), reasons, "speed", room.limits.setpoint_speed)
    where = room.where(memory.vehicle)
    if where is not None:
        velocity = room.near_fence(where, velocity, reasons)
    rate = room.turning(float(m.yaw_rate), memory, reasons)
    return (replace(m, velocity=velocity, yaw_rate=rate) if reasons else m), reasons


def hover(room: Room, m: c.Hover, memory: VehicleMemory, now: float) -> tuple[c.Command, list[str]]:
    reasons: list[str] = []
    level = (float(m.vx), float(m.vy), 0.0)
    velocity = room.slowed(level, reasons, "speed", room.limits.setpoint_speed)
    height = float(m.height)
    state = room.state(memory.vehicle)
    if state is not None:
        x, y, z = as_point(state.position)
        yaw = yaw_of(state.quaternion)
        cos, sin = math.cos(yaw), math.sin(yaw)
        world = (cos * velocity[0] - sin * velocity[1], sin * velocity[0] + cos * velocity[1])
        wx, wy, _ = room.near_fence((x, y, z), (*world, 0.0), reasons)
        velocity = (cos * wx + sin * wy, cos * wy - sin * wx, 0.0)
        height = room.inside((x, y, height), memory.vehicle, reasons, "height at")[2]
        if room.limits.vehicle.follows_velocity:  # others bound the speed of a climb on board
            lead = room.limits.setpoint_lead
            height = towards((x, y, z), (x, y, height), lead, "vehicle", reasons)[2]
        height = room.carried((x, y, height), memory, reasons)[2]
        height = room.upright((x, y, height), memory, reasons)[2]
    else:
        low, high = room.fence.bounds
        height = min(max(height, low[2]), high[2] - room.fence.soft_margin)
        if height != m.height:
            reasons.append(f"height {m.height:g} m is outside the fence")
    rate = room.turning(float(m.yaw_rate), memory, reasons)
    if not reasons:
        return m, reasons
    return replace(m, vx=velocity[0], vy=velocity[1], yaw_rate=rate, height=height), reasons
