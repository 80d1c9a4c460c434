"""Commands as CRTP packets: the border where SI units become the firmware's own.

Layouts follow the public CRTP documentation, for the protocol version that the vehicle reports
(12 is the firmware of 2026, 4 that of 2022). Every number is checked here, in the caller's
thread, so that nothing can fail later in the thread that sends.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from cflib.utils.encoding import compress_quaternion

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import CommandError
from crazyarena.types import Pose, Vector

PORT_RPYT, PORT_LOCALIZATION, PORT_SETPOINT, PORT_HIGH_LEVEL = 3, 6, 7, 8
PORT_SUPERVISOR, PORT_PLATFORM, PORT_LINK = 9, 13, 15

# Protocol versions from which on a packet is understood.
_UNNEGATED_YAW_RATE = 9
_GO_TO_2 = 8
_START_2 = 10
_SUPERVISOR_PORT = 12
_MANUAL = 12

_STOP, _VELOCITY, _HOVER, _FULL_STATE, _POSITION = 0, 8, 10, 6, 7
_VELOCITY_OLD, _HOVER_OLD, _MANUAL_TYPE = 1, 5, 11
_EXT_POSE, _EXT_POSE_PACKED = 8, 9
_POSES_PER_PACKET, _POSITIONS_PER_PACKET = 2, 4

_INT16 = (-32768, 32767)
_FLOAT32_MAX = 3.4e38
PIECE_BYTES = 132


class Packet(NamedTuple):
    """Port, channel and payload (at most 30 bytes) of a packet to a vehicle."""

    port: int
    channel: int
    data: bytes


_UNLOCK = Packet(PORT_RPYT, 0, struct.pack("<fffH", 0.0, 0.0, 0.0, 0))


def _milli(where: str, field: str, values: Iterable[float]) -> list[int]:
    """Thousandths as int16, truncated like cflib truncates them."""
    found = [float(value) for value in values]
    scaled = [1000.0 * value for value in found]
    if not all(_INT16[0] - 1 < value < _INT16[1] + 1 for value in scaled):
        raise CommandError(
            f"{where}: {field} is {found}; the packet holds -32.768 to 32.767 per axis"
        )
    return [int(value) for value in scaled]


def _pack(where: str, layout: str, *values: Any) -> bytes:
    if any(isinstance(value, float) and not abs(value) <= _FLOAT32_MAX for value in values):
        raise CommandError(f"{where}: {values} does not fit into 32-bit floats")
    return struct.pack("<" + layout, *values)


def _three(value: Any) -> tuple[float, float, float]:
    x, y, z = (float(entry) for entry in np.asarray(value, dtype=np.float64))
    return x, y, z


def setpoint(command: c.Command, protocol: int, who: str) -> tuple[Packet, ...] | None:
    """Packets of a streamed setpoint; None if ``command`` is none.

    More than one only for attitudes in the legacy packet, whose thrust is locked until a packet of
    zero thrust has arrived: send the first only when the stream begins.

    Raises
    ------
    CommandError
        if a number does not fit into the packet, naming ``who`` and the field.
    """
    encode = _SETPOINTS.get(type(command))
    return None if encode is None else encode(command, protocol, who)


def _generic(data: bytes) -> tuple[Packet, ...]:
    return (Packet(PORT_SETPOINT, 0, data),)


def _full_state(m: c.FullState, protocol: int, who: str) -> tuple[Packet, ...]:
    where = f"{who}: cmdFullState"
    half = 0.5 * math.remainder(float(m.yaw), 2.0 * math.pi)
    return _generic(
        struct.pack(
            "<B9hI3h",
            _FULL_STATE,
            *_milli(where, "pos", _three(m.position)),
            *_milli(where, "vel", _three(m.velocity)),
            *_milli(where, "acc", _three(m.acceleration)),
            compress_quaternion((0.0, 0.0, math.sin(half), math.cos(half))),
            # The field is in millirad/s, whatever client documentation says.
            *_milli(where, "omega", _three(m.omega)),
        )
    )


def _position(m: c.Position, protocol: int, who: str) -> tuple[Packet, ...]:
    x, y, z = _three(m.position)
    yaw = math.degrees(float(m.yaw))
    return _generic(_pack(f"{who}: cmdPosition", "Bffff", _POSITION, x, y, z, yaw))


def _velocity(m: c.VelocityWorld, protocol: int, who: str) -> tuple[Packet, ...]:
    modern = protocol >= _UNNEGATED_YAW_RATE
    rate = math.degrees(float(m.yaw_rate)) * (1.0 if modern else -1.0)
    kind = _VELOCITY if modern else _VELOCITY_OLD
    x, y, z = _three(m.velocity)
    return _generic(_pack(f"{who}: cmdVelocityWorld", "Bffff", kind, x, y, z, rate))


def _hover(m: c.Hover, protocol: int, who: str) -> tuple[Packet, ...]:
    modern = protocol >= _UNNEGATED_YAW_RATE
    rate = math.degrees(float(m.yaw_rate)) * (1.0 if modern else -1.0)
    kind = _HOVER if modern else _HOVER_OLD
    values = (float(m.vx), float(m.vy), rate, float(m.height))
    return _generic(_pack(f"{who}: cmdHover", "Bffff", kind, *values))


def _attitude(m: c.Attitude, protocol: int, who: str) -> tuple[Packet, ...]:
    where = f"{who}: cmdVel"
    # On the wire positive pitch is nose up.
    roll, pitch = math.degrees(float(m.roll)), -math.degrees(float(m.pitch))
    rate, thrust = math.degrees(float(m.yaw_rate)), int(m.thrust)
    if protocol >= _MANUAL:
        return _generic(_pack(where, "BfffHB", _MANUAL_TYPE, roll, pitch, rate, thrust, 0))
    return _UNLOCK, Packet(PORT_RPYT, 0, _pack(where, "fffH", roll, pitch, -rate, thrust))


def _angles(m: c.RollPitchYawThrust, protocol: int, who: str) -> tuple[Packet, ...]:
    where = f"{who}: rollPitchYawThrust"
    # On the wire positive pitch is nose up; an angle of yaw is not negated as a rate is.
    roll, pitch = math.degrees(float(m.roll)), -math.degrees(float(m.pitch))
    yaw = math.degrees(math.remainder(float(m.yaw), 2.0 * math.pi))
    data = _pack(where, "fffH", roll, pitch, yaw, int(m.thrust))
    return _UNLOCK, Packet(PORT_RPYT, 0, data)


def _cut(m: c.CutMotors, protocol: int, who: str) -> tuple[Packet, ...]:
    return _generic(bytes((_STOP,)))


_SETPOINTS: dict[type, Any] = {
    c.FullState: _full_state,
    c.Position: _position,
    c.VelocityWorld: _velocity,
    c.Hover: _hover,
    c.Attitude: _attitude,
    c.CutMotors: _cut,
    c.RollPitchYawThrust: _angles,
}


def high_level(command: c.Command, protocol: int, who: str) -> Packet | None:
    """Packet of a command to the high-level commander; None if ``command`` is none.

    Raises
    ------
    CommandError
        if a number does not fit into the packet.
    """
    encode = _HIGH_LEVEL.get(type(command))
    return None if encode is None else Packet(PORT_HIGH_LEVEL, 0, encode(command, protocol, who))


def _vertical(number: int, name: str) -> Any:
    def encode(m: c.Takeoff | c.Land, protocol: int, who: str) -> bytes:
        yaw = 0.0 if m.yaw is None else float(m.yaw)
        keep = m.yaw is None
        values = (int(m.group_mask), float(m.height), yaw, keep, float(m.duration))
        return _pack(f"{who}: {name}", "BBff?f", number, *values)

    return encode


def _go_to(m: c.GoTo, protocol: int, who: str) -> bytes:
    goal = (*_three(m.position), float(m.yaw), float(m.duration))
    where, mask, relative = f"{who}: goTo", int(m.group_mask), int(bool(m.relative))
    if protocol >= _GO_TO_2:
        return _pack(where, "BBBBfffff", 12, mask, relative, 0, *goal)
    return _pack(where, "BBBfffff", 4, mask, relative, *goal)


def _stop(m: c.Stop, protocol: int, who: str) -> bytes:
    return bytes((3, int(m.group_mask)))


def _start(m: c.StartTrajectory, protocol: int, who: str) -> bytes:
    where, relative, reverse = f"{who}: startTrajectory", int(m.relative), int(m.reverse)
    mask, ident, scale = int(m.group_mask), int(m.trajectory_id), float(m.timescale)
    if protocol >= _START_2:
        return _pack(where, "BBBBBBf", 13, mask, relative, 0, reverse, ident, scale)
    return _pack(where, "BBBBBf", 5, mask, relative, reverse, ident, scale)


def _group(m: c.SetGroupMask, protocol: int, who: str) -> bytes:
    return bytes((0, int(m.group_mask)))


_HIGH_LEVEL: dict[type, Any] = {
    c.Takeoff: _vertical(7, "takeoff"),
    c.Land: _vertical(8, "land"),
    c.GoTo: _go_to,
    c.Stop: _stop,
    c.StartTrajectory: _start,
    c.SetGroupMask: _group,
}


def define_trajectory(ident: int, piece_offset: int, pieces: int) -> Packet:
    """Packet that declares uploaded pieces a trajectory."""
    data = struct.pack("<BBBBIB", 6, ident, 1, 0, PIECE_BYTES * piece_offset, pieces)
    return Packet(PORT_HIGH_LEVEL, 0, data)


def notify_setpoints_stop(remain_valid_ms: int = 0) -> Packet:
    """Packet that gives the vehicle back to its high-level commander."""
    return Packet(PORT_SETPOINT, 1, struct.pack("<BI", 0, int(remain_valid_ms) & 0xFFFFFFFF))


def _guard(modern: int, old: int, protocol: int) -> Packet:
    if protocol >= _SUPERVISOR_PORT:
        return Packet(PORT_SUPERVISOR, 1, bytes((modern,)))
    return Packet(PORT_LOCALIZATION, 1, bytes((old,)))


def emergency_stop(protocol: int) -> Packet:
    """Packet that stops the motors and locks the vehicle until reboot."""
    return _guard(3, 3, protocol)


def emergency_watchdog(protocol: int) -> Packet:
    """Packet that feeds the onboard emergency-stop watchdog."""
    return _guard(4, 4, protocol)


def arm(value: bool, protocol: int) -> Packet:
    """Arming request."""
    port, channel = (PORT_SUPERVISOR, 1) if protocol >= _SUPERVISOR_PORT else (PORT_PLATFORM, 0)
    return Packet(port, channel, bytes((1, int(value))))


def recover(protocol: int) -> Packet:
    """Request to recover from a crash."""
    port, channel = (PORT_SUPERVISOR, 1) if protocol >= _SUPERVISOR_PORT else (PORT_PLATFORM, 0)
    return Packet(port, channel, bytes((2,)))


def ping(number: int) -> Packet:
    """Echo request; the vehicle answers with the same bytes."""
    return Packet(PORT_LINK, 0, struct.pack("<BI", 0xCA, number & 0xFFFFFFFF))


def ping_number(data: bytes) -> int | None:
    """Number of an answered :func:`ping`, None for another echo."""
    if len(data) != 5 or data[0] != 0xCA:
        return None
    return int(struct.unpack("<BI", data)[1])


def _finite(position: Vector) -> bool:
    return bool(np.isfinite(position).all() and np.abs(position).max() < 1e3)


def external_position(position: Vector) -> Packet | None:
    """Measured position (3,) m for the estimator; None if it is not finite."""
    if not _finite(position):
        return None
    return Packet(PORT_LOCALIZATION, 0, struct.pack("<fff", *map(float, position)))


def external_pose(pose: Pose) -> Packet | None:
    """Measured pose for the estimator: its position alone if the quaternion is not finite, None
    if the position is not either."""
    norm = float(np.linalg.norm(pose.quaternion))
    if not math.isfinite(norm) or norm < 1e-6:
        return external_position(pose.position)
    if not _finite(pose.position):
        return None
    quaternion = (float(value) / norm for value in pose.quaternion)
    data = struct.pack("<B7f", _EXT_POSE, *map(float, pose.position), *quaternion)
    return Packet(PORT_LOCALIZATION, 1, data)


def _packable(pose: Pose) -> bool:
    norm = float(np.linalg.norm(pose.quaternion))
    inside = bool(np.abs(pose.position).max() <= 32.767) if _finite(pose.position) else False
    return inside and math.isfinite(norm) and norm > 1e-6


def packed_poses(poses: Sequence[tuple[int, Pose]]) -> tuple[Packet, ...]:
    """Poses of several vehicles by id, two in a packet, in mm; poses that do not fit are left
    out."""
    entries = [
        struct.pack(
            "<BhhhI",
            ident & 0xFF,
            *(round(1000.0 * float(value)) for value in pose.position),
            compress_quaternion(pose.quaternion),
        )
        for ident, pose in poses
        if _packable(pose)
    ]
    return tuple(
        Packet(
            PORT_LOCALIZATION,
            1,
            bytes((_EXT_POSE_PACKED,)) + b"".join(entries[k : k + _POSES_PER_PACKET]),
        )
        for k in range(0, len(entries), _POSES_PER_PACKET)
    )


def packed_positions(positions: Sequence[tuple[int, Vector]]) -> tuple[Packet, ...]:
    """Positions of several vehicles by id, four in a packet, in mm, for collision avoidance."""
    entries = [
        struct.pack("<Bhhh", ident & 0xFF, *(round(1000.0 * float(value)) for value in position))
        for ident, position in positions
        if _finite(position) and np.abs(position).max() <= 32.767
    ]
    return tuple(
        Packet(PORT_LOCALIZATION, 2, b"".join(entries[k : k + _POSITIONS_PER_PACKET]))
        for k in range(0, len(entries), _POSITIONS_PER_PACKET)
    )


def trajectory_bytes(pieces: Any) -> bytes:
    """Trajectory memory of pieces (n, 33): 32 coefficients, then the duration, float32.

    Raises
    ------
    CommandError
        if a number does not fit into 32-bit floats.
    """
    rows = np.roll(np.asarray(pieces, dtype=np.float64), -1, axis=1)
    if np.abs(rows).max() > _FLOAT32_MAX:
        raise CommandError("uploadTrajectory: a coefficient does not fit into 32-bit floats")
    return bytes(rows.astype("<f4").tobytes())
