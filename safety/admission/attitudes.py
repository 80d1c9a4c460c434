"""Setpoints that are attitudes: nothing in them says where the vehicle is to be.

Tilt, thrust and turning are bounded here. That the vehicle stays inside the fence is the
watchdog's business, which is told what was asked for (:meth:`.gate.CommandGate.pushed`) and takes
over in time; where it comes down if the link is lost is looked at here, too.
"""

from __future__ import annotations

import math
from dataclasses import replace

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.safety.admission.memory import VehicleMemory
from crazyarena.safety.admission.room import OUT_IF_LOST, Room
from crazyarena.safety.attitude_path import FULL, GRAVITY, push, tilt_of
from crazyarena.safety.observation import as_point, yaw_of

_STANDS = 0.12  # m, below which a vehicle may be let down however it comes
_GROUND = 0.05  # m
_SOFT = 1.0  # m/s, at which it may come down
_CATCH = 0.7  # share of what is left of the thrust that a fall is trusted to be caught with
_LEVEL = 0.3  # rad, up to which a vehicle leans that catches itself
_TURN_MEMORY = 0.5  # s after which the last heading no longer bounds the next


def attitude(
    room: Room, m: c.Attitude, memory: VehicleMemory, now: float
) -> tuple[c.Command, list[str]]:
    """With a rate of yaw: the heading is that of the vehicle."""
    reasons: list[str] = []
    state = room.state(memory.vehicle)
    yaw = 0.0 if state is None else yaw_of(state.quaternion)
    roll, pitch, thrust = _kept_up(room, memory, _bounded(room, m, memory, reasons), reasons)
    rate, most = float(m.yaw_rate), room.limits.setpoint_yaw_rate
    if abs(rate) > most:
        reasons.append(f"yaw rate of {rate:.2f} rad/s is above {most:g}")
        rate = math.copysign(most, rate)
    roll, pitch = _loss(room, memory, (roll, pitch, yaw, thrust), reasons)
    _note(room, memory, (roll, pitch, yaw, thrust), now)
    if not reasons:
        return m, reasons
    return replace(m, roll=roll, pitch=pitch, yaw_rate=rate, thrust=thrust), reasons


def angles(
    room: Room, m: c.RollPitchYawThrust, memory: VehicleMemory, now: float
) -> tuple[c.Command, list[str]]:
    """With a heading, which turns no faster than the limit lets a rate."""
    reasons: list[str] = []
    roll, pitch, thrust = _kept_up(room, memory, _bounded(room, m, memory, reasons), reasons)
    yaw = _turned(room, float(m.yaw), memory, now, reasons)
    roll, pitch = _loss(room, memory, (roll, pitch, yaw, thrust), reasons)
    _note(room, memory, (roll, pitch, yaw, thrust), now)
    if not reasons:
        return m, reasons
    return replace(m, roll=roll, pitch=pitch, yaw=yaw, thrust=thrust), reasons


def _bounded(
    room: Room, m: c.Attitude | c.RollPitchYawThrust, memory: VehicleMemory, reasons: list[str]
) -> tuple[float, float, int]:
    n = room.limits
    if not n.allow_attitude:
        raise memory.refusal(
            m,
            "attitude setpoints cannot be held inside a fence; the "
            "safety limit allow_attitude lets them pass",
        )
    roll, pitch = float(m.roll), float(m.pitch)
    inside = max(abs(roll), abs(pitch)) < 0.5 * math.pi
    tilt = math.acos(math.cos(roll) * math.cos(pitch)) if inside else math.inf
    if tilt > n.setpoint_tilt:
        reasons.append(
            f"tilt of roll {roll:.2f}, pitch {pitch:.2f} rad is above {n.setpoint_tilt:g}"
        )
        share = n.setpoint_tilt / math.hypot(roll, pitch)
        roll, pitch = share * roll, share * pitch
    thrust, most = int(m.thrust), int(n.setpoint_thrust * FULL)
    if thrust > most:
        reasons.append(f"thrust {thrust} is above {most}")
        thrust = most
    return roll, pitch, thrust


def _kept_up(
    room: Room, memory: VehicleMemory, asked: tuple[float, float, int], reasons: list[str]
) -> tuple[float, float, int]:
    """Roll, pitch and thrust with which a fall still ends before the ground.

    A vehicle that hits it fast no longer knows where it is, and flies anywhere.
    """
    roll, pitch, thrust = asked
    state = room.state(memory.vehicle)
    if state is None:
        return asked
    n = room.limits
    height, falling = float(state.position[2]), -float(state.velocity[2])
    if height < _STANDS:
        return asked
    down = -push(roll, pitch, 0.0, thrust, n)[2]
    t = n.link_delay + n.attitude_reaction
    left = height - _GROUND - falling * t - 0.5 * down * t * t
    falling += down * t
    catching = _CATCH * (n.setpoint_thrust * n.thrust_to_weight - 1.0) * GRAVITY
    if falling <= _SOFT or falling**2 - 2.0 * catching * left <= _SOFT**2:
        return asked
    reasons.append(f"it would hit the ground at more than {_SOFT:g} m/s")
    most = min(n.setpoint_tilt, _LEVEL)
    size = math.hypot(roll, pitch)
    if size > most:
        roll, pitch = roll * most / size, pitch * most / size
    return roll, pitch, int(n.setpoint_thrust * FULL)


def _turned(room: Room, yaw: float, memory: VehicleMemory, now: float, reasons: list[str]) -> float:
    """The heading, or as much of the way to it as the vehicle may turn since the last."""
    state = room.state(memory.vehicle)
    last, since = memory.heading
    age = now - since
    if age > _TURN_MEMORY:
        if state is None:
            return yaw
        last, age = yaw_of(state.quaternion), _TURN_MEMORY
    turn = math.remainder(yaw - last, 2.0 * math.pi)
    most = room.limits.setpoint_yaw_rate * age + 1e-3
    if abs(turn) <= most:
        return yaw
    reasons.append(
        f"heading {yaw:.2f} rad turns by {turn:.2f} in {age:.2f} s, at most {most:.2f} may be"
    )
    return math.remainder(last + math.copysign(most, turn), 2.0 * math.pi)


def _loss(
    room: Room, memory: VehicleMemory, asked: tuple[float, float, float, int], reasons: list[str]
) -> tuple[float, float]:
    """Roll and pitch that do not carry the vehicle too far out if the link were lost now."""
    roll, pitch, yaw, thrust = asked
    state = room.state(memory.vehicle)
    loss = room.attitude_loss
    if state is None or not loss.on:
        return roll, pitch
    pushed = push(roll, pitch, yaw, thrust, room.limits)
    place, moving = as_point(state.position), as_point(state.velocity)
    slower = loss.held_back(place, moving, pushed)
    if slower is None:
        return roll, pitch
    reasons.append(OUT_IF_LOST)
    lift = thrust / FULL * room.limits.thrust_to_weight * GRAVITY
    roll, pitch = tilt_of(*slower, yaw, lift)
    most = room.limits.setpoint_tilt
    size = math.hypot(roll, pitch)
    return (roll, pitch) if size <= most else (roll * most / size, pitch * most / size)


def _note(
    room: Room, memory: VehicleMemory, sent: tuple[float, float, float, int], now: float
) -> None:
    pushed = push(*sent, room.limits)

    def then() -> None:
        memory.pushed = pushed
        memory.heading = (sent[2], now)

    memory.then = then
