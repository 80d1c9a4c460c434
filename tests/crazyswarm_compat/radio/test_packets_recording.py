"""Our packets against those that a real firmware accepted from a real client."""

import json
import struct

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.radio import packets as pk
from tests.recorded import folder


def conversations():
    """Recorded conversations: lines [seconds, direction, hex]."""
    for path in sorted(folder("firmware_recordings").glob("*.jsonl")):
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        if rows and len(rows[0]) == 3 and rows[0][1] in "<>":
            yield rows


def sent(port, channel):
    """Payloads that clients sent to a port and channel."""
    for rows in conversations():
        for _, direction, text in rows:
            data = bytes.fromhex(text)
            if direction == ">" and data[0] >> 4 == port and data[0] & 3 == channel:
                yield data[1:]


def again(data):
    """The command behind a payload, encoded by us; None for those we never send."""
    number = data[0]
    if number in (7, 8) and len(data) == 15:
        mask, height, yaw, keep, duration = struct.unpack("<Bff?f", data[1:])
        kind = c.Takeoff if number == 7 else c.Land
        command = kind(height, duration, None if keep else yaw, mask)
    elif number == 12:
        mask, relative, linear, x, y, z, yaw, duration = struct.unpack("<BBBfffff", data[1:])
        if linear:
            return None
        command = c.GoTo([x, y, z], yaw, duration, bool(relative), mask)
    elif number == 13:
        mask, relative, turn, reverse, ident, scale = struct.unpack("<BBBBBf", data[1:])
        if turn:
            return None
        command = c.StartTrajectory(ident, scale, bool(reverse), bool(relative), mask)
    elif number == 6:
        ident, location, kind, offset, pieces = struct.unpack("<BBBIB", data[1:])
        if (location, kind) != (1, 0):
            return None
        return pk.define_trajectory(ident, offset // pk.PIECE_BYTES, pieces)
    elif number == 3:
        command = c.Stop(data[1])
    elif number == 0:
        command = c.SetGroupMask(data[1])
    else:
        return None
    return pk.high_level(command, 12, "cf1")


def test_high_level_commands():
    seen = set()
    for data in sent(pk.PORT_HIGH_LEVEL, 0):
        packet = again(data)
        if packet is not None:
            assert packet.data == data
            seen.add(data[0])
    if not seen:
        pytest.skip("no conversation with high-level commands here")


def test_streamed_setpoints():
    seen = 0
    for data in sent(pk.PORT_SETPOINT, 0):
        kind = data[0]
        if kind == 6 and len(data) == 29:
            values = struct.unpack("<9hI3h", data[1:])
            # Half a unit up, so that truncation gives the same again.
            milli = np.array([*values[:9], *values[10:]], dtype=float)
            x = (milli + 0.5 * np.sign(milli)) / 1000.0
            command = c.FullState(x[:3], x[3:6], x[6:9], 0.0, x[9:])
            (packet,) = pk.setpoint(command, 12, "cf1")
            assert packet.data[:19] + packet.data[23:] == data[:19] + data[23:]
        elif kind in (7, 8, 10) and len(data) == 17:
            a, b, third, fourth = struct.unpack("<ffff", data[1:])
            turn = np.radians(third if kind == 10 else fourth)
            command = c.Hover(a, b, turn, fourth)
            if kind != 10:
                verb = c.Position if kind == 7 else c.VelocityWorld
                command = verb([a, b, third], turn)
            (packet,) = pk.setpoint(command, 12, "cf1")
            assert packet.data[0] == kind
            ours = struct.unpack("<ffff", packet.data[1:])
            assert ours == pytest.approx((a, b, third, fourth), rel=1e-6, abs=1e-9)
        elif kind == 0 and len(data) == 1:
            (packet,) = pk.setpoint(c.CutMotors(), 12, "cf1")
            assert packet.data == data
        else:
            continue
        seen += 1
    if not seen:
        pytest.skip("no conversation with streamed setpoints here")


def test_the_answer_to_a_high_level_command_is_where_we_look_for_it():
    """Command number first, result in the fourth byte."""
    seen = 0
    for rows in conversations():
        commands = set()
        for _, direction, text in rows:
            data = bytes.fromhex(text)
            if data[0] >> 4 != pk.PORT_HIGH_LEVEL:
                continue
            if direction == ">":
                commands.add(data[1])
            else:
                assert len(data) == 5
                assert data[1] in commands
                assert data[4] in (0, 1, 2, 8, 16)
                seen += 1
    if not seen:
        pytest.skip("no conversation with high-level commands here")
