"""The arena fleet: flying, commands, parameters, links, determinism."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import BackendError, CommandError
from crazyarena.sim_backend.arena import ArenaFleet, SensorNoise
from crazyarena.sim_backend.arena_params import YAW_MODE
from crazyarena.sim_backend.firmware import layout as la
from crazyarena.sim_backend.firmware import stack_2026
from crazyarena.sim_backend.firmware import supervisor as sv
from crazyarena.sim_backend.physics.arena_plant import AB_REST, AB_VOLTS
from crazyarena.sim_backend.physics.scene import build_scene, ground_code
from crazyarena.sim_backend.trace import (
    NO_CONTACT,
    TR_ACTION,
    TR_CONTACT,
    TR_POS,
    TR_SETPOINT,
    TR_TIME,
    TRACE_SIZE,
)
from crazyarena.types import Pose

PID, MELLINGER = 1, 2


def fly(fleet, seconds, each=None):
    """Pass time with ideal external poses at 100 Hz; positions (frames, n, 3)."""
    track = []
    for _ in range(round(100 * seconds)):
        fleet.external_poses({i: fleet.true_pose(i) for i in range(len(fleet))})
        if each is not None:
            each(fleet.time)
        fleet.advance(10)
        track.append(fleet.bodies[:, :3].copy())
    return np.array(track)


def ready(positions=((0.0, 0.0, 0.0),), controller=MELLINGER, mass=0.0319, **options):
    fleet = ArenaFleet(positions, **options)
    for i in range(len(fleet)):
        fleet.set_param(i, "stabilizer.controller", controller)
        fleet.set_param(i, "ctrlMel.mass", mass)
    fly(fleet, 1.0)
    return fleet


def airborne(height=1.0, **options):
    fleet = ready(**options)
    for i in range(len(fleet)):
        assert fleet.send(c.Takeoff(height, 1.5), i) == 0
    fly(fleet, 2.5)
    return fleet


@pytest.mark.parametrize(("controller", "vertical"), [(PID, 0.1), (MELLINGER, 0.02)])
def test_takes_off_hovers_goes_and_lands(controller, vertical):
    fleet = ready(controller=controller)
    assert fleet.bodies[0, 2] < 0.02
    fleet.send(c.Takeoff(1.0, 2.0), 0)
    track = fly(fleet, 6.0)[300:, 0]
    assert np.abs(track[:, :2]).max() < 0.01
    # The PID's integrator is slow, as on the vehicle.
    assert np.abs(track[:, 2] - 1.0).max() < vertical
    fleet.send(c.GoTo([1.0, -0.5, 1.3], 1.0, 2.0), 0)
    track = fly(fleet, 5.0)[450:, 0]
    assert np.abs(track[:, :2] - (1.0, -0.5)).max() < 0.02
    state = fleet.telemetry(0).state
    assert 2 * np.arctan2(state.quaternion[2], state.quaternion[3]) == pytest.approx(1.0, abs=0.03)
    np.testing.assert_allclose(state.position, fleet.true_state(0).position, atol=0.01)
    fleet.send(c.Land(0.0, 2.0), 0)
    fly(fleet, 3.0)
    assert fleet.bodies[0, 2] < 0.02
    assert (fleet.rows(0).motors == 0.0).all()


def test_tracks_a_streamed_circle_within_centimetres():
    fleet = airborne()
    begin = fleet.time
    error = []

    def each(now):
        t = now - begin
        ease = min(t / 2.0, 1.0)
        rate = 1.5 * ease
        angle = 1.5 * (0.25 * t * t if t < 2.0 else t - 1.0)
        arc = np.array([np.cos(angle), np.sin(angle), 0.0])
        side = np.array([-arc[1], arc[0], 0.0])
        centre = np.array([-0.5, 0.0, 1.0])
        acceleration = -0.5 * rate * rate * arc + (0.5 * 0.75 * side if t < 2.0 else 0.0)
        fleet.send(
            c.FullState(centre + 0.5 * arc, 0.5 * rate * side, acceleration, 0.0, [0, 0, 0]), 0
        )
        error.append(np.linalg.norm(fleet.bodies[0, :3] - centre - 0.5 * arc))

    fly(fleet, 8.0, each)
    assert max(error) < 0.07


def test_stream_silence_levels_out_then_locks():
    fleet = airborne()
    setpoint = c.Position([0, 0, 1])
    fly(fleet, 0.5, lambda _: fleet.send(setpoint, 0))
    last = fleet.time - 0.01
    fly(fleet, 0.45)
    assert fleet.rows(0).setpoint[la.M_X] == la.MODE_ABS
    fly(fleet, 0.12)
    assert fleet.rows(0).setpoint[la.M_X] == la.MODE_DISABLE
    assert fleet.rows(0).setpoint[la.M_Z] == la.MODE_ABS
    while fleet.supervisor_info(0) & sv.INFO_CAN_FLY:
        fly(fleet, 0.01)
    assert 2.0 < fleet.time - last <= 2.06
    fly(fleet, 0.1)
    assert fleet.supervisor_info(0) & sv.INFO_LOCKED
    assert fleet.send(c.Takeoff(1.0, 1.0), 0) == 16
    assert fleet.send(c.Arm(), 0) == 1
    fleet.recover(0)
    fly(fleet, 2.0)
    assert fleet.bodies[0, 2] < 0.1
    fleet.reboot(0)
    fly(fleet, 1.0)
    assert fleet.supervisor_info(0) & sv.INFO_CAN_FLY


def test_streamed_setpoints_outrank_the_planner_until_notified():
    fleet = airborne()
    fly(fleet, 0.2, lambda _: fleet.send(c.Position([0, 0, 1]), 0))
    fleet.send(c.GoTo([0.3, 0, 1], 0.0, 0.5), 0)
    fly(fleet, 0.3)
    assert fleet.rows(0).setpoint[la.SP_POS] == 0.0
    fleet.send(c.GoTo([0.3, 0, 1], 0.0, 1.0), 0)
    fleet.send(c.NotifySetpointsStop(), 0)
    fly(fleet, 3.0)
    assert fleet.bodies[0, 0] == pytest.approx(0.3, abs=0.03)


def test_notify_without_a_plan_cuts_the_motors():
    fleet = airborne()
    fly(fleet, 0.2, lambda _: fleet.send(c.Position([0, 0, 1]), 0))
    fleet.send(c.NotifySetpointsStop(), 0)
    fleet.advance(20)
    assert (fleet.rows(0).motors == 0.0).all()


def test_emergency_and_watchdog_and_disarming_stop_the_motors():
    for action, seconds in (
        (lambda f: f.send(c.Emergency(), 0), 0.05),
        (lambda f: f.emergency_watchdog(0), 1.05),
        (lambda f: f.send(c.Arm(False), 0), 0.05),
        (lambda f: f.send(c.CutMotors(), 0), 0.02),
        (lambda f: f.send(c.Stop(), 0), 0.02),
        (lambda f: f.send(c.SetParam("stabilizer.stop", 1), 0), 0.05),
    ):
        fleet = airborne(height=0.5)
        assert fleet.rows(0).motors.min() > 0.0
        action(fleet)
        fly(fleet, seconds)
        assert (fleet.rows(0).motors == 0.0).all()


def test_attitude_velocity_and_hover_streams():
    fleet = airborne()
    fly(fleet, 1.0, lambda _: fleet.send(c.VelocityWorld([0.3, 0.0, 0.0], 0.5), 0))
    assert fleet.rows(0).setpoint[la.SP_RATE + 2] == pytest.approx(np.rad2deg(0.5))
    fleet = airborne(controller=PID)
    fly(fleet, 2.0, lambda _: fleet.send(c.VelocityWorld([0.0, 0.3, 0.0], 0.5), 0))
    assert fleet.true_state(0).velocity[1] == pytest.approx(0.3, abs=0.1)
    assert fleet.true_state(0).angular_velocity[2] == pytest.approx(0.5, abs=0.05)
    fly(fleet, 2.0, lambda _: fleet.send(c.Hover(0.0, 0.0, 0.0, 0.8), 0))
    assert fleet.bodies[0, 2] == pytest.approx(0.8, abs=0.1)
    fleet = airborne(controller=PID)
    pitched = c.Attitude(0.0, 0.2, 0.0, 42000)
    fly(fleet, 0.4, lambda _: fleet.send(pitched, 0))
    assert fleet.true_state(0).velocity[0] > 0.3


def test_the_legacy_attitude_turns_to_a_heading_where_a_parameter_says_so():
    for mode, wanted in ((1, 0.5), (0, -0.5)):
        fleet = airborne()
        fleet.set_param(0, YAW_MODE, mode)
        told = c.RollPitchYawThrust(0.0, 0.1, 0.5, 36000)
        fly(fleet, 1.0, lambda _, fleet=fleet, told=told: fleet.send(told, 0))
        x, y, z, w = fleet.true_state(0).quaternion
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        # As a rate it is one in degrees a second, and clockwise.
        assert yaw == pytest.approx(wanted, abs=0.1)
        # Nose down leads ahead.
        assert fleet.true_state(0).velocity[0] > 0.3


def test_uploaded_trajectory_is_flown():
    piece = np.zeros(33)
    piece[0] = 2.0
    # x from 0 to 1 m in 2 s, at rest at both ends: 35 s^4 - 84 s^5 + 70 s^6 - 20 s^7.
    piece[1:9] = np.array([0, 0, 0, 0, 35, -84, 70, -20]) / 2.0 ** np.arange(8)
    fleet = airborne()
    assert fleet.send(c.UploadTrajectory(1, 0, piece[None]), 0) == 0
    assert fleet.send(c.StartTrajectory(1), 0) == 0
    fly(fleet, 3.0)
    assert fleet.bodies[0, 0] == pytest.approx(1.0, abs=0.04)
    assert fleet.bodies[0, 2] == pytest.approx(1.0, abs=0.03)
    with pytest.raises(CommandError, match="piece"):
        fleet.send(c.UploadTrajectory(1, 31, piece[None]), 0)


def test_group_masks_address_vehicles():
    fleet = ready([[0, 0, 0], [1, 0, 0]])
    fleet.send(c.SetGroupMask(2), 1)
    for i in range(2):
        fleet.send(c.Takeoff(0.5, 1.0, group_mask=2), i)
    fly(fleet, 1.5)
    assert fleet.bodies[0, 2] < 0.02
    assert fleet.bodies[1, 2] > 0.4


def test_parameters_have_types_and_live_effect():
    fleet = airborne()
    assert fleet.get_param(0, "stabilizer.controller") == MELLINGER
    assert fleet.get_param(0, "ctrlMel.kp_z") == 1.25
    with pytest.raises(BackendError, match="nosuch"):
        fleet.get_param(0, "nosuch.param")
    with pytest.raises(CommandError, match="uint8"):
        fleet.set_param(0, "stabilizer.controller", 256)
    fleet.send(c.SetLed(1.0, 0.5, 0.0), 0)
    assert fleet.get_param(0, "ring.solidRed") == 255
    fleet.set_param(0, "ctrlMel.mass", 0.028)
    fly(fleet, 1.0)
    # A vehicle that thinks it is lighter hangs lower, by the missing force over kp.
    assert fleet.bodies[0, 2] < 0.98


def test_switching_controllers_in_flight_keeps_flying():
    fleet = airborne()
    for controller in (PID, MELLINGER, PID):
        fleet.set_param(0, "stabilizer.controller", controller)
        track = fly(fleet, 2.0)[:, 0]
        assert np.abs(track[:, :2]).max() < 0.05
        assert np.abs(track[:, 2] - 1.0).max() < 0.3


def test_collision_avoidance_keeps_vehicles_apart():
    fleet = airborne(positions=[[-1.0, 0, 0], [1.0, 0, 0]])
    for i in range(2):
        fleet.send(c.CollisionAvoidance(True, horizon=1.0, max_speed=0.5), i)
    fleet.send(c.GoTo([1.0, 0, 1], 0.0, 4.0), 0)
    fleet.send(c.GoTo([-1.0, 0, 1], 0.0, 4.0), 1)
    track = fly(fleet, 5.0)
    # The ellipsoids are 0.3 m in radius, so centres stay about 0.6 m apart.
    assert np.linalg.norm(track[:, 0] - track[:, 1], axis=1).min() > 0.5


def test_external_poses_take_their_time_and_get_lost():
    fleet = ArenaFleet([[0.5, 0.0, 0.0]])
    pose = Pose(np.array([0.5, 0.0, 0.0135]), np.array([0.0, 0, 0, 1]))
    fleet.external_pose(0, pose, latency=0.05)
    fleet.advance(49)
    assert fleet.telemetry(0).state.position[0] == pytest.approx(0.0, abs=1e-9)
    fleet.advance(1)
    assert fleet.telemetry(0).state.position[0] == pytest.approx(0.5, abs=1e-3)
    sent = [fleet.external_pose(0, pose, latency=1.0) for _ in range(25)]
    assert sent == [True] * 20 + [False] * 5


def test_external_position_alone_is_enough_to_hover():
    fleet = airborne()
    for _ in range(300):
        fleet.external_position(0, fleet.bodies[0, :3])
        fleet.advance(10)
    assert np.abs(fleet.bodies[0, :3] - (0, 0, 1)).max() < 0.05


def test_a_parked_vehicle_sleeps_and_wakes():
    fleet = ready()
    assert fleet.bodies[0, AB_REST] > 0
    still = fleet.bodies[0].copy()
    fly(fleet, 0.5)
    np.testing.assert_array_equal(fleet.bodies[0], still)
    fleet.send(c.Takeoff(0.5, 1.0), 0)
    fly(fleet, 1.5)
    assert fleet.bodies[0, 2] > 0.4


def test_a_vehicle_falls_when_what_it_lay_on_is_taken_away():
    gate = [[0, 0, 0, 0, 0, 0, 0]]
    fleet = ArenaFleet([[0.0, 0.0, 1.3]], scene=build_scene(gate, []))
    fleet.advance(2000)
    assert fleet.bodies[0, 2] > 1.2
    fleet.set_scene(build_scene([], []))
    fleet.advance(1000)
    assert fleet.bodies[0, 2] < 0.1


def test_battery_sags_under_load_and_recovers():
    fleet = airborne()
    assert 3.7 < fleet.telemetry(0).battery < 4.05
    loaded = fleet.bodies[0, AB_VOLTS]
    fleet.send(c.Land(0.0, 1.5), 0)
    fly(fleet, 3.0)
    assert loaded + 0.1 < fleet.bodies[0, AB_VOLTS] < 4.2


def test_traces_tell_time_position_contact_and_forces():
    gates = [[1.5, 0, 0, 0, 0, 0, 0]]
    scene = build_scene(gates, [])
    fleet = ready(scene=scene)
    trace = np.zeros((1, 50, TRACE_SIZE))
    begin = fleet.time
    fleet.advance(50, trace)
    np.testing.assert_allclose(trace[0, :, TR_TIME], begin + 1e-3 * np.arange(1, 51))
    assert (trace[0, :, TR_CONTACT] == ground_code(scene)).all()
    fleet.send(c.Takeoff(1.0, 1.5), 0)
    fly(fleet, 2.5)
    fleet.advance(50, trace)
    assert (trace[0, :, TR_CONTACT] == NO_CONTACT).all()
    assert trace[0, -1, TR_ACTION : TR_ACTION + 4].sum() == pytest.approx(0.0319 * 9.81, rel=0.02)
    np.testing.assert_allclose(trace[0, -1, TR_SETPOINT : TR_SETPOINT + 3], [0, 0, 1], atol=0.02)
    np.testing.assert_allclose(trace[0, -1, TR_POS : TR_POS + 3], fleet.bodies[0, :3])
    # Into the upper bar of the gate.
    fleet.send(c.GoTo([1.5, 0, 1.225], 0.0, 2.0), 0)
    codes = []
    for _ in range(25):
        trace = np.zeros((1, 100, TRACE_SIZE))
        for part in range(0, 100, 10):
            fleet.external_poses({0: fleet.true_pose(0)})
            fleet.advance(10, trace[:, part : part + 10])
        codes.extend(trace[0, :, TR_CONTACT])
    assert 0.0 in codes


def test_same_seed_same_bytes_whatever_the_threads_and_steps():
    def run(threads, step):
        fleet = ArenaFleet(
            [[0.0, i, 0.0] for i in range(3)],
            noise=SensorNoise(gyro=0.2, accelerometer=0.01, force=0.001),
            rng=np.random.default_rng(7),
            threads=threads,
        )
        for frame in range(150):
            fleet.external_poses({i: fleet.true_pose(i) for i in range(3)})
            if frame == 30:
                for i in range(3):
                    fleet.send(c.Takeoff(0.5, 1.0), i)
            for _ in range(10 // step):
                fleet.advance(step)
        fleet.close()
        return fleet.bodies

    first = run(1, 10)
    assert first[:, 2].min() > 0.2
    assert first.tobytes() == run(2, 10).tobytes()
    assert first.tobytes() == run(1, 10).tobytes()


def test_the_length_of_a_call_does_not_matter():
    def run(steps):
        fleet = ArenaFleet([[0.0, 0.0, 0.0]])
        fleet.advance(500)
        fleet.send(c.Takeoff(0.5, 1.0), 0)
        for step in steps:
            fleet.advance(step)
        return fleet.bodies.tobytes() + fleet.memory.tobytes()

    assert run([600]) == run([1, 9, 90, 500])


def test_a_setpoint_of_nonsense_leaves_the_world_finite():
    fleet = airborne()
    row = np.full(la.SETPOINT_SIZE, np.nan)
    row[la.SP_MODE : la.SP_MODE + 7] = la.MODE_ABS
    fleet.setpoint(0, row)
    fleet.advance(3000)
    assert np.isfinite(fleet.bodies).all()
    assert np.isfinite(fleet.rows(0).motors).all()


def test_arming_builds_wait_for_a_request():
    fleet = ready(auto_arm=False)
    assert fleet.send(c.Takeoff(0.5, 1.0), 0) == 16
    assert fleet.send(c.Arm(), 0) == 0
    fly(fleet, 0.2)
    assert fleet.send(c.Takeoff(0.5, 1.0), 0) == 0


def test_memory_row_is_covered_by_its_views():
    fleet = ArenaFleet([[0.0, 0.0, 0.0]])
    rows = fleet.rows(0)
    assert rows.high_level.base is not None
    assert rows.memory.shape == (stack_2026.FIRMWARE_SIZE,)
    rows.supervisor[sv.SV_STOP] = 1.0
    assert fleet.memory[0, stack_2026.F_SUPERVISOR + sv.SV_STOP] == 1.0
