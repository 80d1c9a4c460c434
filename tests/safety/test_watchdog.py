"""The watchdog's own senses, its thread, and what it does to a vehicle that flies."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
import pytest

from crazyarena.clock import VirtualClock, WallClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import InputError
from crazyarena.mocap.estimator import BodyEstimate, FrameResult, Freshness
from crazyarena.mocap.events import EventKind, MocapEvent
from crazyarena.safety.estop import DeadMan, EmergencyStop
from crazyarena.safety.events import Action
from crazyarena.safety.gate import CommandGate, Refused
from crazyarena.safety.observation import as_point
from crazyarena.safety.watchdog import Watchdog
from crazyarena.types import Pose, PoseFrame, Telemetry, VehicleState
from tests.safety.scenes import fence

ZERO = np.zeros(3)
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
FLYING = 1 << 1 | 1 << 3 | 1 << 4


class Vehicle:
    """A backend and an estimator at once: the vehicle is where the test puts it."""

    vehicles = (1,)

    def __init__(self, clock: Any) -> None:
        self.clock = clock
        self.position = np.array([0.0, 0.0, 1.0])
        self.velocity = ZERO
        self.captured = 0.0
        self.silent = False
        self.sent: list[tuple[float, c.Command]] = []
        self.fed: list[float] = []
        self.broken = False
        self.telemetry_time: float | None = None
        self.estimate_apart = 0.0
        self.battery = 3.8
        self.first_command = threading.Event()

    def send(self, command: c.Command, vehicle: int | None = None) -> None:
        self.sent.append((self.clock.now(), command))
        self.first_command.set()

    def send_external_poses(self, poses: Any) -> None: ...

    def telemetry(self, vehicle: int) -> Telemetry:
        now = self.clock.now()
        own = self.position + (self.estimate_apart, 0.0, 0.0)
        state = VehicleState(now, own, self.velocity.copy(), LEVEL, ZERO)
        time = now if self.telemetry_time is None else self.telemetry_time
        return Telemetry(time, self.battery, 1.0, -50.0, FLYING, state)

    def get_param(self, vehicle: int, name: str) -> float:
        return 0.0

    def close(self) -> None: ...

    def estimate(self, body: str) -> BodyEstimate:
        if self.broken:
            raise RuntimeError("no estimate")
        now = self.clock.now()
        age = now - self.captured
        state = VehicleState(now, self.position.copy(), self.velocity.copy(), LEVEL, ZERO)
        return BodyEstimate(body, state, Freshness.FRESH if age < 0.15 else Freshness.STALE, age)

    def feed(self, vehicle: int) -> None:
        self.fed.append(self.clock.now())


class Rig:
    def __init__(self, clock: Any = None, **options: Any) -> None:
        self.clock = clock or VirtualClock()
        self.vehicle = Vehicle(self.clock)
        self.gate = CommandGate(self.vehicle, fence(), self.clock)
        self.watchdog = Watchdog(
            self.gate,
            fence(),
            self.clock,
            {"cf1": 1},
            self.vehicle.estimate,
            feed=self.vehicle.feed,
            **options,
        )
        self.rng = np.random.default_rng(0)
        self.frames = 0

    def frame(self, accepted: bool = True, events: Any = (), repeat: bool = False, **others: Any):
        """One pose frame, 10 ms after the last, and the step it causes."""
        now = self.clock.now() + 0.01
        self.clock.sleep_until(now)
        position = self.vehicle.position if repeat else self.vehicle.position + self.noise()
        pose = Pose(position.copy(), LEVEL)
        bodies = {"cf1": pose, **{k: Pose(np.array(v, float)) for k, v in others.items()}}
        self.show(bodies, accepted, events, now)
        self.watchdog.step()

    def noise(self) -> np.ndarray:
        return self.rng.normal(0.0, 1e-4, 3)

    def show(self, bodies: Any, accepted: bool, events: Any, now: float, delay: float = 0.005):
        if accepted:
            self.vehicle.captured = now - delay
        self.frames += 1
        frame = PoseFrame(now - delay, now, self.frames, bodies)
        result = FrameResult({"cf1": bodies["cf1"]} if accepted else {}, tuple(events))
        self.watchdog.on_frame(frame, result)

    def fly(self, seconds: float = 0.3) -> None:
        for _ in range(round(seconds * 100)):
            self.setpoint()
            self.frame()

    def setpoint(self) -> None:
        x, y, z = self.vehicle.position.tolist()
        command = c.FullState((x, y, z), ZERO, ZERO, 0.0, ZERO)
        if not self.watchdog.action(1).takes_over:
            self.gate.runner.send(command, 1)

    @property
    def rules(self) -> set[str]:
        return {event.rule for event in self.watchdog.events}

    @property
    def last(self) -> c.Command:
        return self.vehicle.sent[-1][1]


def test_quiet_flight_is_left_alone():
    rig = Rig()
    rig.fly(2.0)
    assert rig.watchdog.events == []
    assert len(rig.vehicle.sent) == 200


def test_outside_it_takes_over_brakes_and_locks_the_runner_out():
    rig = Rig()
    rig.fly()
    rig.vehicle.position = np.array([3.05, 0.0, 1.0])
    rig.frame()
    assert rig.watchdog.action(1) is Action.HOLD
    assert isinstance(rig.last, c.FullState)
    with pytest.raises(Refused):
        rig.gate.runner.send(c.Takeoff(1.0, 1.0), 1)
    # It is led back inside, not held where it is.
    for _ in range(80):
        rig.frame()
    assert fence().room(*rig.last.position) > 0.1


def test_reaction_is_in_the_step_of_the_frame():
    rig = Rig()
    rig.fly()
    count = len(rig.vehicle.sent)
    rig.vehicle.position = np.array([2.6, 0.0, 1.0])
    rig.vehicle.velocity = np.array([2.0, 0.0, 0.0])
    rig.frame()
    assert len(rig.vehicle.sent) == count + 1
    braking = rig.last
    assert braking.acceleration[0] == pytest.approx(-6.0)


def test_frozen_poses_count_as_stale():
    rig = Rig()
    rig.fly()
    for _ in range(16):
        rig.setpoint()
        rig.frame(repeat=True)
    assert rig.watchdog.action(1) is Action.HOLD
    assert rig.rules == {"pose_stale"}


def test_by_its_own_estimate_a_vehicle_may_repeat_itself_but_not_fall_silent():
    rig = Rig(independent=False)
    rig.fly()
    for _ in range(60):
        rig.setpoint()
        rig.frame(repeat=True)
    assert rig.watchdog.action(1) is Action.NONE
    for _ in range(20):
        rig.setpoint()
        rig.frame(accepted=False)
    assert rig.watchdog.action(1) is Action.HOLD
    assert "pose_stale" in rig.rules


def test_by_its_own_estimate_it_says_once_what_is_not_checked():
    rig = Rig(independent=False)
    rig.fly()
    told = [event for event in rig.watchdog.events if event.rule == "own_estimate"]
    (event,) = told
    assert event.severity is Action.WARN
    for rule in ("wrong_body", "body_turned", "strangers"):
        assert rule in event.detail
    # A vehicle that contradicts itself is none.
    rig.vehicle.estimate_apart = 2.0
    rig.fly()
    assert rig.rules == {"own_estimate"}
    rig.watchdog.renew()
    rig.fly()
    assert len([e for e in rig.watchdog.events if e.rule == "own_estimate"]) == 2


def test_outside_the_fence_by_its_own_estimate_it_is_taken_over():
    rig = Rig(independent=False)
    rig.fly()
    rig.vehicle.position = np.array([3.05, 0.0, 1.0])
    rig.fly(0.1)
    assert rig.watchdog.action(1) >= Action.HOLD


def test_a_vehicle_elsewhere_than_the_cameras_say_is_landed():
    rig = Rig()
    rig.fly()
    rig.vehicle.estimate_apart = 2.0
    rig.fly(0.5)
    assert "wrong_body" in rig.rules


def test_rejected_poses_and_swaps_are_seen():
    rig = Rig()
    rig.fly()
    rig.frame(accepted=False)
    assert rig.rules == {"pose_jump"}
    rig = Rig()
    rig.fly()
    rig.frame(events=[MocapEvent(0.0, EventKind.SWAP_CORRECTED, "cf1", "")])
    assert rig.rules == {"body_swap"}
    assert rig.watchdog.action(1) is Action.HOLD


def test_silence_of_the_cameras_is_noticed_without_frames():
    rig = Rig()
    rig.fly()
    for _ in range(40):
        rig.clock.sleep_until(rig.clock.now() + 0.005)
        rig.watchdog.step()
    assert rig.watchdog.action(1) is Action.HOLD


def test_silent_contestant_silent_vehicle_empty_battery():
    rig = Rig()
    rig.fly()
    for _ in range(42):
        rig.frame()  # nobody streams setpoints any more
    assert "controller_silent" in rig.rules
    rig = Rig()
    rig.vehicle.telemetry_time = 0.0
    rig.fly(0.35)
    assert "link_lost" in rig.rules
    rig = Rig()
    rig.vehicle.battery = 2.9
    rig.fly(1.2)
    assert rig.watchdog.action(1) is Action.LAND


def test_contestant_who_answers_without_streaming_is_watched_too():
    rig = Rig()
    rig.gate.runner.send(c.Takeoff(1.0, 2.0), 1)
    rig.watchdog.controller_answered(1)
    for _ in range(45):
        rig.frame()
    assert "controller_silent" in rig.rules
    rig = Rig()
    rig.gate.runner.send(c.Takeoff(1.0, 2.0), 1)
    rig.watchdog.controller_answered(1)
    rig.watchdog.controller_done(1)
    for _ in range(45):
        rig.frame()
    assert rig.watchdog.events == []


def test_late_scheduler_and_own_sleep():
    rig = Rig()
    rig.fly()
    rig.watchdog.step_late(0.3)
    rig.setpoint()
    rig.frame()
    assert rig.watchdog.action(1) is Action.HOLD
    rig = Rig()
    rig.fly()
    rig.clock.sleep_until(rig.clock.now() + 0.3)  # the machine was suspended
    rig.setpoint()
    rig.frame()
    assert "scheduler_late" in rig.rules


def test_camera_clock_that_jumps_ahead():
    rig = Rig()
    rig.fly()
    now = rig.clock.now() + 0.01
    rig.clock.sleep_until(now)
    bodies = {"cf1": Pose(rig.vehicle.position + rig.noise(), LEVEL)}
    rig.show(bodies, True, (), now, delay=-0.1)
    rig.watchdog.step()
    assert "clock_jump" in rig.rules
    assert rig.watchdog.action(1) is Action.LAND


def test_people_and_strangers():
    rig = Rig()
    rig.fly()
    rig.setpoint()
    rig.frame(gate3=(1, 1, 1), something=(2, 2, 1))
    assert rig.rules == {"strangers"}
    rig.setpoint()
    rig.frame(person_a=(2.0, 2.0, 2.4))
    assert rig.watchdog.action(1) is Action.LAND
    assert "person_inside" in rig.rules
    rig = Rig()
    rig.fly()
    rig.setpoint()
    rig.frame(person_a=(0.6, 0.6, 1.7))
    assert rig.watchdog.action(1) is Action.CUT
    assert rig.last == c.Emergency()


def test_dead_man_let_go():
    clock = VirtualClock()
    dead_man = DeadMan(clock)
    rig = Rig(clock, dead_man=dead_man)
    for _ in range(50):
        dead_man.held()
        rig.setpoint()
        rig.frame()
    assert rig.watchdog.events == []
    for _ in range(52):
        rig.setpoint()
        rig.frame()
    assert rig.watchdog.action(1) is Action.LAND


def test_operator_and_emergency_stop():
    rig = Rig()
    rig.fly()
    rig.watchdog.request(Action.LAND, "operator")
    rig.frame()
    assert rig.watchdog.action(1) is Action.LAND
    clock = VirtualClock()
    stop = EmergencyStop([], clock)
    rig = Rig(clock, estop=stop)
    rig.fly()
    stop.trigger("test")
    rig.frame()
    assert rig.watchdog.action(1) is Action.CUT
    stop.close()


def test_vehicles_in_hands_are_left_alone():
    rig = Rig()
    rig.vehicle.position = np.array([0.0, 4.0, 1.5])  # carried past the fence before the trial
    for _ in range(50):
        rig.frame()
    assert rig.vehicle.sent == []
    assert rig.watchdog.events == []
    rig.vehicle.position = np.array([0.0, 0.0, 1.0])
    rig.fly()
    rig.gate.runner.send(c.Land(0.0, 2.0), 1)
    rig.vehicle.position = np.array([0.0, 0.0, 0.03])
    for _ in range(150):
        rig.frame()
    count = len(rig.vehicle.sent)
    rig.vehicle.position = np.array([0.0, 4.0, 1.5])  # and after it
    for _ in range(50):
        rig.frame()
    assert len(rig.vehicle.sent) == count
    assert rig.watchdog.events == []


def test_it_feeds_from_take_off_on_until_it_cuts():
    rig = Rig()
    for _ in range(20):
        rig.frame()
    assert rig.vehicle.fed == []
    rig.fly(1.0)
    assert 9 <= len(rig.vehicle.fed) <= 11
    assert max(np.diff(rig.vehicle.fed)) < 0.2
    rig.watchdog.request(Action.CUT, "operator")
    fed = len(rig.vehicle.fed)
    for _ in range(50):
        rig.frame()
    assert len(rig.vehicle.fed) == fed
    emergencies = [one for _, one in rig.vehicle.sent if one == c.Emergency()]
    assert len(emergencies) == 15


def test_a_guard_that_fails_is_told_and_its_vehicle_no_longer_fed():
    rig = Rig()
    rig.fly(0.5)
    rig.vehicle.broken = True
    fed = len(rig.vehicle.fed)
    for _ in range(60):
        rig.frame()
    assert not rig.watchdog.healthy
    assert rig.rules == {"watchdog_failed"}
    assert len(rig.vehicle.fed) == fed


def test_landing_ends_with_motors_stopped_and_then_silence():
    rig = Rig()
    rig.fly()
    rig.watchdog.request(Action.LAND, "operator")
    for _ in range(600):
        rig.frame()
        if isinstance(rig.last, c.FullState):  # the vehicle does what it is told
            rig.vehicle.position = np.array(rig.last.position)
            rig.vehicle.position[2] = max(rig.vehicle.position[2], 0.03)
        if rig.watchdog.over(1):
            break
    assert rig.watchdog.over(1)
    assert rig.last == c.CutMotors()
    heights = [one.position[2] for _, one in rig.vehicle.sent if isinstance(one, c.FullState)]
    assert max(np.diff(heights)) < 1e-9
    assert rig.watchdog.action(1) is Action.LAND
    count = len(rig.vehicle.sent)
    for _ in range(50):
        rig.frame()
    assert len(rig.vehicle.sent) == count


def test_blind_landing_comes_down_by_the_reference_alone():
    rig = Rig()
    rig.fly()
    rig.vehicle.telemetry = lambda vehicle: Telemetry(-math.inf)
    for _ in range(900):
        rig.clock.sleep_until(rig.clock.now() + 0.01)
        rig.watchdog.step()
    assert rig.watchdog.over(1)


def test_watching_only_sends_nothing():
    rig = Rig(flies=False)
    rig.fly()
    rig.vehicle.position = np.array([3.05, 0.0, 1.0])
    count = len(rig.vehicle.sent)
    rig.frame()
    assert rig.watchdog.action(1) is Action.HOLD
    assert len(rig.vehicle.sent) == count


def test_bodies_must_fit_the_vehicles():
    clock = VirtualClock()
    vehicle = Vehicle(clock)
    gate = CommandGate(vehicle, fence(), clock)
    with pytest.raises(InputError, match="cf2"):
        Watchdog(gate, fence(), clock, {"cf2": 2}, vehicle.estimate)


def test_thread_reacts_to_a_frame_and_ends():
    rig = Rig(WallClock())
    rig.watchdog.start()
    try:
        now = rig.clock.now()
        rig.setpoint()
        rig.show({"cf1": Pose(rig.vehicle.position + rig.noise(), LEVEL)}, True, (), now)
        rig.vehicle.first_command.clear()
        rig.vehicle.position = np.array([3.05, 0.0, 1.0])
        now = rig.clock.now()
        rig.show({"cf1": Pose(rig.vehicle.position + rig.noise(), LEVEL)}, True, (), now)
        assert rig.vehicle.first_command.wait(5.0)
        assert isinstance(rig.last, c.FullState)
    finally:
        rig.watchdog.close()
    assert not any(thread.name == "watchdog" for thread in threading.enumerate())


def test_a_frozen_pose_with_jitter_is_found_as_an_old_one():
    rig = Rig()
    rig.fly()
    frozen = rig.vehicle.position.copy()
    for _ in range(40):
        now = rig.clock.now() + 0.01
        rig.clock.sleep_until(now)
        jitter = rig.rng.uniform(-1.0, 1.0, 3) * 3e-6
        rig.show({"cf1": Pose(frozen + jitter, LEVEL)}, True, (), now)
        rig.watchdog.step()
    taken = [e.rule for e in rig.watchdog.events if e.action.takes_over]
    assert taken[:1] == ["pose_stale"]


def test_nothing_takes_off_by_slow_cameras():
    rig = Rig()
    for k in range(20):
        now = 0.1 * (k + 1)
        rig.clock.sleep_until(now)
        rig.show({"cf1": Pose(rig.vehicle.position + rig.noise(), LEVEL)}, True, (), now)
        rig.watchdog.step()
    with pytest.raises(Refused, match="10 frames a second"):
        rig.gate.runner.send(c.Takeoff(1.0, 2.0), 1)
    for _ in range(120):
        rig.frame()
    rig.gate.runner.send(c.Takeoff(1.0, 2.0), 1)


def test_begun_anew_nothing_of_the_flight_before_counts():
    rig = Rig()
    rig.fly()
    rig.watchdog.request(Action.CUT, "test")
    rig.frame()
    with pytest.raises(Refused):
        rig.gate.runner.send(c.Takeoff(1.0, 2.0), 1)
    rig.gate.renew()
    rig.watchdog.renew()
    rig.fly()
    assert rig.watchdog.action(1) is Action.NONE
    assert rig.watchdog.events[-1].rule == "test"


def test_vehicles_that_come_too_close_are_held():
    clock = VirtualClock()
    pair = {1: Vehicle(clock), 2: Vehicle(clock)}
    pair[2].position = pair[1].position + np.array([1.0, 0.0, 0.0])

    class Both(Vehicle):
        vehicles = (1, 2)

        def telemetry(self, vehicle: int) -> Telemetry:
            return pair[vehicle].telemetry(1)

    link = Both(clock)
    gate = CommandGate(link, fence(), clock)
    bodies = {"cf1": 1, "cf2": 2}
    watchdog = Watchdog(
        gate, fence(), clock, bodies, lambda name: pair[bodies[name]].estimate("cf1")
    )
    rng = np.random.default_rng(2)
    taken_at = None
    for k in range(300):
        clock.sleep_until(clock.now() + 0.01)
        now = clock.now()
        pair[2].position = pair[2].position - np.array([0.003, 0.0, 0.0])
        frame = {}
        for name, vehicle in bodies.items():
            pair[vehicle].captured = now - 0.005
            frame[name] = Pose(pair[vehicle].position + rng.normal(0.0, 1e-4, 3), LEVEL)
            if not watchdog.action(vehicle).takes_over:
                place = as_point(pair[vehicle].position)
                gate.runner.send(c.FullState(place, ZERO, ZERO, 0.0, ZERO), vehicle)
        watchdog.on_frame(PoseFrame(now - 0.005, now, k, frame), FrameResult(frame, ()))
        watchdog.step()
        if taken_at is None and watchdog.action(1).takes_over and watchdog.action(2).takes_over:
            taken_at = float(pair[2].position[0] - pair[1].position[0])
    assert taken_at == pytest.approx(0.2, abs=0.01)
    assert {e.rule for e in watchdog.events if e.action is Action.HOLD} >= {"neighbour"}
