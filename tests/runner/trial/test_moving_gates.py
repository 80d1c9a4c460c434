"""Gates that move: followed, judged and told of where they are, whatever the cameras do."""

import io
import json

import numpy as np
import pytest
from rich.console import Console

from crazyarena.clock import VirtualClock, WallClock
from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.levels import load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.mocap.estimator import FrameResult
from crazyarena.mocap.survey import SurveyConfig, survey
from crazyarena.mocap.zenoh_link import ZenohSource
from crazyarena.runner.dry_run import DryRun
from crazyarena.runner.judging.referee import Referee
from crazyarena.runner.records import export
from crazyarena.runner.rig.rig import FrameListeners, simulated
from crazyarena.runner.rig.virtual_arena import VirtualArena
from crazyarena.runner.trial.injection import Injection
from crazyarena.runner.trial.moving_gates import MovingGates
from crazyarena.runner.trial.options import FlightOptions
from crazyarena.runner.trial.phase import MeasuredTrack, Timeouts
from crazyarena.runner.trial.phases import Crew
from crazyarena.runner.trial.tracked_world import TrackedWorld
from crazyarena.sim_backend.arena_world import Track, motions, track_truth
from crazyarena.sim_backend.physics.arena_plant import AB_CONTACT
from crazyarena.sim_backend.physics.scene import build_scene
from crazyarena.sim_backend.vehicles import VehicleChoice
from crazyarena.types import PoseFrame
from tests.runner.fakes import rows

# Gate 0 swings across the direction it is flown in, and turns; gate 3 drifts.
MOVING = """\
profile: arena
start: {position: [-0.9, -2.9, 0.03]}
goal: {position: [-0.5, 2.9, 0.75]}
track:
  gates:
    - {x: 0.5, y: -2.4, yaw: -1.57, type: tall, tracked: true,
       motion: {y: 0.2, yaw: 0.15, period: 8}}
    - {x: 2.0, y: -1.5, yaw: 0.0, type: low}
    - {x: 0.0, y: 0.2, yaw: 1.57, type: low}
    - {x: -0.5, y: 1.5, yaw: 0.0, type: tall, tracked: true, motion: {x: 0.2, period: 11}}
"""


@pytest.fixture
def level_file(tmp_path):
    file = tmp_path / "moving.yaml"
    file.write_text(MOVING)
    return str(file)


# The gates are on trial here, not the racer, which flies these only with quicker rotors.
QUICK = VehicleChoice(overrides=("rotors.lag_up=0.03", "rotors.lag_down=0.03"))


def run(level_file, out, seed=1, world=None):
    """Fly the example racer; returns the episode and the dry run."""
    dry = DryRun(
        None,
        level_file,
        seed=seed,
        out=out,
        figure=False,
        console=Console(file=io.StringIO()),
        options=FlightOptions(sandbox=False, compute="free"),
        vehicle=QUICK,
    )
    if world is not None:
        made = dry._make_world
        dry._make_world = lambda: world(made())
    return dry.run().episodes[0]


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """One flight on the moving level: level file, folder, episode, recording."""
    folder = tmp_path_factory.mktemp("moving")
    file = folder / "moving.yaml"
    file.write_text(MOVING)
    worlds = []

    def keep(world):
        worlds.append(world)
        begin = world.begin

        def beginning():
            world.staged = world.rig.pipeline.source._clock.now()
            return begin()

        world.begin = beginning
        return world

    episode = run(str(file), folder / "a", world=keep)
    return str(file), folder, episode, export.read(folder / "a" / "episode_000.mcap"), worlds[0]


def test_the_example_flies_through_gates_that_move(flown):
    _, _, episode, _, _ = flown
    assert episode.clean, episode.error
    assert episode.gates_passed == 4


def test_what_is_recorded_is_where_the_gates_truly_were(flown):
    file, _, _, recording, world = flown
    level = load_level(file)
    track = Track(LevelRandom(level, 1).reset(), motions(level))
    seen = recording.tables["gate"]
    assert set(seen[:, 1]) == {0.0, 3.0}
    for row in seen:
        time, gate = row[0], int(row[1])
        # The last pose of a control step is up to a frame and the cameras' delay old.
        truth = [track.gates(world.staged + time - age)[gate] for age in (0.0, 0.02)]
        low, high = np.min(truth, axis=0)[:6], np.max(truth, axis=0)[:6]
        margin = np.array([0.005, 0.005, 1e-9, 1e-9, 1e-9, 0.02])
        assert (row[2:] > low - margin).all()
        assert (row[2:] < high + margin).all()
    for gate, column in ((0, 3), (3, 2)):
        assert np.ptp(seen[seen[:, 1] == gate][:, column]) > 0.3


def test_the_contestant_is_told_the_present_pose_while_in_range(flown):
    _, _, episode, recording, _ = flown
    told = [r for r in episode.reveals if r["gate"] == 0 and r["in_range"]]
    assert len(told) >= 3
    steps = np.diff([r["time"] for r in told])
    assert (steps > 0.0999).all()
    assert np.ptp([r["pose"][1] for r in told]) > 0.02
    # At every control step, in the verdicts.
    columns = recording.columns["referee"]
    verdicts = recording.tables["referee"]
    near = verdicts[
        (verdicts[:, columns.index("target_gate")] == 0)
        & (verdicts[:, columns.index("in_range")] == 1)
    ]
    assert len(near) >= 10
    y = near[:, columns.index("gate_pose_1")]
    assert len(np.unique(y)) == len(y)
    far = verdicts[
        (verdicts[:, columns.index("target_gate")] == 0)
        & (verdicts[:, columns.index("in_range")] == 0)
    ]
    assert set(far[:, columns.index("gate_pose_1")]) == {-2.4}


def test_viewers_see_the_gates_move(flown):
    _, folder, *_ = flown
    from mcap.reader import make_reader

    with open(folder / "a" / "episode_000.mcap", "rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        scenes = [
            (m.log_time, json.loads(m.data)) for _, _, m in reader.iter_messages(topics=["/scene"])
        ]
    assert len(scenes) > 20
    first, later = scenes[0][1], scenes[1:]
    assert {e["id"] for e in first["entities"]} >= {"gate 0", "gate 1", "goal"}
    assert {e["id"] for _, s in later for e in s["entities"]} == {"gate 0", "gate 3"}
    assert (np.diff([time for time, _ in later]) >= 0.0999e9).all()


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes(flown):
    file, folder, *_ = flown
    run(file, folder / "b")
    a, b = ((folder / name / "episode_000.mcap").read_bytes() for name in ("a", "b"))
    assert a == b


@pytest.mark.slow
def test_a_lost_gate_stays_where_it_was_seen_last(tmp_path, level_file):
    def hide(world):
        source = world.rig.pipeline.source
        expose = source.expose
        begin = world.begin

        def beginning():
            start = begin()

            def partly(time, truth):
                if 2.0 < time - start < 4.0:
                    truth = {name: pose for name, pose in truth.items() if name != "gate4"}
                expose(time, truth)

            source.expose = partly
            return start

        world.begin = beginning
        return world

    episode = run(level_file, tmp_path / "out", world=hide)
    events = {e.name: e for e in episode.events if e.name in ("gate lost", "gate seen again")}
    assert events["gate lost"].detail == events["gate seen again"].detail == "gate 3"
    assert 2.1 < events["gate lost"].time < 2.3
    assert 4.0 < events["gate seen again"].time < 4.2
    seen = export.read(tmp_path / "out" / "episode_000.mcap").tables["gate"]
    seen = seen[seen[:, 1] == 3]
    assert not ((seen[:, 0] > 2.25) & (seen[:, 0] < 4.0)).any()
    before, after = seen[seen[:, 0] < 2.25][-1], seen[seen[:, 0] > 4.0][0]
    assert abs(after[2] - before[2]) > 0.02
    assert episode.gates_passed >= 3


# The referee


def moved(level, offset):
    gates = np.array([gate.row for gate in level.track.gates], dtype=float)
    gates[:, 2] = [gate.centre[2] for gate in level.track.gates]
    gates[0, 1] += offset
    return gates


@pytest.mark.parametrize(("flown_at", "passed"), [(-2.0, 1), (-2.5, 0)])
def test_passing_is_judged_where_the_gate_is_at_that_moment(flown_at, passed):
    level = load_level("level0", ["track.obstacles=[]"])
    still, away = moved(level, 0.0), moved(level, 0.5)
    asked = []

    def follow(time):
        asked.append(time)
        return still if time < 0.7 else away

    referee = Referee(level)
    referee.begin(still, np.zeros((0, 6)), follow)
    for k in range(60):
        # Through the place x = 0.5 after one second.
        path = [[0.5 + 0.5 * (t / 500 - 1.0), flown_at, 1.0] for t in range(16 * k, 16 * k + 16)]
        verdict = referee.judge(rows(path, first_tick=1 + 16 * k))
    assert referee.gates_passed == passed
    assert asked == sorted(asked)
    assert verdict.info["current_target_gate_id"] == passed


def test_gates_that_stand_are_judged_as_without_following():
    level = load_level("level2")
    gates = moved(level, 0.0)
    obstacles = np.array([o.row for o in level.track.obstacles], dtype=float)
    rng = np.random.default_rng(3)
    path = np.cumsum(rng.normal(0.0, 0.004, (1600, 3)), axis=0) + [0.5, -2.5, 1.0]
    verdicts = []
    for follow in (None, lambda time: gates):
        referee = Referee(level)
        referee.begin(gates, obstacles, follow)
        told = []
        for k in range(100):
            verdict = referee.judge(rows(path[16 * k : 16 * k + 16], 1 + 16 * k))
            told.append((verdict.row.copy(), list(verdict.events), verdict.info["collision"]))
        verdicts.append(told)
    for (a, b, c), (d, e, f) in zip(*verdicts, strict=True):
        np.testing.assert_array_equal(a, d)
        assert (b, c) == (e, f)
    assert any(events for _, events, _ in verdicts[0])


# The follower, frame by frame


class Cameras:
    """Frames of one gate for a follower, by hand."""

    def __init__(self, level):
        self.clock = VirtualClock()
        self.listeners = FrameListeners()
        self.level = level
        self.gates = MovingGates(level, self)
        self.places = moved(level, 0.0)
        self.gates.begin(self.places)
        self.rng = np.random.default_rng(0)
        self._frame = 0
        self.outlet = []
        self.injection = Injection(self)
        self.injection.begin(MeasuredTrack(self.places, np.zeros((0, 6)), "measured"), level, None)

    def put(self, key, value):
        self.outlet.append((key, value))

    def close(self):
        pass

    def start(self, frames=20):
        self.show(frames)
        self.epoch = self.clock.now()
        self.gates.start(self.epoch)

    def show(self, frames, hide=(), **offsets):
        """Frames at 120 Hz; offsets [x, y, yaw] by body."""
        for _ in range(frames):
            self.clock.sleep_until(self.clock.now() + 1 / 120)
            feet = self.places.copy()
            feet[:, 2] = 0.0
            for name, offset in offsets.items():
                feet[int(name[4:]) - 1, [0, 1, 5]] += offset
            feet[:, :2] += self.rng.normal(0.0, 0.0005, feet[:, :2].shape)
            bodies = track_truth(feet, np.zeros((0, 6)))
            bodies = {name: pose for name, pose in bodies.items() if name not in hide}
            now = self.clock.now()
            self._frame += 1
            self.listeners.on_frame(PoseFrame(now, now, self._frame, bodies), FrameResult({}, ()))

    def look(self):
        time = self.clock.now() - self.epoch
        self.gates.tell(time, None, self.injection)
        return self.gates.at(time)

    def told(self):
        return [event.name for event in self.gates.events]


@pytest.fixture
def cameras():
    level = load_level("sim2real", ["track.gates[0].tracked=true", "track.gates[1].tracked=true"])
    made = Cameras(level)
    made.start()
    return made


def test_it_follows_and_leaves_the_others_alone(cameras):
    for k in range(60):
        cameras.show(2, gate1=[0.002 * k, 0.0, 0.004 * k], gate3=[0.3, 0.0, 0.0])
        cameras.look()
    now = cameras.look()
    np.testing.assert_allclose(now[0, [0, 1, 5]], [0.5 + 0.118, -2.5, -1.57 + 0.236], atol=4e-3)
    np.testing.assert_array_equal(now[2:], cameras.places[2:])
    assert cameras.told() == []
    keys = [key for key, _ in cameras.outlet if key.endswith("measured")]
    assert keys.count("gates/0/measured") in (9, 10, 11)  # of 1 s
    assert keys.count("gates/1/measured") == 1


def test_one_frame_elsewhere_is_not_believed(cameras):
    cameras.show(5)
    before = cameras.look().copy()
    cameras.show(1, gate1=[0.5, 0.0, 0.0])
    cameras.show(1)
    np.testing.assert_allclose(cameras.look(), before, atol=2e-3)
    assert cameras.told() == ["gate jump not believed"]


def test_swapped_names_are_put_right(cameras):
    first, second = cameras.places[0], cameras.places[1]
    there = second[[0, 1, 5]] - first[[0, 1, 5]]
    before = cameras.look().copy()
    cameras.show(5, gate1=there, gate2=-there)
    np.testing.assert_allclose(cameras.look(), before, atol=3e-3)
    assert "gate name corrected" in cameras.told()


def test_a_gate_that_was_carried_away_for_good_is_found_there(cameras):
    cameras.show(30, hide=("gate1",))
    held = cameras.look()
    np.testing.assert_allclose(held, cameras.places, atol=5e-3)
    cameras.show(10, gate1=[0.3, 0.2, 0.0])
    np.testing.assert_allclose(cameras.look()[0, :2], [0.8, -2.3], atol=3e-3)
    assert cameras.told() == ["gate lost", "gate seen again"]


def test_a_gate_outside_of_the_arena_is_none(cameras):
    cameras.show(30, hide=("gate1",))
    cameras.show(20, gate1=[-9.0, 0.0, 0.0])
    np.testing.assert_allclose(cameras.look()[0, :2], [0.5, -2.5], atol=5e-3)
    assert cameras.told()[-1] == "gate jump not believed"


def test_a_half_turn_of_a_gate_changes_nothing(cameras):
    cameras.show(60, gate1=[0.0, 0.0, np.pi])
    np.testing.assert_allclose(cameras.look()[0], cameras.places[0], atol=5e-3)


# Survey and simulation


def test_the_survey_takes_a_gate_that_moves_where_it_is_now():
    nominal = track_truth(np.array([[0.0, 0, 0, 0, 0, 0.5], [1.0, 0, 0, 0, 0, 0]]), [])
    frames = []
    for k in range(50):
        feet = np.array([[0.01 * k, 0, 0, 0, 0, 0.5 + 0.01 * k], [1.0, 0, 0, 0, 0, 0]])
        frames.append(PoseFrame(k / 120, k / 120, k, track_truth(feet, [])))
    config = SurveyConfig(frames=50)
    assert "gate1" in survey(frames, nominal, config).problems[0]
    track = survey(frames, nominal, config, ["gate1"]).track()
    assert track["gate1"].position[0] == pytest.approx(0.445)
    unseen = [PoseFrame(f.timestamp, f.received, f.frame_id, {}) for f in frames]
    assert len(survey(unseen, nominal, config, ["gate1"]).problems) == 2


def hover_beside_gate(level):
    """Whether a vehicle that hovers at (0.5, -1.7, 1.0) is touched within 6 s."""
    rig = simulated(level, 3, guarded=False)
    world = TrackedWorld(rig)
    fleet = rig.backend._fleet
    touched = False
    try:
        world.reset(LevelRandom(level, 3).reset())
        crew = Crew(rig, world, level, timeouts=Timeouts(countdown=1.0))
        crew.prepare()
        crew.launch()
        for k in range(270):
            x, y, z = np.array([0.5, -1.7, 1.0]) * min(1.0, k / 90) + np.array(
                [-0.9, -2.9, 0.0]
            ) * max(0.0, 1.0 - k / 90)
            world.send(cs.FullState((x, y, z), (0, 0, 0), (0, 0, 0), 0.0, (0, 0, 0)))
            for _ in range(4):
                rig.clock.sleep_until(rig.clock.now() + 1 / 120)
                touched |= bool(k > 60 and fleet.bodies[0, AB_CONTACT] >= 0.0)
        return touched
    finally:
        world.close()


@pytest.mark.parametrize("swing", [True, False])
def test_the_simulated_gate_truly_is_there(swing):
    """A beam sweeps over a vehicle that hovers beside the gate."""
    overrides = [
        "randomization={}",
        "track.obstacles=[]",
        "track.gates=[{x: 0.5, y: -2.4, yaw: 1.57, type: tall, tracked: true, "
        + ("motion: {y: 0.5, period: 6}}]" if swing else "}]"),
    ]
    assert hover_beside_gate(load_level("sim2real", overrides)) is swing


@pytest.mark.slow
def test_the_virtual_arena_shows_the_gates_moving(level_file, tmp_path):
    level = load_level(level_file, ["track.gates[0].motion.period=2.0"])
    clock = WallClock()
    seen = []
    with VirtualArena(level, 1, tmp_path) as arena:
        source = ZenohSource(clock, connect=[arena.endpoint])
        try:
            end = clock.now() + 20.0
            while len(seen) < 360 and clock.now() < end:
                seen += [
                    f.bodies for f in source.frames(0.1) if {"gate1", "gate2"} <= set(f.bodies)
                ]
        finally:
            source.close()
    y = [[bodies[name].position[1] for bodies in seen] for name in ("gate1", "gate2")]
    assert np.ptp(y[0]) == pytest.approx(0.4, abs=0.01)
    assert np.ptp(y[1]) < 0.01


def test_geometry_and_cameras_see_the_same_gate(level_file):
    level = load_level(level_file)
    draw = LevelRandom(level, 1).reset()
    track = Track(draw, motions(level))
    for time in (0.0, 1.3, 5.0):
        gates = track.gates(time)
        np.testing.assert_array_equal(track.scene(time), build_scene(gates, draw.obstacles))
        bodies = track.bodies(time)
        np.testing.assert_allclose(bodies["gate1"].position[:2], gates[0, :2])
        assert bodies["gate1"].position[2] == 0.0
    np.testing.assert_array_equal(track.gates(3.0)[1], draw.gates[1])
