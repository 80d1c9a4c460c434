"""Phases around a run, on the simulated rig: what each refuses, and that every way ends down."""

import math

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.levels import load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.runner.judging.referee import Referee
from crazyarena.runner.rig.rig import simulated
from crazyarena.runner.trial.phase import Aborted, Grip, Phase, Timeouts
from crazyarena.runner.trial.phases import Crew
from crazyarena.runner.trial.site import LevelSite
from crazyarena.runner.trial.tracked_world import TrackedWorld
from crazyarena.sim_backend.firmware.supervisor import INFO_ARMED, INFO_FLYING

QUICK = Timeouts(
    connect=0.5, preflight=3.0, survey=3.0, arm=1.0, countdown=1.0, disarm=1.0, grip=5.0
)


@pytest.fixture
def level():
    return load_level("sim2real")


@pytest.fixture
def stand(level):
    """Make a staged rig with its crew; closed afterwards."""
    worlds = []

    def make(move=(0.0, 0.0), cameras=None, **options):
        rig = simulated(level, 5, cameras)
        world = TrackedWorld(rig)
        worlds.append(world)
        draw = LevelRandom(level).reset()
        if move != (0.0, 0.0):
            start = draw.start.copy()
            start[[0, 2]] += move
            draw = type(draw)(
                start, draw.mass, draw.inertia, draw.gates, draw.nominal_gates, draw.obstacles,
                draw._noise,
            )  # fmt: skip
        world.reset(draw)
        told = []
        crew = Crew(
            rig, world, level, on_phase=lambda p, t: told.append((p, t)), timeouts=QUICK, **options
        )
        return rig, world, crew, draw, told

    yield make
    for world in worlds:
        world.close()


def fleet(rig):
    return rig.safeguard.gate._backend._fleet


def test_the_survey_finds_the_drawn_track(stand):
    _rig, world, crew, draw, _ = stand()
    track = crew.prepare()
    np.testing.assert_allclose(track.gates, draw.gates, atol=2e-3)
    np.testing.assert_allclose(track.obstacles[:, :3], draw.obstacles[:, :3], atol=2e-3)
    assert track.source == "measured"
    state = world.state()
    np.testing.assert_allclose(state[[0, 2]], draw.start[[0, 2]], atol=3e-3)


def test_phases_come_in_order_and_end_on_the_ground(stand, level):
    rig, world, crew, draw, told = stand()
    crew.prepare()
    crew.launch()
    assert rig.backend.telemetry(1).supervisor & INFO_ARMED
    world.begin()
    start = draw.start
    for k in range(60):
        world.send(
            cs.FullState((start[0], start[2], 0.02 * k), (0, 0, 0.6), (0, 0, 0), 0.0, (0, 0, 0))
        )
        rig.clock.sleep_until(rig.clock.now() + 1 / 30)
    assert fleet(rig).true_pose(0).position[2] > 0.8
    crew.bring_home()
    assert not fleet(rig).supervisor_info(0) & (INFO_ARMED | INFO_FLYING)
    # Switched off where it seemed to stand: the last centimetres on the cushion it falls.
    rig.clock.sleep_until(rig.clock.now() + 0.5)
    place = fleet(rig).true_pose(0).position
    assert place[2] < 0.03
    assert np.linalg.norm(place[:2] - draw.start[[0, 2]]) < 0.1
    phases = [p for p, text in told if not text]
    assert phases == [
        Phase.CONNECT, Phase.PREFLIGHT, Phase.SURVEY, Phase.ARM, Phase.COUNTDOWN, Phase.RETURN,
        Phase.DISARM,
    ]  # fmt: skip


def test_ground_contact_counts_from_lift_off_on(stand, level):
    rig, world, crew, draw, _ = stand()
    track = crew.prepare()
    crew.launch()
    referee = Referee(level)
    referee.begin(track.gates, track.obstacles)
    world.begin()
    rig.clock.sleep_until(rig.clock.now() + 0.5)
    assert not referee.judge(world.poll()).collided
    start = draw.start
    for k in range(75):
        height = 0.4 if k < 20 else 0.0
        world.send(cs.FullState((start[0], start[2], height), (0, 0, 0), (0, 0, 0), 0.0, (0, 0, 0)))
        rig.clock.sleep_until(rig.clock.now() + 1 / 30)
        verdict = referee.judge(world.poll())
    assert verdict.collided
    assert verdict.info["collision"] == (0, True)


def test_a_vehicle_at_the_wrong_place_does_not_take_off(stand):
    _, _, crew, _, _ = stand(move=(0.4, 0.0))
    with pytest.raises(Aborted, match=r"pre-flight: vehicle 1 stands 0\.\d+ m from the start"):
        crew.prepare()


def test_blind_cameras_stop_it_on_the_ground(stand):
    _, _, crew, _, _ = stand(cameras=CameraModel(frame_loss=1.0))
    with pytest.raises(Aborted, match="connect: no frames from the cameras"):
        crew.prepare()


def test_a_gate_that_stands_elsewhere_is_refused(stand, level):
    rig, _world, crew, _draw, _ = stand()
    # The arena has a gate 0.5 m away from where the level wants it.
    crew._site = LevelSite(load_level("sim2real", ["track.gates[1].x=2.6"]))
    with pytest.raises(Aborted, match=r"survey: .*gate2 stands"):
        crew.prepare()
    assert fleet(rig).true_pose(0).position[2] < 0.03


def test_the_operator_may_say_no(stand):
    rig, _, crew, _, _ = stand(confirm=lambda question: False)
    crew.prepare()
    with pytest.raises(Aborted, match="arm: the operator said no"):
        crew.launch()
    assert fleet(rig).true_pose(0).position[2] < 0.03


def test_further_checks_speak_before_arming(stand):
    _, _, crew, _, _ = stand(checks=(lambda: ["the net is open"],))
    with pytest.raises(Aborted, match="pre-flight: the net is open"):
        crew.prepare()


def test_abort_in_the_air_lands_where_it_is(stand):
    rig, world, crew, _draw, _ = stand()
    crew.prepare()
    crew.launch()
    world.send(cs.Takeoff(0.8, 1.5))
    rig.clock.sleep_until(rig.clock.now() + 2.5)
    assert fleet(rig).true_pose(0).position[2] > 0.6
    crew.abort()
    assert fleet(rig).true_pose(0).position[2] < 0.05


def test_a_tumbled_vehicle_is_not_flown_home(stand):
    rig, world, crew, _draw, told = stand()
    crew.prepare()
    crew.launch()
    world.send(cs.Emergency())
    rig.clock.sleep_until(rig.clock.now() + 0.5)
    crew.bring_home()
    assert any("cannot fly any more" in text for _, text in told)
    assert fleet(rig).true_pose(0).position[2] < 0.05


def test_ctrl_c_in_the_countdown_is_an_abort(stand):
    rig, _world, crew, _draw, told = stand()
    crew.prepare()
    crew.interrupted = lambda: told[-1][0] is Phase.COUNTDOWN
    with pytest.raises(Aborted, match="countdown: interrupted"):
        crew.launch()
    assert fleet(rig).true_pose(0).position[2] < 0.03


class Held:
    """A dead-man's key that is held until ``until`` on the clock, from ``since`` on."""

    def __init__(self, clock, since=-math.inf, until=math.inf):
        self.clock, self.since, self.until = clock, since, until

    def age(self):
        now = self.clock.now()
        return math.inf if now < self.since else max(0.0, now - self.until)


def test_it_is_not_armed_before_the_key_is_held(stand):
    rig, _world, crew, _draw, told = stand()
    crew.prepare()
    began = rig.clock.now()
    crew.grip = Grip(Held(rig.clock, since=began + 2.0), "h", 0.5)
    crew.launch()
    assert rig.clock.now() - began >= 2.0 + 1.0 + QUICK.countdown
    texts = [text for phase, text in told if phase is Phase.ARM]
    assert any("hold h now" in text for text in texts)
    assert texts[-1] == "vehicle 1 is armed"


def test_a_key_that_nobody_holds_is_an_abort(stand):
    rig, _world, crew, _draw, told = stand()
    crew.prepare()
    crew.grip = Grip(Held(rig.clock, since=math.inf), "h", 0.5)
    with pytest.raises(Aborted, match="arm: nobody holds h"):
        crew.launch()
    assert not any(text == "vehicle 1 is armed" for _, text in told)


def test_a_key_tapped_now_and_then_is_not_held(stand):
    rig, _world, crew, _draw, _ = stand()
    crew.prepare()

    class Tapped:
        def age(self):
            return rig.clock.now() % 0.8

    crew.grip = Grip(Tapped(), "h", 0.5)
    with pytest.raises(Aborted, match="arm: nobody holds h"):
        crew.launch()


def test_letting_go_in_the_countdown_is_an_abort(stand):
    rig, _world, crew, _draw, told = stand()
    crew.prepare()
    crew.grip = Grip(Held(rig.clock, until=rig.clock.now() + 1.2), "h", 0.3)
    with pytest.raises(Aborted, match="countdown: the operator let go of h"):
        crew.launch()
    assert any(text == "vehicle 1 is armed" for _, text in told)
    assert fleet(rig).true_pose(0).position[2] < 0.03


def test_letting_go_on_the_way_home_lands_it_with_its_motors_on(stand):
    rig, world, crew, _draw, told = stand()
    crew.prepare()
    crew.launch()
    world.send(cs.Takeoff(1.2, 2.0))
    rig.clock.sleep_until(rig.clock.now() + 3.0)
    hold = Held(rig.clock, until=rig.clock.now() + 0.5)
    rig.safeguard.must_hold(hold)
    crew.grip = Grip(hold, "h", 0.5)
    fastest = 0.0

    def watch(frame, result):
        nonlocal fastest
        fastest = min(fastest, float(fleet(rig).true_state(0).velocity[2]))

    rig.listeners.frames.append(watch)
    with pytest.raises(Aborted, match="return-and-land"):
        crew.bring_home()
    assert rig.safeguard.verdict().startswith("the watchdog has taken over: dead_man")
    assert fleet(rig).true_pose(0).position[2] < 0.05
    # A vehicle whose motors are cut at this height falls at 4 m/s.
    assert -1.2 < fastest < -0.3
    assert told[-1] == (Phase.DISARM, "you may let go of h")


def test_what_does_not_get_home_is_landed_before_its_motors_are_cut(stand, monkeypatch):
    rig, world, crew, _draw, _ = stand()
    crew.prepare()
    crew.launch()
    world.send(cs.Takeoff(1.2, 2.0))
    rig.clock.sleep_until(rig.clock.now() + 3.0)
    crew._home = crew._home + np.array([0.0, 1.0, 0.0])  # not where it took off
    send, gone = crew._send, []

    def obeys_once(command):
        # It goes up, but does not obey when it is sent home.
        if not isinstance(command, cs.GoTo) or not gone:
            send(command)
        if isinstance(command, cs.GoTo):
            gone.append(command)

    monkeypatch.setattr(crew, "_send", obeys_once)
    fastest = 0.0

    def watch(frame, result):
        nonlocal fastest
        fastest = min(fastest, float(fleet(rig).true_state(0).velocity[2]))

    rig.listeners.frames.append(watch)
    with pytest.raises(Aborted, match="does not get where it is sent"):
        crew.bring_home()
    assert fleet(rig).true_pose(0).position[2] < 0.05
    assert fastest > -1.2
