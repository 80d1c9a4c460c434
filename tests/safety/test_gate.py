"""What the command gate lets pass, changes and refuses."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyarena.clock import VirtualClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import BackendError, CommandError
from crazyarena.safety.admission.agility import overtaxed
from crazyarena.safety.fence import Zone
from crazyarena.safety.flight_model import PID, FlightModel
from crazyarena.safety.gate import CommandGate, Policy, Refused
from crazyarena.safety.limits import Limits
from crazyarena.safety.planner import Motion, to_rest
from crazyarena.safety.shapes import Box
from crazyarena.types import Pose, Telemetry, VehicleState
from tests.safety.scenes import fence

ZERO = np.zeros(3)


class Sink:
    """A backend that keeps what it is sent."""

    vehicles = (1, 2)

    def __init__(self) -> None:
        self.sent: list[tuple[c.Command, int | None]] = []
        self.poses: list[dict[int, Pose]] = []
        self.state: VehicleState | None = None
        self.params: dict[str, float] = {}

    def send(self, command: c.Command, vehicle: int | None = None) -> None:
        self.sent.append((command, vehicle))

    def send_external_poses(self, poses: Any) -> None:
        self.poses.append(dict(poses))

    def telemetry(self, vehicle: int) -> Telemetry:
        return Telemetry(0.0, state=self.state)

    def get_param(self, vehicle: int, name: str) -> float:
        if name not in self.params:
            raise BackendError(f"no parameter {name}")
        return self.params[name]

    def close(self) -> None: ...


def state_at(
    position: Any, time: float = 0.0, velocity: Any = ZERO, lean: float = 0.0, rates: Any = ZERO
) -> VehicleState:
    quaternion = np.array([math.sin(0.5 * lean), 0.0, 0.0, math.cos(0.5 * lean)])
    return VehicleState(
        time, np.array(position, float), np.array(velocity, float), quaternion, np.array(rates)
    )


class Rig:
    def __init__(self, where: Any = (0.0, 0.0, 1.0), velocity: Any = ZERO, **options: Any) -> None:
        self.clock = VirtualClock()
        self.sink = Sink()
        self.log: list[tuple[Any, Any, str, int | None]] = []
        self.events: list[Any] = []
        self.where = where
        self.turned = {k: options.pop(k) for k in ("lean", "rates") if k in options}
        self.gate = CommandGate(
            self.sink,
            options.pop("fence", None) or fence(),
            self.clock,
            options.pop("limits", None),
            state=lambda vehicle: (
                None if self.where is None else state_at(self.where, 0.0, velocity, **self.turned)
            ),
            on_command=lambda *args: self.log.append(args),
            on_event=self.events.append,
            **options,
        )

    def send(self, command: c.Command, vehicle: int | None = 1) -> c.Command:
        self.gate.runner.send(command, vehicle)
        return self.sink.sent[-1][0]

    def refused(self, command: Any, vehicle: int | None = 1) -> str:
        before = len(self.sink.sent)
        with pytest.raises(CommandError) as caught:
            self.gate.runner.send(command, vehicle)
        assert len(self.sink.sent) == before
        assert self.log[-1][1] is None
        assert self.events[-1].rule == "gate_refused"
        return str(caught.value)

    def wait(self, seconds: float) -> None:
        self.clock.sleep_until(self.clock.now() + seconds)


def full(position: Any, velocity: Any = ZERO, acceleration: Any = ZERO) -> c.FullState:
    return c.FullState(position, velocity, acceleration, 0.0, ZERO)


def test_what_is_in_order_passes_untouched():
    rig = Rig()
    for command in (
        full((0.1, 0.0, 1.0), (1.0, 0, 0)),
        c.Position((0.1, 0.0, 1.0)),
        c.VelocityWorld((0.5, 0.0, 0.0)),
        c.Hover(0.2, 0.0, 0.1, 1.0),
        c.Takeoff(1.0, 2.0),
        c.GoTo((1.0, -1.0, 1.0), 0.0, 3.0),
        c.Land(0.02, 2.0),
        c.NotifySetpointsStop(),
        c.SetLed(1, 0, 0),
    ):
        assert rig.send(command) is command
        rig.wait(1.0)
    assert rig.events == []
    assert all(asked is sent for asked, sent, _, _ in rig.log)


@pytest.mark.parametrize(
    "command",
    [
        full((math.nan, 0.0, 1.0)),
        full((0.0, 0.0)),
        full((0.0, 0.0, 1.0), (math.inf, 0, 0)),
        c.Position("abc"),
        c.Takeoff(math.nan, 1.0),
        c.GoTo((0, 0, 1), 0.0, -1.0),
        c.VelocityWorld((None, 0, 0)),
        c.Attitude(0.0, 0.0, 0.0, 70000),
        "takeoff",
        None,
        42,
    ],
)
def test_what_no_vehicle_could_execute_is_refused(command):
    rig = Rig(limits=Limits(allow_attitude=True))
    assert "cf1" in rig.refused(command)


def test_only_the_runner_may_fly():
    rig = Rig()
    with pytest.raises(Refused, match="runner"):
        rig.gate.send(c.Takeoff(1.0, 2.0), 1)
    assert rig.sink.sent == []
    rig.gate.send(c.Emergency(), 1)
    assert rig.sink.sent == [(c.Emergency(), 1)]


def test_after_the_trial_only_what_stops_motors_passes():
    rig = Rig()
    rig.send(full((0, 0, 1)))
    rig.gate.end_trial("completed")
    assert "completed" in rig.refused(full((0, 0, 1)))
    rig.refused(c.Land(0.0, 2.0))
    for stopping in (c.Emergency(), c.CutMotors(), c.Stop()):
        assert rig.send(stopping) == stopping
    rig.gate.safety.send(c.Land(0.0, 2.0), 1)
    assert rig.sink.sent[-1] == (c.Land(0.0, 2.0), 1)


def test_a_vehicle_the_watchdog_has_taken_is_closed_and_no_other():
    rig = Rig()
    rig.gate.take(1)
    assert "watchdog" in rig.refused(full((0, 0, 1)))
    rig.refused(full((0, 0, 1)), None)
    rig.send(full((0, 0, 1)), 2)
    rig.gate.safety.send(full((0, 0, 1)), 1)


def test_position_outside_is_moved_to_the_soft_limit_and_stops_pushing():
    rig = Rig(where=(2.8, 0.0, 1.0))
    sent = rig.send(full((3.2, 0.0, 1.0), (2.0, 0, 0), (1.0, 0, 0)))
    assert sent.position == pytest.approx((2.95, 0.0, 1.0), abs=0.01)
    assert sent.acceleration == (0.0, 0.0, 0.0)
    # If anything, it is held back: 15 cm ahead and the link lost, it would coast out.
    assert -0.2 < sent.velocity[0] <= 0.0
    assert sent.velocity[1:] == (0.0, 0.0)
    assert "outside" in rig.events[-1].detail
    assert rig.log[-1][0].position == (3.2, 0.0, 1.0)


def test_refusing_policy_refuses_instead():
    rig = Rig(policy=Policy.REFUSE)
    assert "outside" in rig.refused(full((3.2, 0.0, 1.0)))
    rig.send(full((0.1, 0.0, 1.0)))


def test_between_soft_and_hard_limit_nothing_is_moved():
    rig = Rig(where=(2.97, 0.0, 1.0))
    command = full((2.98, 0.0, 1.0))
    assert rig.send(command) is command


def test_speed_and_acceleration_are_scaled():
    rig = Rig(limits=Limits(link_loss_margin=math.inf))
    sent = rig.send(full((0, 0, 1), (6.0, 0.0, 0.0), (0.0, 30.0, 0.0)))
    assert sent.velocity == pytest.approx((3.0, 0, 0))
    assert sent.acceleration == pytest.approx((0, 12.0, 0))


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-20, 20)] * 6, st.floats(0.0, 0.3)), min_size=1, max_size=12))
def test_streamed_setpoints_stay_inside_near_and_slow(steps):
    rig = Rig()
    n = rig.gate.limits
    last: tuple[Any, float] | None = None
    for x, y, z, vx, vy, vz, gap in steps:
        rig.wait(gap)
        try:
            sent = rig.send(full((x, y, z), (vx, vy, vz)))
        except Refused:
            continue
        place = tuple(float(v) for v in sent.position)
        assert math.dist(place, rig.where) <= n.setpoint_lead + 1e-6
        assert fence().clearance(*place) >= -1e-9
        assert math.hypot(*sent.velocity) <= n.setpoint_speed + 1e-9
        now = rig.clock.now()
        if last is not None and now - last[1] <= 0.5:
            reach = n.setpoint_step + n.setpoint_speed * (now - last[1])
            # Pulled towards the vehicle it may only come closer to it.
            assert math.dist(place, last[0]) <= reach + n.setpoint_lead
        last = place, now


def test_rate_of_change_is_bounded():
    rig = Rig(where=None)
    rig.send(full((0, 0, 1)))
    rig.wait(1 / 30)
    sent = rig.send(full((2, 0, 1)))
    assert sent.position[0] == pytest.approx(0.25 + 3.0 / 30)


def test_a_bare_position_is_held_inside_and_near_the_vehicle():
    rig = Rig(where=(2.8, 0.0, 1.0))
    # 2.95 is inside; told that far ahead and cut off, the vehicle would coast out.
    assert 2.88 < rig.send(c.Position((3.2, 0.0, 1.0))).position[0] < 2.95
    rig = Rig(where=(0.0, 0.0, 1.0))
    assert rig.send(c.Position((2.5, 0.0, 1.0))).position == pytest.approx((0.6, 0.0, 1.0))


def test_a_landing_takes_the_time_it_needs_and_ends_below_the_ceiling():
    rig = Rig(where=(0.0, 0.0, 1.8))
    assert 35 / 16 * 1.78 / rig.send(c.Land(0.02, 0.1)).duration <= 3.0 + 0.1
    # Rotors that stand cannot steer, whatever it has to be steered out of.
    assert 7.51 * 0.98 / rig.send(c.Land(0.02, 0.1)).duration ** 2 < 6.0
    assert rig.send(c.Land(5.0, 5.0)).height == pytest.approx(1.95)


def test_velocity_towards_a_wall_is_slowed():
    rig = Rig(where=(2.5, 0.0, 1.0))
    sent = rig.send(c.VelocityWorld((2.0, 0.0, 0.0)))
    assert 0.3 <= sent.velocity[0] <= 0.4
    away = c.VelocityWorld((-2.0, 0.0, 0.0))
    assert rig.send(away) is away


def test_hover_is_slowed_and_its_height_clamped():
    rig = Rig(where=(2.5, 0.0, 1.5))
    sent = rig.send(c.Hover(2.0, 0.0, 0.0, 5.0))
    assert sent.vx < 1.01
    assert sent.height == pytest.approx(1.95, abs=0.01)


def test_hover_does_not_send_a_vehicle_up_faster_than_it_can_be_stopped():
    rig = Rig(where=(0.0, 0.0, 0.6))
    lead = rig.gate.limits.setpoint_lead
    assert rig.send(c.Hover(0.0, 0.0, 0.0, 1.8)).height == pytest.approx(0.6 + lead)
    pid = Limits(vehicle=FlightModel(controller=PID, follows_velocity=False))
    command = c.Hover(0.0, 0.0, 0.0, 1.8)
    assert Rig(where=(0.0, 0.0, 0.6), limits=pid).send(command) is command


@pytest.mark.parametrize(
    "way", [(0.2, 0.0, 0.0), (-0.08, -0.573, 0.0), (0.1, 0.0, 0.5), (0.35, 0.0, -0.7)]
)
def test_a_go_to_gets_the_time_that_motors_and_attitude_need(way):
    """What they have not, tips the vehicle over: as short as speed and acceleration allow, all of
    these do."""
    plan = to_rest(Motion((0.0, 0.0, 1.0)), tuple(np.add(way, (0, 0, 1.0))), 1.0)
    hasty = math.sqrt(7.5132 * math.hypot(*way) / Limits().setpoint_acceleration)
    sent = Rig().send(c.GoTo(way, 0.0, hasty, relative=True))
    assert sent.position == way
    assert 1.1 * hasty < sent.duration < 3.0 * hasty
    vehicle = Limits().vehicle
    assert overtaxed(plan, vehicle, 24, 0.1) is None
    fast = to_rest(Motion((0.0, 0.0, 1.0)), tuple(np.add(way, (0, 0, 1.0))), hasty)
    assert overtaxed(fast, vehicle, 24, 0.1) is not None
    # One that brakes hard as it begins may go on with that.
    assert Rig(where=(0.0, 0.0, 1.0), velocity=(2.0, 0.0, 0.0)).send(c.GoTo((1.0, 0, 1), 0.0, 1.5))


def test_a_trajectory_may_ask_for_what_the_vehicle_has():
    def pieces(way: tuple[float, float, float], duration: float) -> np.ndarray:
        row = np.zeros((1, 33))
        row[0, 0] = duration
        row[0, 1:25] = to_rest(Motion((0, 0, 0)), way, duration).coefficients.ravel()
        return row

    rig = Rig()
    rig.send(c.Takeoff(1.0, 2.0))
    rig.wait(3.0)
    rig.send(c.UploadTrajectory(1, 0, pieces((0.2, 0.0, 0.0), 0.4)))
    rig.send(c.UploadTrajectory(2, 4, pieces((0.1, 0.0, -0.6), 0.7)))
    rig.send(c.UploadTrajectory(3, 8, pieces((0.0, 0.0, 0.6), 0.7)))
    assert "rad/s" in rig.refused(c.StartTrajectory(1, 1.0, False, True))
    assert "thrust reaches" in rig.refused(c.StartTrajectory(2, 1.0, False, True))
    assert "thrust reaches" in rig.refused(c.StartTrajectory(3, 1.0, False, True))
    sinks = to_rest(Motion((0.0, 0.0, 1.0)), (0.1, 0.0, 0.4), 0.75)
    strong = FlightModel(lift=2.5)
    assert "lift falls" in (overtaxed(sinks, strong, 24, 0.1) or "")
    assert overtaxed(sinks, strong, 24, 0.1, (0.0, 0.0, -9.0)) is None
    for ident in (1, 2, 3):
        rig.send(c.StartTrajectory(ident, 2.0, False, True))


def test_setpoints_are_held_back_that_would_lead_out_if_they_were_the_last():
    rig = Rig(where=(2.0, 0.0, 1.0), velocity=(2.0, 0.0, 0.0))
    sent = rig.send(full((2.0, 0.0, 1.0), (2.0, 0.0, 0.0), (0.5, 0.0, 0.0)))
    assert sent.position == (2.0, 0.0, 1.0)
    assert sent.velocity[0] < 1.9
    assert sent.velocity[1:] == pytest.approx((0.0, 0.0))
    assert "link were lost" in rig.events[-1].detail
    assert rig.send(c.Position((2.5, 0.0, 1.0))).position[0] < 2.5
    plan = c.GoTo((2.9, 0.0, 1.0), 0.0, 1.5)
    assert Rig(where=(1.0, 0.0, 1.0)).send(plan).duration > 1.6


def test_far_from_the_fence_or_without_the_limit_no_setpoint_is_held_back():
    command = full((1.0, 0.0, 1.0), (2.0, 0.0, 0.0))
    assert Rig(where=(1.0, 0.0, 1.0), velocity=(2.0, 0.0, 0.0)).send(command) is command
    rig = Rig(
        where=(2.5, 0.0, 1.0),
        velocity=(2.0, 0.0, 0.0),
        limits=Limits(link_loss_margin=math.inf),
    )
    command = full((2.5, 0.0, 1.0), (2.0, 0.0, 0.0))
    assert rig.send(command) is command
    assert rig.send(c.VelocityWorld((0.9, 0.0, 0.0))).velocity == (0.9, 0.0, 0.0)


TIPS = {"rates": (-5.0, 0.0, 0.0)}


@pytest.mark.parametrize("busy", [TIPS, {"lean": 0.6}])
def test_a_vehicle_that_is_busy_with_its_attitude_is_asked_for_little_else(busy):
    """Motors that climb or turn with all they have cannot stop it from going over."""
    above = (0.0, 0.0, 1.5)
    rig = Rig(**busy)
    for sent in (
        rig.send(c.Position(above, 2.0)),
        rig.send(c.FullState(above, ZERO, ZERO, 2.0, ZERO)),
    ):
        assert 1.0 < sent.position[2] < 1.2
        assert 0.0 < sent.yaw < 0.3
    assert "takes all thrust" in rig.events[-1].detail
    sent = rig.send(c.Hover(0.0, 0.0, 3.0, 1.5))
    assert 1.0 < sent.height < 1.2
    assert 0.0 < sent.yaw_rate <= 1.0
    assert rig.send(c.VelocityWorld(ZERO, -4.0)).yaw_rate == -1.0
    # What it climbs with already, and what pushes it up besides, count as well.
    assert rig.send(full((0.0, 0.0, 1.05), acceleration=(0.0, 0.0, 9.0))).position[2] < 1.02
    assert "turn" in Rig(policy=Policy.REFUSE, **busy).refused(c.Position((0.0, 0.0, 1.0), 2.0))


def test_what_a_racer_asks_of_it_then_is_left_alone():
    rig = Rig(velocity=(2.0, 0.0, 0.0))
    command = c.FullState((0.1, 0.0, 1.05), (2.0, 0.0, 0.2), (3.0, 0.0, 1.0), 0.4, ZERO)
    assert rig.send(command) is command
    # The heading that it has been asked for all along may be away from the vehicle's.
    rig.turned.update(TIPS)
    for _ in range(30):
        rig.wait(0.03)
        assert rig.send(command) is command


def test_a_calm_vehicle_may_climb_and_turn():
    rig = Rig(lean=0.2, rates=(1.0, 0.5, 3.0))
    for command in (
        c.Position((0.0, 0.0, 1.2), 0.75),
        c.Hover(0.0, 0.0, 3.0, 1.5),
        c.VelocityWorld(ZERO, -4.0),
    ):
        assert rig.send(command) is command


def test_the_pid_limits_its_climb_by_itself():
    limits = Limits(vehicle=FlightModel(controller=1, follows_velocity=False))
    rig = Rig(limits=limits, **TIPS)
    command = c.Position((0.0, 0.0, 1.2), 0.1)
    assert rig.send(command) is command


def test_a_trajectory_is_refused_on_which_a_cut_would_lead_out():
    rig = Rig(where=(2.0, 0.0, 1.0))
    rig.send(c.UploadTrajectory(1, 0, piece(1.2, 0.95)))
    assert "cut on the way" in rig.refused(c.StartTrajectory(1))
    rig.send(c.StartTrajectory(1, timescale=3.0))


def test_attitude_is_refused_unless_allowed_and_then_bounded():
    assert "allow_attitude" in Rig().refused(c.Attitude(0.1, 0.0, 0.0, 40000))
    rig = Rig(limits=Limits(allow_attitude=True))
    sent = rig.send(c.Attitude(1.2, -1.2, 0.0, 40000))
    assert math.hypot(sent.roll, sent.pitch) == pytest.approx(0.6)
    assert sent.roll == -sent.pitch


def test_plans_of_the_vehicle_get_the_time_they_need_and_end_inside():
    rig = Rig(where=(0.0, 0.0, 0.03))
    assert rig.send(c.Takeoff(9.0, 5.0)).height == pytest.approx(1.95, abs=0.01)
    assert rig.send(c.Takeoff(1.0, 0.1)).duration > 0.7
    sent = rig.send(c.GoTo((9.0, 0.0, 1.0), 0.0, 0.1))
    assert sent.position[0] == pytest.approx(2.95, abs=0.01)
    assert 35 / 16 * 2.95 / sent.duration <= 3.0 + 0.1
    rig = Rig(where=(2.5, 0.0, 1.0))
    assert rig.send(c.GoTo((1.0, 0.0, 0.0), 0.0, 3.0, relative=True)).position[0] < 0.5
    rig.where = None
    assert "relative" in rig.refused(c.GoTo((1.0, 0.0, 0.0), 0.0, 3.0, relative=True))


def piece(duration: float, distance: float) -> np.ndarray:
    """From rest to rest along x, by a polynomial of 7th order."""
    row = np.zeros((1, 33))
    row[0, 0] = duration
    row[0, 1 + 4 : 1 + 8] = distance * np.array([35, -84, 70, -20]) / duration ** np.arange(4, 8)
    return row


def test_trajectories_are_checked_at_their_start():
    rig = Rig(where=(0.0, 0.0, 1.0))
    rig.send(c.UploadTrajectory(1, 0, piece(4.0, 2.0)))
    rig.send(c.StartTrajectory(1))
    assert "speed" in rig.refused(c.StartTrajectory(1, timescale=0.2))
    rig.where = (2.0, 0.0, 1.0)
    assert "out of the fence" in rig.refused(c.StartTrajectory(1))
    assert "not uploaded" in rig.refused(c.StartTrajectory(2))


def test_a_trajectory_is_judged_by_the_memory_that_it_reads():
    rig = Rig(where=(0.0, 0.0, 1.0))
    rig.send(c.UploadTrajectory(1, 0, piece(4.0, 0.3)))
    rig.send(c.UploadTrajectory(2, 1, piece(4.0, 0.2)))
    rig.send(c.UploadTrajectory(3, 0, np.vstack([piece(4.0, 0.2), piece(4.0, 0.2)])))
    for overwritten in (1, 2):
        assert "trajectory 3 was uploaded over" in rig.refused(c.StartTrajectory(overwritten))
    rig.send(c.UploadTrajectory(2, 1, piece(4.0, 9.0)))
    assert "trajectory 2 was uploaded over" in rig.refused(c.StartTrajectory(3))
    assert "out of the fence" in rig.refused(c.StartTrajectory(2, timescale=9.0))
    # Longer before: what is read now is what was uploaded last.
    rig.send(c.UploadTrajectory(2, 1, piece(4.0, 0.2)))
    rig.send(c.StartTrajectory(2))


def test_what_flies_cannot_be_overwritten():
    rig = Rig(where=(0.0, 0.0, 1.0))
    two = np.vstack([piece(4.0, 0.2), piece(4.0, 0.2)])
    rig.send(c.UploadTrajectory(1, 3, two))
    rig.send(c.StartTrajectory(1))
    for ident, offset in ((1, 3), (1, 4), (2, 3), (2, 4), (7, 2)):
        assert "being flown" in rig.refused(c.UploadTrajectory(ident, offset, two))
    rig.send(c.UploadTrajectory(2, 0, two))
    rig.send(c.UploadTrajectory(3, 5, two))
    rig.wait(60.0)  # at its end it still holds its last piece
    assert "being flown" in rig.refused(c.UploadTrajectory(1, 3, two))
    rig.send(c.GoTo((0.2, 0.0, 1.0), 0.0, 3.0))
    rig.send(c.UploadTrajectory(1, 3, two))


@pytest.mark.parametrize("offset", [30, 31, 200])
def test_what_the_memory_does_not_hold_is_refused(offset):
    rig = Rig(where=(0.0, 0.0, 1.0))
    two = np.vstack([piece(4.0, 0.2), piece(4.0, 0.2)])
    assert "the trajectory memory holds 31 pieces" in rig.refused(
        c.UploadTrajectory(1, offset, two)
    )


def test_a_plan_for_another_group_frees_no_memory():
    rig = Rig(where=(0.0, 0.0, 1.0))
    rig.send(c.SetGroupMask(1))
    rig.send(c.UploadTrajectory(1, 0, piece(4.0, 0.2)))
    rig.send(c.StartTrajectory(1))
    rig.send(c.GoTo((0.2, 0.0, 1.0), 0.0, 3.0, group_mask=2))
    assert "being flown" in rig.refused(c.UploadTrajectory(2, 0, piece(4.0, 0.2)))
    rig.send(c.GoTo((0.2, 0.0, 1.0), 0.0, 3.0, group_mask=3))
    rig.send(c.UploadTrajectory(2, 0, piece(4.0, 0.2)))


def test_a_trajectory_begins_near_the_vehicle():
    rig = Rig(where=(0.0, 0.0, 1.0))
    rig.send(c.UploadTrajectory(1, 0, piece(4.0, 0.2)))
    assert "1.00 m from where" in rig.refused(c.StartTrajectory(1, relative=False))
    rig.where = (0.2, 0.0, 0.1)
    rig.send(c.StartTrajectory(1, relative=False))


def test_trajectories_beyond_the_vehicles_numbers_are_refused():
    rig = Rig()
    assert "too large" in rig.refused(c.UploadTrajectory(1, 0, piece(4.0, 1e41)))
    assert "trajectory id" in rig.refused(c.UploadTrajectory(31, 0, piece(4.0, 1.0)))


def test_relative_goals_add_to_the_plan_and_not_to_the_vehicle():
    rig = Rig(where=(2.0, 0.0, 1.0))
    rig.send(c.GoTo((2.4, 0.0, 1.0), 0.0, 3.0))
    rig.wait(3.0)  # the plan is at 2.4 now, the vehicle still at 2.0
    sent = rig.send(c.GoTo((0.9, 0.0, 0.0), 0.0, 3.0, relative=True))
    assert 2.4 + sent.position[0] == pytest.approx(2.95, abs=0.01)
    rig = Rig(where=(2.0, 0.0, 1.0))
    rig.send(full((2.3, 0.0, 1.0)))
    # The stream has disabled the planner: it begins at the vehicle.
    sent = rig.send(c.GoTo((0.94, 0.0, 0.0), 0.0, 3.0, relative=True))
    assert sent.position[0] == pytest.approx(0.94)


def test_nothing_begins_on_a_plan_that_the_vehicle_does_not_follow():
    rig = Rig(where=(0.0, 0.0, 1.0))
    rig.send(c.GoTo((2.0, 0.0, 1.0), 0.0, 3.0))
    rig.wait(3.0)
    assert "2.00 m from where" in rig.refused(c.GoTo((0.1, 0.0, 0.0), 0.0, 3.0, relative=True))


def test_a_plan_after_a_stream_is_flown():
    rig = Rig(where=(0.0, 0.0, 1.0))
    rig.send(full((0.0, 0.0, 1.0)))
    rig.send(c.GoTo((0.5, 0.0, 1.0), 0.0, 3.0))
    assert [type(one) for one, _ in rig.sink.sent[-2:]] == [c.NotifySetpointsStop, c.GoTo]
    assert rig.gate.stream_age(1, rig.clock.now()) is None
    rig.send(full((0.0, 0.0, 1.0)))
    rig.send(c.NotifySetpointsStop())
    rig.wait(0.2)
    # Nothing has followed yet: the vehicle still holds the last setpoint, and times out.
    assert rig.gate.stream_age(1, rig.clock.now()) == pytest.approx(0.2)
    rig.send(c.Land(0.0, 3.0))
    assert type(rig.sink.sent[-2][0]) is c.NotifySetpointsStop  # the runner's own, no other
    assert len(rig.sink.sent) == 6
    assert rig.gate.stream_age(1, rig.clock.now()) is None


def test_nothing_is_remembered_of_what_was_refused():
    rig = Rig(where=(0.0, 0.0, 1.0))
    rig.gate.take(2)
    rig.refused(c.UploadTrajectory(1, 0, piece(4.0, 0.2)), None)
    assert "not uploaded" in rig.refused(c.StartTrajectory(1))


# The pillar of the scene stands at (1, 1), 0.1 m thick and with a margin of 0.1 m.


def test_ways_lead_around_nothing_so_they_end_before_it():
    rig = Rig(where=(0.0, 1.0, 0.5))
    sent = rig.send(c.GoTo((2.0, 1.0, 0.5), 0.0, 5.0))
    assert 0.7 < sent.position[0] < 0.8
    assert "leads out" in rig.events[-1].detail
    assert Rig(where=(0.0, 1.0, 1.5)).send(c.GoTo((2.0, 1.0, 1.5), 0.0, 5.0)).position[0] == 2.0
    refusing = Rig(where=(0.0, 1.0, 0.5), policy=Policy.REFUSE)
    assert "leads out" in refusing.refused(c.GoTo((2.0, 1.0, 0.5), 0.0, 5.0))
    rig = Rig(where=(0.79, 1.0, 0.5))
    assert "from the start" in rig.refused(c.GoTo((2.0, 1.0, 0.5), 0.0, 5.0))


def test_streamed_places_are_not_beyond_a_zone():
    rig = Rig(where=(0.75, 1.0, 0.5))
    assert rig.send(c.Position((1.3, 1.0, 0.5))).position[0] < 0.81
    assert rig.send(full((1.3, 1.0, 0.5), (1.0, 0.0, 0.0))).position[0] < 0.81
    rig = Rig(where=(0.75, 1.0, 1.5))
    assert rig.send(c.Position((1.3, 1.0, 1.5))).position[0] == 1.3


def test_a_way_that_begins_too_fast_is_not_begun():
    rig = Rig(where=(0.55, 1.0, 0.5), velocity=(2.5, 0.0, 0.0))
    rig.send(full((0.55, 1.0, 0.5)))
    assert "from the start" in rig.refused(c.GoTo((0.5, 1.0, 0.5), 0.0, 5.0))


def test_a_take_off_is_upright_or_refused():
    beside = fence(zones=(Zone("roof", Box((0.0, -1.0, 0.8), (1.0, 1.0, 1.0)), 0.1),))
    rig = Rig(where=(0.5, 0.0, 0.03), fence=beside)
    assert 0.6 < rig.send(c.Takeoff(1.5, 3.0)).height < 0.7
    assert Rig(where=(-0.5, 0.0, 0.03), fence=beside).send(c.Takeoff(1.5, 3.0)).height == 1.5
    low = fence(zones=(Zone("roof", Box((0.0, -1.0, 0.2), (1.0, 1.0, 1.0)), 0.1),))
    assert "no room above" in Rig(where=(0.5, 0.0, 0.09), fence=low).refused(c.Takeoff(1.5, 3.0))


def test_a_landing_on_a_zone_is_refused():
    rig = Rig(where=(1.0, 1.0, 1.5))
    assert "no room below" in rig.refused(c.Land(0.0, 3.0))
    rig = Rig(where=(0.5, 1.0, 1.5))
    rig.send(c.Land(0.0, 3.0))


BOOT = {"ctrlMel.kp_xy": 0.4, "ctrlMel.ki_m_xy": 0.0, "posCtlPid.thrustBase": 36000.0}


def test_parameters_that_blind_or_stop_are_closed_in_flight():
    rig = Rig()
    rig.send(c.SetParam("stabilizer.controller", 2))
    for name in ("motorPowerSet.enable", "supervisor.tmblChckEn", "flightmode.stabModeRoll"):
        rig.refused(c.SetParam(name, 1))
    rig.send(full((0, 0, 1)))
    for name in ("stabilizer.controller", "kalman.resetEstimation", "stabilizer.stop"):
        assert "flight" in rig.refused(c.SetParam(name, 1))
    rig.send(c.SetParam("ring.effect", 7))


@pytest.mark.parametrize(
    "name",
    [
        "ctrlMel/kp_xy",
        "ctrlMel.mass",
        "posCtlPid.xKp",
        "velCtlPid.vxKp",
        "pid_attitude.roll_kp",
        "pid_rate/roll_kp",
        "hlCommander.vland",
        "locSrv.extPosStdDev",
        "kalman.pNAcc_z",
        "colAv.bboxMinX",
        "somebodys.own",
    ],
)
def test_what_shapes_the_flight_is_closed_in_flight(name):
    rig = Rig(limits=Limits())
    rig.sink.params = dict.fromkeys((name, name.replace("/", ".")), 1.0)
    rig.send(c.SetParam(name, 1.0))
    rig.send(full((0, 0, 1)))
    assert "cannot be written in flight" in rig.refused(c.SetParam(name, 1.0))


@pytest.mark.parametrize("in_flight", [False, True])
def test_gains_stay_in_a_range_around_what_they_were(in_flight):
    rig = Rig(limits=Limits(tune_in_flight=True))
    rig.sink.params = dict(BOOT)
    if in_flight:
        rig.send(full((0, 0, 1)))
    for asked, told in ((-4.0, 0.32), (0.45, 0.45), (9.0, 0.5), (0.0, 0.32)):
        assert rig.send(c.SetParam("ctrlMel/kp_xy", asked)).value == pytest.approx(told)
        # The range does not move with what has been written.
        rig.sink.params["ctrlMel.kp_xy"] = told
    assert rig.send(c.SetParam("ctrlMel.ki_m_xy", 5.0)).value == 0.0
    assert "ctrlMel.kd_xy" in rig.refused(c.SetParam("ctrlMel.kd_xy", 0.2))  # nobody knows it
    assert "range around" in rig.events[-2].detail


def test_refusing_policy_refuses_what_is_out_of_range():
    rig = Rig(policy=Policy.REFUSE)
    rig.sink.params = dict(BOOT)
    assert "ctrlMel.kp_xy -4 is outside 0.32 .. 0.5" in rig.refused(c.SetParam("ctrlMel.kp_xy", -4))
    command = c.SetParam("ctrlMel.kp_xy", 0.5)
    assert rig.send(command) is command


def test_controllers_are_told_apart_as_the_firmware_reads_them():
    for passed in (2, 2.9, 2.0):
        Rig().send(c.SetParam("stabilizer/controller", passed))
    for gentler in (0, 1, 1.4, 0.9, -0.5):
        assert "more gently" in Rig().refused(c.SetParam("stabilizer.controller", gentler))
        Rig(limits=Limits(braking=3.5)).send(c.SetParam("stabilizer.controller", gentler))
    for unknown in (3, 4.2, 5, 6, 255, 256, 258, -1, 1e30):
        rig = Rig(limits=Limits(braking=3.5))
        rig.refused(c.SetParam("stabilizer.controller", unknown))
        rig.refused(c.SetParam("stabilizer/controller", unknown))


def test_integers_lose_their_fraction_before_they_are_bounded():
    rig = Rig()
    rig.sink.params = dict(BOOT)
    rig.send(c.SetParam("posCtlPid.thrustBase", 39600.9))
    assert rig.send(c.SetParam("posCtlPid.thrustBase", 39601)).value == pytest.approx(39600.0)
    assert "does not hold" in rig.refused(c.SetParam("posCtlPid.thrustBase", 65536.0))
    assert "does not hold" in rig.refused(c.SetParam("ctrlMel.kp_xy", 1e39))


def test_avoidance_on_board_is_kept_inside_the_fence():
    rig = Rig()
    sent = rig.send(c.CollisionAvoidance(True))
    assert sent.bbox_min == pytest.approx((-2.95, -2.95, -0.1))
    assert sent.bbox_max == pytest.approx((2.95, 2.95, 1.95))
    assert rig.events == []
    assert rig.send(c.CollisionAvoidance(True, max_speed=9.0)).max_speed == 3.0
    outside = c.CollisionAvoidance(True, bbox_min=(4.0, -1.0, 0.0), bbox_max=(5.0, 1.0, 1.0))
    assert "outside the fence" in rig.refused(outside)
    away = c.CollisionAvoidance(True, bbox_min=(2.0, -1.0, 0.0), bbox_max=(2.5, 1.0, 1.5))
    assert "drag" in rig.refused(away)
    off = c.CollisionAvoidance(False)
    assert rig.send(off) is off


def test_avoidance_on_board_ends_when_the_watchdog_takes_over():
    rig = Rig()
    rig.gate.take(1)
    assert rig.sink.sent == []
    rig = Rig()
    rig.send(c.CollisionAvoidance(True, bbox_min=(-2.0, -2.0, 0.9)))
    rig.gate.take(1)
    assert rig.sink.sent[-1] == (c.CollisionAvoidance(False), 1)


def test_budget_is_enforced_and_never_on_a_stop():
    rig = Rig()
    n = rig.gate.limits
    passed = 0
    for _ in range(500):
        try:
            rig.send(full((0, 0, 1)))
            passed += 1
        except Refused:
            break
    assert passed == n.command_burst
    for _ in range(100):
        rig.send(c.Emergency())
        rig.send(c.CutMotors(), None)
    assert len(rig.sink.sent) == passed + 200
    rig.wait(0.5)
    rig.send(full((0, 0, 1)))


def test_an_emergency_stop_does_not_wait_for_the_gate_to_be_free():
    rig = Rig()
    with rig.gate._lock:
        thread = threading.Thread(target=lambda: rig.gate.runner.send(c.Emergency(), None))
        thread.start()
        thread.join(timeout=5.0)
        assert not thread.is_alive()
    assert rig.sink.sent == [(c.Emergency(), None)]


def test_unknown_vehicle_is_refused():
    assert "no such vehicle" in Rig().refused(full((0, 0, 1)), 9)


def test_broadcast_stays_one_if_nothing_had_to_change():
    rig = Rig()
    rig.gate.runner.send(c.Takeoff(1.0, 2.0), None)
    assert rig.sink.sent == [(c.Takeoff(1.0, 2.0), None)]
    rig.gate.runner.send(c.Takeoff(9.0, 9.0), None)
    assert [vehicle for _, vehicle in rig.sink.sent[1:]] == [1, 2]


def test_poses_nobody_should_believe_are_not_forwarded():
    rig = Rig()
    good = Pose(np.array([0.0, 0.0, 1.0]))
    rig.gate.send_external_poses({1: good})
    rig.gate.send_external_poses({1: Pose(good.position.copy())})  # the same to the bit
    rig.gate.send_external_poses({1: Pose(np.array([math.nan, 0.0, 1.0]))})
    rig.gate.send_external_poses({9: good})
    assert len(rig.sink.poses) == 1
    assert rig.gate.poses_dropped == 3
    assert rig.gate.frozen() == []
    for _ in range(20):
        rig.gate.send_external_poses({1: Pose(good.position.copy())})
    assert rig.gate.frozen() == [1]
    # On the ground the vehicle may be carried anywhere; in flight it cannot jump.
    rig.sink.state = state_at((0.0, 0.0, 1.0))
    rig.gate.send_external_poses({1: Pose(np.array([2.0, 0.0, 1.0]))})
    assert len(rig.sink.poses) == 2
    rig.send(full((0, 0, 1)))
    rig.gate.send_external_poses({1: Pose(np.array([2.0, 0.1, 1.0]))})
    assert len(rig.sink.poses) == 2
    rig.gate.send_external_poses({1: Pose(np.array([0.05, 0.0, 1.0]))})
    assert len(rig.sink.poses) == 3


def test_flight_ends_when_the_vehicle_stands_after_a_landing():
    rig = Rig()
    rig.send(full((0, 0, 1)))
    rig.gate.stands(1)
    assert rig.gate.flying_since(1) is not None  # not told to land: it may be about to rise
    rig.send(c.Land(0.0, 2.0))
    rig.gate.stands(1)
    assert rig.gate.flying_since(1) is None
