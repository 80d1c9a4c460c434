"""Decoding of setpoint packets (CRTP ports 3 and 7) into setpoint rows, and the compressed
quaternion of the protocol.

Payloads come without the header byte. A payload that is too short for its type decodes to None
and is to be dropped; surplus bytes are ignored. Signs and units are the firmware's own
(see :mod:`crazyarena.sim_backend.firmware.layout`).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence

import numpy as np

from crazyarena.sim_backend.firmware.layout import (
    M_PITCH,
    M_QUAT,
    M_ROLL,
    M_X,
    M_Y,
    M_YAW,
    M_Z,
    MODE_ABS,
    MODE_VELOCITY,
    SETPOINT_SIZE,
    SP_ACC,
    SP_ATT,
    SP_BODY,
    SP_POS,
    SP_QUAT,
    SP_RATE,
    SP_THRUST,
    SP_VEL,
)

Row = np.ndarray

_FOUR = struct.Struct("<ffff")
_CPPM = struct.Struct("<BHHHH")
_FULL_STATE = struct.Struct("<hhhhhhhhhIhhh")
_MANUAL = struct.Struct("<fffHB")
_RPYT = struct.Struct("<fffH")

_MILLI_TO_DEG = 180.0 / math.pi / 1000.0
_QUATERNION_SCALE = 511.0 * math.sqrt(2.0)
_MIN_THRUST, _MAX_THRUST = 1000, 60000


def compress_quaternion(quaternion: Sequence[float]) -> int:
    """Pack a unit quaternion (x, y, z, w) into 32 bits, ten per component but the largest."""
    q = [float(value) for value in quaternion]
    largest = max(range(4), key=lambda i: abs(q[i]))
    negative = q[largest] < 0.0
    packed = largest
    for i in range(4):
        if i != largest:
            magnitude = min(int(_QUATERNION_SCALE * abs(q[i]) + 0.5), 511)
            packed = packed << 10 | ((q[i] < 0.0) != negative) << 9 | magnitude
    return packed


def decompress_quaternion(packed: int) -> np.ndarray:
    """Unpack 32 bits into x, y, z, w; the largest component comes out positive."""
    largest = packed >> 30 & 3
    q = np.zeros(4)
    rest = 1.0
    for i in (3, 2, 1, 0):
        if i == largest:
            continue
        value = (packed & 511) / _QUATERNION_SCALE
        rest -= value * value
        q[i] = -value if packed & 512 else value
        packed >>= 10
    # Random bits can hold more than a unit vector has.
    q[largest] = math.sqrt(max(rest, 0.0))
    return q


def _modes(row: Row, x: float, y: float, z: float, roll: float, pitch: float, yaw: float) -> None:
    row[[M_X, M_Y, M_Z, M_ROLL, M_PITCH, M_YAW]] = x, y, z, roll, pitch, yaw


def _stop(row: Row, data: bytes) -> None:
    pass


def _velocity_world(sign: float) -> Callable[[Row, bytes], None]:
    def decode(row: Row, data: bytes) -> None:
        vx, vy, vz, yaw_rate = _FOUR.unpack_from(data)
        _modes(row, MODE_VELOCITY, MODE_VELOCITY, MODE_VELOCITY, 0, 0, MODE_VELOCITY)
        row[SP_VEL : SP_VEL + 3] = vx, vy, vz
        row[SP_RATE + 2] = sign * yaw_rate

    return decode


def _z_distance(sign: float) -> Callable[[Row, bytes], None]:
    def decode(row: Row, data: bytes) -> None:
        roll, pitch, yaw_rate, z = _FOUR.unpack_from(data)
        _modes(row, 0, 0, MODE_ABS, MODE_ABS, MODE_ABS, MODE_VELOCITY)
        row[SP_ATT : SP_ATT + 2] = roll, pitch
        row[SP_RATE + 2] = sign * yaw_rate
        row[SP_POS + 2] = z

    return decode


def _hover(sign: float) -> Callable[[Row, bytes], None]:
    def decode(row: Row, data: bytes) -> None:
        vx, vy, yaw_rate, z = _FOUR.unpack_from(data)
        _modes(row, MODE_VELOCITY, MODE_VELOCITY, MODE_ABS, 0, 0, MODE_VELOCITY)
        row[SP_VEL : SP_VEL + 2] = vx, vy
        row[SP_RATE + 2] = sign * yaw_rate
        row[SP_POS + 2] = z
        row[SP_BODY] = 1.0

    return decode


def _cppm(row: Row, data: bytes) -> None:
    flags, *channels = _CPPM.unpack_from(data)
    roll, pitch, yaw, thrust = ((channel - 1500) / 500.0 for channel in channels)
    auxiliary = flags & 0x0F
    rates = False
    if auxiliary >= 1:
        (switch,) = struct.unpack_from("<H", data, _CPPM.size)
        rates = switch < 1500
    if rates:
        _modes(row, 0, 0, 0, MODE_VELOCITY, MODE_VELOCITY, MODE_VELOCITY)
        row[SP_RATE : SP_RATE + 2] = -720.0 * roll, -720.0 * pitch
    else:
        _modes(row, 0, 0, 0, MODE_ABS, MODE_ABS, MODE_VELOCITY)
        row[SP_ATT : SP_ATT + 2] = -50.0 * roll, -50.0 * pitch
    row[SP_RATE + 2] = -400.0 * yaw
    row[SP_THRUST] = (thrust + 1.0) / 2.0 * 65535.0


def _altitude_hold(row: Row, data: bytes) -> None:
    roll, pitch, yaw_rate, vz = _FOUR.unpack_from(data)
    _modes(row, 0, 0, MODE_VELOCITY, MODE_ABS, MODE_ABS, MODE_VELOCITY)
    row[SP_ATT : SP_ATT + 2] = roll, pitch
    row[SP_RATE + 2] = yaw_rate
    row[SP_VEL + 2] = vz


def _full_state(row: Row, data: bytes) -> None:
    values = _FULL_STATE.unpack_from(data)
    _modes(row, MODE_ABS, MODE_ABS, MODE_ABS, 0, 0, 0)
    row[M_QUAT] = MODE_ABS
    for offset, start in ((SP_POS, 0), (SP_VEL, 3), (SP_ACC, 6)):
        row[offset : offset + 3] = [value / 1000.0 for value in values[start : start + 3]]
    row[SP_QUAT : SP_QUAT + 4] = decompress_quaternion(values[9])
    row[SP_RATE : SP_RATE + 3] = [value * _MILLI_TO_DEG for value in values[10:13]]


def _position(row: Row, data: bytes) -> None:
    x, y, z, yaw = _FOUR.unpack_from(data)
    _modes(row, MODE_ABS, MODE_ABS, MODE_ABS, 0, 0, MODE_ABS)
    row[SP_POS : SP_POS + 3] = x, y, z
    row[SP_ATT + 2] = yaw


def _manual(row: Row, data: bytes) -> None:
    roll, pitch, yaw_rate, thrust, rates = _MANUAL.unpack_from(data)
    if rates:
        _modes(row, 0, 0, 0, MODE_VELOCITY, MODE_VELOCITY, MODE_VELOCITY)
        row[SP_RATE : SP_RATE + 2] = roll, pitch
    else:
        _modes(row, 0, 0, 0, MODE_ABS, MODE_ABS, MODE_VELOCITY)
        row[SP_ATT : SP_ATT + 2] = roll, pitch
    row[SP_RATE + 2] = yaw_rate
    row[SP_THRUST] = thrust


_DECODERS: dict[int, Callable[[Row, bytes], None]] = {
    0: _stop,
    1: _velocity_world(-1.0),
    2: _z_distance(-1.0),
    3: _cppm,
    4: _altitude_hold,
    5: _hover(-1.0),
    6: _full_state,
    7: _position,
    8: _velocity_world(1.0),
    9: _z_distance(1.0),
    10: _hover(1.0),
    11: _manual,
}


def decode_setpoint(payload: bytes) -> Row | None:
    """Decode a port 7 channel 0 payload to a setpoint row.

    Returns
    -------
    Row of SETPOINT_SIZE without a time stamp; the null row for an unknown type; None when the
    payload is empty or too short for its type.
    """
    if not payload:
        return None
    row = np.zeros(SETPOINT_SIZE)
    decoder = _DECODERS.get(payload[0])
    if decoder is not None:
        try:
            decoder(row, payload[1:])
        except struct.error:
            return None
    return row


def decode_notify(payload: bytes) -> int | None:
    """Milliseconds of a port 7 channel 1 "setpoints stop" packet; None for anything else."""
    if len(payload) < 5 or payload[0] != 0:
        return None
    return int(struct.unpack_from("<I", payload, 1)[0])


def decode_rpyt(payload: bytes, yaw_angle: bool = False, locked: bool = False) -> Row | None:
    """Decode a port 3 payload; None if it is too short.

    ``yaw_angle``: the third number is a heading (``flightmode.stabModeYaw`` is 1), not a rate.
    ``locked``: no thrust is let through.
    """
    if len(payload) < _RPYT.size:
        return None
    roll, pitch, yaw, thrust = _RPYT.unpack_from(payload)
    row = np.zeros(SETPOINT_SIZE)
    _modes(row, 0, 0, 0, MODE_ABS, MODE_ABS, MODE_ABS if yaw_angle else MODE_VELOCITY)
    row[SP_ATT : SP_ATT + 2] = roll, pitch
    if yaw_angle:
        row[SP_ATT + 2] = yaw
    else:
        row[SP_RATE + 2] = -yaw
    row[SP_THRUST] = 0 if locked or thrust < _MIN_THRUST else min(thrust, _MAX_THRUST)
    return row


class RpytDecoder:
    """Port 3 packets: attitude, yaw and thrust, with the thrust lock of one vehicle.

    Thrust stays locked at 0 after boot, and again whenever no source is active (priority 0),
    until a packet with zero thrust arrives.
    """

    def __init__(self) -> None:
        self.locked = True

    def decode(self, payload: bytes, priority: int, yaw_angle: bool = False) -> Row | None:
        """Decode a payload; ``priority`` is the commander's present one. None if too short.

        ``yaw_angle``: as for :func:`decode_rpyt`.
        """
        if len(payload) < _RPYT.size:
            return None
        if priority == 0:
            self.locked = True
        if _RPYT.unpack_from(payload)[3] == 0:
            self.locked = False
        return decode_rpyt(payload, yaw_angle, self.locked)
