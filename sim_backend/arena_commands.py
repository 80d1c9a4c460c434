"""What an ``arena`` vehicle does with a command that reaches it."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import CommandError
from crazyarena.sim_backend.arena_kernel import DT
from crazyarena.sim_backend.arena_params import YAW_MODE
from crazyarena.sim_backend.arena_rows import VehicleRows
from crazyarena.sim_backend.crtp.setpoints import compress_quaternion, decode_rpyt, decode_setpoint
from crazyarena.sim_backend.firmware import high_level, stack_2026
from crazyarena.sim_backend.firmware import supervisor as sv
from crazyarena.sim_backend.firmware.planner import PIECE_BYTES, TRAJECTORY_MEMORY_SIZE

_DEG = 180.0 / math.pi
_INT16 = 32767
_FULL_STATE = struct.Struct("<B9hI3h")
_POLY4D = 0


class Fleet(Protocol):
    """What a command touches of an ``ArenaFleet``; vehicles go by their index."""

    ids: tuple[int, ...]
    memory: NDArray[np.float64]
    trajectories: NDArray[np.uint8]

    def rows(self, vehicle: int) -> VehicleRows: ...
    def setpoint(self, vehicle: int, row: NDArray[np.float64]) -> None: ...
    def set_param(self, vehicle: int, name: str, value: float) -> None: ...
    def get_param(self, vehicle: int, name: str) -> float: ...
    def listen(self, vehicle: int, peers: frozenset[int] | None) -> None: ...


def execute(fleet: Fleet, vehicle: int, command: c.Command) -> int:
    """Let one vehicle execute a checked command; its answer, see ``ArenaFleet.send``."""
    return _HANDLERS[type(command)](fleet, vehicle, command)


def _takeoff(fleet: Fleet, vehicle: int, m: c.Takeoff) -> int:
    return _vertical(fleet, high_level.takeoff, vehicle, m)


def _land(fleet: Fleet, vehicle: int, m: c.Land) -> int:
    return _vertical(fleet, high_level.land, vehicle, m)


def _vertical(fleet: Fleet, kernel: Callable[..., int], vehicle: int, m: c.Takeoff | c.Land) -> int:
    yaw = 0.0 if m.yaw is None else float(m.yaw)
    planner = fleet.rows(vehicle).high_level
    now = _seconds(fleet, vehicle)
    return int(kernel(planner, float(m.height), float(m.duration), yaw, m.yaw is None, now))


def _seconds(fleet: Fleet, vehicle: int) -> float:
    return float(fleet.memory[vehicle, stack_2026.F_TICK]) * DT


def _go_to(fleet: Fleet, vehicle: int, m: c.GoTo) -> int:
    x, y, z = (float(value) for value in np.asarray(m.position, dtype=np.float64))
    return int(
        high_level.go_to(
            fleet.rows(vehicle).high_level,
            fleet.trajectories[vehicle],
            x,
            y,
            z,
            float(m.yaw),
            float(m.duration),
            bool(m.relative),
            False,
            _seconds(fleet, vehicle),
        )
    )


def _stop(fleet: Fleet, vehicle: int, m: c.Stop) -> int:
    return int(high_level.stop(fleet.rows(vehicle).high_level))


def _notify(fleet: Fleet, vehicle: int, m: c.NotifySetpointsStop) -> int:
    stack_2026.notify_setpoints_stop(fleet.memory[vehicle])
    return 0


def _packet(fleet: Fleet, vehicle: int, payload: bytes) -> int:
    # Through the packet and back, so that the vehicle sees the resolution of the protocol.
    row = decode_setpoint(payload)
    assert row is not None
    fleet.setpoint(vehicle, row)
    return 0


def _full_state(fleet: Fleet, vehicle: int, m: c.FullState) -> int:
    yaw = 0.5 * float(m.yaw)
    vectors = (m.position, m.velocity, m.acceleration, m.omega)
    milli = [_milli(float(value)) for vector in vectors for value in np.asarray(vector)]
    quaternion = compress_quaternion((0.0, 0.0, math.sin(yaw), math.cos(yaw)))
    return _packet(fleet, vehicle, _FULL_STATE.pack(6, *milli[:9], quaternion, *milli[9:]))


def _position(fleet: Fleet, vehicle: int, m: c.Position) -> int:
    position = np.asarray(m.position, dtype=np.float64)
    return _packet(fleet, vehicle, struct.pack("<Bffff", 7, *position, m.yaw * _DEG))


def _velocity(fleet: Fleet, vehicle: int, m: c.VelocityWorld) -> int:
    velocity = np.asarray(m.velocity, dtype=np.float64)
    return _packet(fleet, vehicle, struct.pack("<Bffff", 8, *velocity, m.yaw_rate * _DEG))


def _hover(fleet: Fleet, vehicle: int, m: c.Hover) -> int:
    payload = struct.pack("<Bffff", 10, m.vx, m.vy, m.yaw_rate * _DEG, m.height)
    return _packet(fleet, vehicle, payload)


def _attitude(fleet: Fleet, vehicle: int, m: c.Attitude) -> int:
    # Protocol 12's own packet for this has no thrust lock; the legacy one would need a
    # packet of zero thrust first.
    payload = struct.pack(
        "<BfffHB",
        11,
        m.roll * _DEG,
        -m.pitch * _DEG,
        m.yaw_rate * _DEG,
        int(min(max(m.thrust, 0), 65535)),
        0,
    )
    return _packet(fleet, vehicle, payload)


def _angles(fleet: Fleet, vehicle: int, m: c.RollPitchYawThrust) -> int:
    yaw = math.remainder(float(m.yaw), 2.0 * math.pi)
    payload = struct.pack(
        "<fffH",
        float(m.roll) * _DEG,
        -float(m.pitch) * _DEG,
        yaw * _DEG,
        int(min(max(m.thrust, 0), 65535)),
    )
    # Clients unlock the thrust before they stream.
    row = decode_rpyt(payload, yaw_angle=bool(fleet.get_param(vehicle, YAW_MODE)))
    assert row is not None
    fleet.setpoint(vehicle, row)
    return 0


def _cut_motors(fleet: Fleet, vehicle: int, m: c.CutMotors) -> int:
    return _packet(fleet, vehicle, b"\x00")


def _emergency(fleet: Fleet, vehicle: int, m: c.Emergency) -> int:
    fleet.rows(vehicle).supervisor[sv.SV_STOP] = 1.0
    return 0


def _arm(fleet: Fleet, vehicle: int, m: c.Arm) -> int:
    accepted = sv.supervisor_request_arming(fleet.rows(vehicle).supervisor, bool(m.arm))
    return 0 if accepted else 1


def _upload(fleet: Fleet, vehicle: int, m: c.UploadTrajectory) -> int:
    pieces = np.asarray(m.pieces, dtype=np.float64)
    # The vehicle's format: 32 coefficients, then the duration, float32.
    data = np.frombuffer(np.roll(pieces, -1, axis=1).astype("<f4").tobytes(), np.uint8)
    start = PIECE_BYTES * int(m.piece_offset)
    capacity = fleet.trajectories.shape[1]
    if start + len(data) > capacity:
        raise CommandError(
            f"vehicle {fleet.ids[vehicle]}: uploadTrajectory: {len(pieces)} pieces from piece "
            f"{m.piece_offset} on; the memory holds {capacity // PIECE_BYTES}"
        )
    fleet.trajectories[vehicle, start : start + len(data)] = data
    planner, ident = fleet.rows(vehicle).high_level, int(m.trajectory_id)
    if start + len(data) <= TRAJECTORY_MEMORY_SIZE:
        return int(high_level.define_trajectory(planner, ident, _POLY4D, start, len(pieces)))
    # Beyond what a vehicle has; the firmware judges only the id.
    answer = int(high_level.define_trajectory(planner, ident, _POLY4D, 0, 1))
    if answer == 0:
        high_level.place_trajectory(planner, ident, _POLY4D, start, len(pieces))
    return answer


def _start(fleet: Fleet, vehicle: int, m: c.StartTrajectory) -> int:
    return int(
        high_level.start_trajectory(
            fleet.rows(vehicle).high_level,
            fleet.trajectories[vehicle],
            int(m.trajectory_id),
            float(m.timescale),
            bool(m.relative),
            False,
            bool(m.reverse),
            _seconds(fleet, vehicle),
        )
    )


def _set_group_mask(fleet: Fleet, vehicle: int, m: c.SetGroupMask) -> int:
    return int(high_level.set_group_mask(fleet.rows(vehicle).high_level_params, int(m.group_mask)))


def _set_param(fleet: Fleet, vehicle: int, m: c.SetParam) -> int:
    fleet.set_param(vehicle, m.name, m.value)
    return 0


def _set_led(fleet: Fleet, vehicle: int, m: c.SetLed) -> int:
    for name, value in (("Red", m.red), ("Green", m.green), ("Blue", m.blue)):
        fleet.set_param(vehicle, f"ring.solid{name}", int(255 * min(max(value, 0.0), 1.0)))
    return 0


def _collision_avoidance(fleet: Fleet, vehicle: int, m: c.CollisionAvoidance) -> int:
    if m.enable:
        for axis, name in enumerate("XYZ"):
            fleet.set_param(vehicle, f"colAv.ellipsoid{name}", m.radii[axis])
            fleet.set_param(vehicle, f"colAv.bboxMin{name}", m.bbox_min[axis])
            fleet.set_param(vehicle, f"colAv.bboxMax{name}", m.bbox_max[axis])
        fleet.set_param(vehicle, "colAv.horizon", m.horizon)
        fleet.set_param(vehicle, "colAv.maxSpeed", m.max_speed)
        fleet.listen(vehicle, None if m.peers is None else frozenset(m.peers))
    fleet.set_param(vehicle, "colAv.enable", int(m.enable))
    return 0


def _milli(value: float) -> int:
    """Thousandths, truncated like the client does and limited to 16 bits."""
    return int(min(max(1000.0 * value, -_INT16 - 1), _INT16))


_HANDLERS: dict[type, Callable[..., int]] = {
    c.Takeoff: _takeoff,
    c.Land: _land,
    c.GoTo: _go_to,
    c.Stop: _stop,
    c.NotifySetpointsStop: _notify,
    c.FullState: _full_state,
    c.Position: _position,
    c.VelocityWorld: _velocity,
    c.Hover: _hover,
    c.Attitude: _attitude,
    c.CutMotors: _cut_motors,
    c.RollPitchYawThrust: _angles,
    c.Emergency: _emergency,
    c.Arm: _arm,
    c.UploadTrajectory: _upload,
    c.StartTrajectory: _start,
    c.SetGroupMask: _set_group_mask,
    c.SetParam: _set_param,
    c.SetLed: _set_led,
    c.CollisionAvoidance: _collision_avoidance,
}
