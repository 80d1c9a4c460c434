"""Packets: cflib's own bytes where cflib has the verb, the firmware's meaning everywhere."""

import math
import struct

import numpy as np
import pytest
from cflib.crazyflie.commander import Commander
from cflib.crazyflie.high_level_commander import HighLevelCommander
from cflib.crazyflie.localization import Localization
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.checks import check
from crazyarena.crazyswarm_compat.radio import packets as pk
from crazyarena.errors import CommandError
from crazyarena.sim_backend.crtp.setpoints import decode_rpyt, decode_setpoint
from crazyarena.sim_backend.firmware import layout as la
from crazyarena.types import Pose


class Cflib:
    """Collects what cflib's own classes would send."""

    def __init__(self, protocol):
        self.platform = self
        self._protocol = protocol
        self.sent = []

    def get_protocol_version(self):
        return self._protocol

    def add_port_callback(self, port, callback):
        pass

    def send_packet(self, packet):
        self.sent.append(pk.Packet(packet.port, packet.channel, bytes(packet.data)))

    def take(self):
        return self.sent.pop()


def one(command, protocol=12):
    packets = pk.setpoint(command, protocol, "cf1")
    assert packets is not None
    return packets[-1]


small = st.floats(-30.0, 30.0)
triple = st.tuples(small, small, small)
angle = st.floats(-10.0, 10.0)
protocols = st.sampled_from([4, 8, 9, 10, 12])


class TestSameAsCflib:
    @given(triple, triple, triple, st.floats(-3.1, 3.1), triple)
    def test_full_state(self, pos, vel, acc, yaw, omega):
        cf = Cflib(12)
        quaternion = [0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]
        # cflib's text says deg/s, but the field is in millirad/s and cflib multiplies by 1000.
        Commander(cf).send_full_state_setpoint(pos, vel, acc, quaternion, *omega)
        assert one(c.FullState(pos, vel, acc, yaw, omega)) == cf.take()

    @pytest.mark.filterwarnings("ignore:Using legacy")
    @given(triple, angle, protocols)
    def test_other_streams(self, v, yaw, protocol):
        cf = Cflib(protocol)
        commander = Commander(cf)
        commander.send_position_setpoint(*v, math.degrees(yaw))
        assert one(c.Position(v, yaw), protocol) == cf.take()
        commander.send_velocity_world_setpoint(*v, math.degrees(yaw))
        assert one(c.VelocityWorld(v, yaw), protocol) == cf.take()
        commander.send_hover_setpoint(v[0], v[1], math.degrees(yaw), v[2])
        assert one(c.Hover(v[0], v[1], yaw, v[2]), protocol) == cf.take()
        commander.send_stop_setpoint()
        assert one(c.CutMotors(), protocol) == cf.take()
        commander.send_notify_setpoint_stop(70)
        assert pk.notify_setpoints_stop(70) == cf.take()

    @given(triple, angle, st.floats(0.1, 20.0), st.integers(0, 255), st.booleans(), protocols)
    def test_high_level(self, p, yaw, duration, mask, flag, protocol):
        cf = Cflib(protocol)
        commander = HighLevelCommander(cf)

        def ours(command):
            return pk.high_level(command, protocol, "cf1")

        heading = yaw if flag else None
        commander.takeoff(p[2], duration, mask, heading)
        assert ours(c.Takeoff(p[2], duration, heading, mask)) == cf.take()
        commander.land(p[2], duration, mask, heading)
        assert ours(c.Land(p[2], duration, heading, mask)) == cf.take()
        commander.go_to(*p, yaw, duration, relative=flag, group_mask=mask)
        assert ours(c.GoTo(p, yaw, duration, flag, mask)) == cf.take()
        commander.stop(mask)
        assert ours(c.Stop(mask)) == cf.take()
        commander.set_group_mask(mask)
        assert ours(c.SetGroupMask(mask)) == cf.take()
        commander.start_trajectory(3, duration, flag, False, not flag, mask)
        assert ours(c.StartTrajectory(3, duration, not flag, flag, mask)) == cf.take()
        commander.define_trajectory(3, 132 * 2, 5)
        assert pk.define_trajectory(3, 2, 5) == cf.take()

    @given(triple)
    def test_external_pose(self, p):
        cf = Cflib(12)
        quaternion = np.array([0.1, -0.2, 0.3, 0.9])
        quaternion /= np.linalg.norm(quaternion)
        Localization(cf).send_extpose(p, quaternion)
        assert pk.external_pose(Pose(np.array(p), quaternion)) == cf.take()
        Localization(cf).send_extpos(p)
        assert pk.external_position(np.array(p)) == cf.take()
        # Without an attitude the position alone is sent.
        assert pk.external_pose(Pose(np.array(p), np.full(4, math.nan))) == (
            pk.external_position(np.array(p))
        )


class TestMeaning:
    """What the firmware makes of them: signs as in the docstrings of the commands."""

    def row(self, command):
        packet = one(command)
        assert (packet.port, packet.channel) == (7, 0)
        return decode_setpoint(packet.data)

    def test_positive_yaw_rates_are_counter_clockwise(self):
        for command in (
            c.VelocityWorld([0.0, 0.0, 0.0], 0.5),
            c.Hover(0.0, 0.0, 0.5, 1.0),
            c.Attitude(0.0, 0.0, 0.5, 30000),
        ):
            assert self.row(command)[la.SP_RATE + 2] == pytest.approx(math.degrees(0.5), rel=1e-6)

    def test_positive_pitch_is_nose_down(self):
        # cflib takes the legacy sign, in which nose down is positive, and flips it.
        cf = Cflib(12)
        Commander(cf).send_setpoint_manual(5.0, 10.0, 20.0, 50.0, False)
        theirs = decode_setpoint(cf.take().data)
        thrust = int(10001 + 0.5 * (60000 - 10001))
        ours = self.row(c.Attitude(*np.radians([5.0, 10.0, 20.0]), thrust))
        np.testing.assert_allclose(ours, theirs, rtol=1e-6)

    def test_a_heading_goes_in_the_legacy_packet_as_theirs(self):
        cf = Cflib(12)
        Commander(cf).send_setpoint(5.0, 10.0, 170.0, 30000)
        theirs = cf.take().data
        unlock, command = pk.setpoint(
            c.RollPitchYawThrust(*np.radians([5.0, 10.0, 170.0 - 360.0]), 30000), 12, "cf1"
        )
        assert unlock == pk.Packet(3, 0, bytes(14))
        assert (command.port, command.channel) == (3, 0)
        assert struct.unpack("<fffH", command.data) == pytest.approx(
            struct.unpack("<fffH", theirs), rel=1e-6
        )
        angle, rate = decode_rpyt(command.data, yaw_angle=True), decode_rpyt(command.data)
        assert (angle[la.M_YAW], angle[la.SP_ATT + 2]) == pytest.approx((la.MODE_ABS, 170.0))
        assert (rate[la.M_YAW], rate[la.SP_RATE + 2]) == pytest.approx((la.MODE_VELOCITY, -170.0))
        assert angle[la.SP_THRUST] == 30000
        assert decode_rpyt(command.data, locked=True)[la.SP_THRUST] == 0

    def test_old_firmware_gets_its_thrust_unlocked_first(self):
        unlock, command = pk.setpoint(c.Attitude(0.1, 0.2, 0.3, 40000), 4, "cf1")
        assert unlock == pk.Packet(3, 0, bytes(14))
        roll, pitch, rate, thrust = struct.unpack("<fffH", command.data)
        # The old packet's yaw rate is clockwise on board.
        assert (roll, pitch, rate) == pytest.approx(np.degrees([0.1, -0.2, -0.3]))
        assert thrust == 40000

    def test_yaw_beyond_a_turn_is_the_same_heading(self):
        far, near = (
            one(c.FullState([0, 0, 1], [0, 0, 0], [0, 0, 0], yaw, [0, 0, 0]))
            for yaw in (0.3 + 4 * math.pi, 0.3)
        )
        assert far == near


class TestRanges:
    @pytest.mark.parametrize(
        ("field", "values"),
        [
            ("pos", ([0, 33.0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0])),
            ("vel", ([0, 0, 0], [-32.8, 0, 0], [0, 0, 0], [0, 0, 0])),
            ("acc", ([0, 0, 0], [0, 0, 0], [0, 0, 1e9], [0, 0, 0])),
            ("omega", ([0, 0, 0], [0, 0, 0], [0, 0, 0], [40.0, 0, 0])),
            ("omega", ([0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 1.7e308])),
        ],
    )
    def test_full_state_beyond_16_bits_names_vehicle_and_field(self, field, values):
        pos, vel, acc, omega = values
        with pytest.raises(CommandError, match=rf"cf7: cmdFullState: {field} is .*32\.7"):
            pk.setpoint(c.FullState(pos, vel, acc, 0.0, omega), 12, "cf7")

    def test_floats_beyond_32_bits(self):
        with pytest.raises(CommandError, match="cf7: cmdPosition"):
            pk.setpoint(c.Position([1e39, 0, 0]), 12, "cf7")
        with pytest.raises(CommandError, match="cf7: goTo"):
            pk.high_level(c.GoTo([0, 0, 1], 1e300, 1.0), 12, "cf7")

    number = st.floats(allow_nan=True, allow_infinity=True)
    any_triple = st.tuples(number, number, number)

    @given(
        st.one_of(
            st.builds(c.FullState, any_triple, any_triple, any_triple, number, any_triple),
            st.builds(c.Position, any_triple, number),
            st.builds(c.VelocityWorld, any_triple, number),
            st.builds(c.Hover, number, number, number, number),
            st.builds(c.Attitude, number, number, number, st.integers(-(10**6), 10**6)),
            st.builds(c.GoTo, any_triple, number, number, st.booleans(), st.integers(-9, 300)),
            st.builds(c.Takeoff, number, number, number, st.integers(-9, 300)),
        ),
        protocols,
    )
    def test_whatever_is_given_fits_into_a_packet_or_is_refused(self, command, protocol):
        try:
            check(command, "cf1")
            packets = pk.setpoint(command, protocol, "cf1") or (
                pk.high_level(command, protocol, "cf1"),
            )
        except CommandError:
            return
        for packet in packets:
            assert 1 <= len(packet.data) <= 30

    def test_measurements_that_are_not_finite_are_left_out(self):
        bad = Pose(np.array([0.0, math.nan, 0.0]))
        assert pk.external_pose(bad) is None
        assert pk.packed_poses([(1, bad)]) == ()
        assert pk.packed_positions([(1, bad.position), (2, np.array([40.0, 0, 0]))]) == ()


class TestPacked:
    def test_two_poses_in_a_packet_in_millimetres(self):
        poses = [(k, Pose(np.array([0.1 * k, -1.0, 2.0]))) for k in (1, 2, 300)]
        packets = pk.packed_poses(poses)
        assert [len(packet.data) for packet in packets] == [23, 12]
        assert packets[0].data[0] == 9
        ident, x, y, z = struct.unpack_from("<Bhhh", packets[0].data, 1)
        assert (ident, x, y, z) == (1, 100, -1000, 2000)
        assert packets[1].data[1] == 300 & 0xFF

    def test_four_positions_in_a_packet(self):
        packets = pk.packed_positions([(k, np.array([0.001 * k, 0, 0])) for k in range(5)])
        assert [(p.port, p.channel, len(p.data)) for p in packets] == [(6, 2, 28), (6, 2, 7)]
        assert struct.unpack_from("<Bhhh", packets[0].data, 7) == (1, 1, 0, 0)


class TestOldFirmware:
    """Protocol 4 (2022) has no supervisor port."""

    def test_ports(self):
        assert pk.emergency_stop(12) == pk.Packet(9, 1, b"\x03")
        assert pk.emergency_stop(4) == pk.Packet(6, 1, b"\x03")
        assert pk.emergency_watchdog(12) == pk.Packet(9, 1, b"\x04")
        assert pk.emergency_watchdog(4) == pk.Packet(6, 1, b"\x04")
        assert pk.arm(True, 12) == pk.Packet(9, 1, b"\x01\x01")
        assert pk.arm(False, 4) == pk.Packet(13, 0, b"\x01\x00")
        assert pk.recover(4) == pk.Packet(13, 0, b"\x02")
