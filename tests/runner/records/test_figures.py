"""Pictures of flights: what they say, and which episodes get one."""

import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.runner.judging.referee import Event
from crazyarena.runner.judging.result import EpisodeResult
from crazyarena.runner.records.arena_figure import save_arena
from crazyarena.runner.records.bodies import Body, distances
from crazyarena.runner.records.drawing import MANY, Choice, Drawer, Figures
from crazyarena.runner.records.figure import numbered, save_figure
from crazyarena.runner.records.ground import ground_of, lsy_ground
from crazyarena.runner.records.marks import marks
from crazyarena.runner.records.picture import picture
from crazyarena.runner.records.scene import scene_update
from crazyarena.runner.records.sheet import MOST_TILES, chosen, save_sheet, tile
from crazyarena.safety.fence import Fence
from crazyarena.sim_backend.trace import TR_SETPOINT, TR_TIME, TRACE_SIZE

PNG = b"\x89PNG"


def episode(events=(), index=3, **fields):
    values = {
        "termination": "COLLISION", "flight_time": 4.0, "gates_passed": 1, "gates": 4,
        "completed": False, "collisions": 1, "violations": 0, "reward": 0.0,
        "interstep_learning_time": 0.0, "interstep_learning_average": 0.0,
        "interepisode_learning_time": 0.0, "steps": 120, "gate_times": [1.5], "compute_ms": {},
        "over_period": 0, "late_ms": {}, "skipped_steps": 0,
        "why": "COLLISION with gate 1 (left bar) at 3.99 s", "events": list(events), **fields,
    }  # fmt: skip
    return EpisodeResult(index, **values)


def states(seconds=4.0):
    rows = np.zeros((int(seconds * 500), TRACE_SIZE))
    rows[:, TR_TIME] = np.arange(1, len(rows) + 1) / 500
    rows[:, 1] = rows[:, TR_TIME] - 1.0
    rows[:, 2] = -2.5
    rows[:, 3] = 1.0
    rows[:, TR_SETPOINT : TR_SETPOINT + 3] = 7.0
    return rows


@pytest.fixture
def level():
    return load_level("level0")


def shown(level, events=(), rows=None, **fields):
    gates = np.array([[*gate.row[:2], gate.centre[2], *gate.row[3:]] for gate in level.track.gates])
    obstacles = np.array([post.row for post in level.track.obstacles])
    result = episode(events, **fields)
    scene = scene_update(gates, obstacles, level)["entities"]
    ground = ground_of(level, gates, obstacles)
    rows = states() if rows is None else rows
    return picture(ground, result, rows, entities=scene, commanded_from=0.5)


def texts(level, monkeypatch, tmp_path, what):
    """Everything that is written in a picture."""
    from matplotlib.figure import Figure
    from matplotlib.text import Text

    drawn = []

    def keep(figure, stream, **options):
        drawn.extend(t.get_text() for t in figure.findobj(Text))

    monkeypatch.setattr(Figure, "savefig", keep)
    save_figure(tmp_path / "a.png", what)
    return "\n".join(drawn)


def test_a_picture_tells_why_and_names_what_happened(level, monkeypatch, tmp_path):
    events = [
        Event("contact", 1990, 3.98, "gate 1"),
        Event("contact", 1995, 3.99, "gate 1"),
        Event("deadline missed", 600, 1.2, "1 in a row"),
        Event("fence: landing", 1800, 3.6, "0.02 m beyond"),
    ]
    told = texts(level, monkeypatch, tmp_path, shown(level, events))
    assert "level0, episode 3: COLLISION with gate 1 (left bar) at 3.99 s" in told
    assert "(not isolated)" in told
    assert "contact: gate 1 (×2)" in told
    assert "fence: landing: 0.02 m beyond" in told
    assert "deadline missed (×1)" in told
    assert re.search(r"nearest gate 0 0\.\d\d m", told)
    assert "1 (nearest)" in told


def test_nothing_is_commanded_before_the_first_command_or_after_the_run(level):
    what = shown(level, flight_time=3.0)
    commanded = np.isfinite(what.setpoint).all(axis=1)
    assert what.time[commanded].min() == pytest.approx(0.5, abs=0.01)
    assert what.time[commanded].max() == pytest.approx(3.1, abs=0.01)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_hardly_any_flight_is_drawn_too(level, tmp_path, count):
    bare = level.model_copy(
        update={"track": level.track.model_copy(update={"gates": (), "obstacles": ()})}
    )
    ground = ground_of(bare, np.empty((0, 7)), np.empty((0, 6)))
    what = picture(ground, episode(), states()[:count])
    save_figure(tmp_path / "a.png", what)
    assert (tmp_path / "a.png").read_bytes()[:4] == PNG


def test_a_flight_out_of_this_world_is_drawn_too(level, tmp_path):
    rows = states()
    rows[1000:, 1:4] = np.nan
    rows[900:1000, 1:4] = 1e12
    what = shown(level, rows=rows)
    save_figure(tmp_path / "a.png", what)
    assert (tmp_path / "a.png").read_bytes()[:4] == PNG


def test_a_rotor_that_is_slow_for_a_tick_is_no_mark_and_one_that_stays_is():
    low = "rotor 0 force below the minimum"
    start = [
        Event("constraint violated", 1, 0.002, low),
        Event("constraint satisfied again", 2, 0.004, ""),
    ]
    assert marks(start) == []
    assert [mark.kind for mark in marks(start[:1])] == ["violation"]


def test_marks_of_results_and_of_recordings_are_the_same():
    event = Event("tumbled", 5, 0.01, "")
    as_read = {"event": "tumbled", "tick": 5, "time": 0.01, "detail": ""}
    assert marks([event]) == marks([as_read])


@given(
    point=st.tuples(*[st.floats(-3, 3)] * 3),
    half=st.tuples(*[st.floats(0.05, 1)] * 3),
    yaw=st.floats(-3, 3),
)
def test_distance_to_a_box_is_that_to_its_nearest_point(point, half, yaw):
    from scipy.spatial.transform import Rotation

    body = Body("cubes", np.array([0.3, -0.2, 0.5]), Rotation.from_euler("z", yaw), np.array(half))
    point = np.array(point)
    local = body.turn.inv().apply(point - body.centre)
    nearest = body.centre + body.turn.apply(np.clip(local, -body.half, body.half))
    found = float(body.distance(point)[0])
    if (np.abs(local) <= body.half).all():
        assert found == pytest.approx(-min(body.half - np.abs(local)), abs=1e-9)
    else:
        assert found == pytest.approx(np.linalg.norm(point - nearest), abs=1e-9)


def test_the_middle_of_a_gate_is_as_far_from_it_as_its_bars_are(level):
    gates = np.array([[*gate.row[:2], gate.centre[2], *gate.row[3:]] for gate in level.track.gates])
    scene = scene_update(gates, np.empty((0, 6)), level)["entities"]
    found = distances(gates[:1, :3], scene)
    assert list(found) == ["gate 0", "gate 1", "gate 2", "gate 3"]
    assert found["gate 0"][0] == pytest.approx(0.2)


def test_openings_are_those_of_the_gates_that_stand_there(level):
    from crazyarena.runner.records.bodies import gate_openings
    from crazyarena.runner.records.lsy_scene import lsy_scene

    gates = np.array([[*gate.row[:2], gate.centre[2], *gate.row[3:]] for gate in level.track.gates])
    found = gate_openings(scene_update(gates, np.empty((0, 6)), level)["entities"])
    assert list(found) == ["gate 0", "gate 1", "gate 2", "gate 3"]
    assert [half for _, half in found.values()] == pytest.approx([0.2] * 4)
    assert np.allclose([centre for centre, _ in found.values()], gates[:, :3])
    other = lsy_scene(np.array([[1.0, 2.0, 0.7, 0.0, 0.0, 0.0, 1.0]]), np.empty((0, 3)))
    ((centre, half),) = gate_openings(other["entities"]).values()
    assert centre == pytest.approx([1.0, 2.0, 0.7])
    assert 0.15 < half < 0.3


def test_gates_of_lsy_are_named_in_the_order_they_are_passed(monkeypatch, tmp_path):
    from crazyarena.levels.lsy import load_lsy_level
    from crazyarena.runner.records.lsy_scene import lsy_scene

    level = load_lsy_level("lsy/level0", ["env.track.gate_order=[3,-1]"])
    gates = np.array([[*g.pos, 0.0, 0.0, 0.0, 1.0] for g in level.env.track.gates])
    tops = np.array([pole.pos for pole in level.env.track.obstacles])
    ground = lsy_ground(level, gates, gates, tops)
    assert [line.mean(axis=0).tolist() for line in ground.gates] == gates[:, :2].tolist()
    # Flown through along x: from above it spans y.
    assert np.ptp(ground.gates[0], axis=0) == pytest.approx([0.0, 0.72])
    assert ground.nominal == []
    assert ground.goal is None
    what = picture(
        ground,
        episode([Event("gate passed", 75, 1.5, "gate 2"), Event("contact", 1, 3.0, "gate 0")]),
        states(),
        entities=lsy_scene(gates, tops)["entities"],
    )
    assert [(hole.gate, hole.passed) for hole in what.openings] == [
        ("gate 2", True),
        ("gate 0", False),
    ]
    told = texts(None, monkeypatch, tmp_path, what)
    assert "0 (nearest)" in told
    assert "lsy-level0" in told
    assert "contact: gate 0" in told


def drawn(choice, outcomes):
    """Numbers of the episodes drawn; every failure is of a kind of its own."""
    return [i for i, clean in enumerate(outcomes) if choice(clean, f"COLLISION with gate {i}")]


def test_which_episodes_are_drawn():
    few = [True] * MANY
    assert drawn(Choice(Figures.AUTO, MANY), few) == list(range(MANY))
    many = [True, False, True, False] * 10
    assert drawn(Choice(Figures.AUTO, 40), many) == [0, 1, 3, 5, 7]
    assert drawn(Choice(Figures.AUTO, 40), [True] * 40) == [0]
    assert drawn(Choice(Figures.ALL, 40), many) == list(range(40))
    assert drawn(Choice(Figures.FAILURES, 40), many) == list(range(1, 40, 2))
    assert drawn(Choice(Figures.NONE, 40), many) == []
    assert Choice(Figures.AUTO, MANY + 1).sheet
    assert not Choice(Figures.AUTO, MANY).sheet
    assert not Choice(Figures.NONE, 100).sheet


def test_failures_of_one_kind_are_drawn_once():
    def why(i):
        return f"COLLISION with gate {i % 2} (left bar) at {i}.{i} s, -{i}.25 m left of its centre"

    choice = Choice(Figures.AUTO, 40)
    assert [i for i in range(40) if choice(False, why(i))] == [0, 1]
    assert choice.left == 38
    choice = Choice(Figures.FAILURES, 40)
    assert [i for i in range(40) if choice(False, why(i))] == list(range(40))
    choice = Choice(Figures.AUTO, MANY)
    assert [i for i in range(MANY) if choice(False, why(i))] == list(range(MANY))


def test_choices_by_word_and_by_yes_or_no():
    assert Figures.of(True) is Figures.AUTO
    assert Figures.of(False) is Figures.NONE
    assert Figures.of("failures") is Figures.FAILURES


def test_another_process_draws_and_tells_what_it_could_not(level, tmp_path):
    drawer = Drawer(workers=2)
    drawer.warm_up()
    files = [tmp_path / f"{i}.png" for i in range(3)]
    for file in files:
        drawer.draw(file, shown(level))
    missing = tmp_path / "nowhere" / "a.png"
    drawer.draw(missing, shown(level))
    drawer.finish()
    assert all(file.read_bytes()[:4] == PNG for file in files)
    assert list(drawer.refused) == [missing]
    assert str(missing) in drawer.refused[missing]


def test_a_drawer_that_is_closed_leaves_no_process(level, tmp_path):
    drawer = Drawer(workers=1)
    for i in range(20):
        drawer.draw(tmp_path / f"{i}.png", shown(level))
    drawer.close()
    drawer.close()
    assert drawer._processes == []
    assert len(list(tmp_path.glob("*.png"))) < 20


def test_a_sheet_has_room_for_all_failures_first(level, tmp_path):
    path = states()[:, 1:4]
    ground = ground_of(level, np.array([gate.row for gate in level.track.gates]), np.empty((0, 6)))
    gates = ground.gates
    tiles = [tile(i, i % 3 > 0, "x", path, gates) for i in range(2 * MOST_TILES)]
    kept = chosen(tiles)
    assert len(kept) == MOST_TILES
    assert [t.index for t in kept] == sorted(t.index for t in kept)
    assert {t.index for t in tiles if not t.clean} <= {t.index for t in kept}
    save_sheet(tmp_path / "s.png", ground, tiles)
    assert (tmp_path / "s.png").read_bytes()[:4] == PNG


def test_the_arena_is_drawn_as_far_as_its_fence_reaches(tmp_path):
    level = load_level("sim2real")
    save_arena(tmp_path / "a.png", level, Fence.from_level(level), 1.0)
    assert (tmp_path / "a.png").read_bytes()[:4] == PNG


def test_the_recorder_knows_when_the_first_command_went_out():
    from crazyarena.clock import VirtualClock
    from crazyarena.crazyswarm_compat import commands as cs
    from crazyarena.runner.contestant.contract_2022.command_check import VERBS, Asked
    from crazyarena.runner.records.recorder import Recorder

    recorder = Recorder(None, {}, {}, VirtualClock())
    verb = next(iter(VERBS.values()))
    recorder.command(0.1, Asked(verb, None), None)
    assert math.isinf(recorder.commanded_from)
    recorder.command(0.2, Asked(verb, None), cs.Stop())
    assert recorder.commanded_from == 0.2


def test_comparing_refuses_other_levels_unless_asked(tmp_path):
    from crazyarena.runner.records.compare import compare
    from crazyarena.runner.records.compare_figure import title
    from tests.runner.records.test_compare import record

    a = record(tmp_path / "a", metadata={"level": "level0"})
    b = record(tmp_path / "b", metadata={"level": "level3", "vehicle": "cf21b"})
    with pytest.raises(InputError, match=r"level0 and level3.*--different-levels"):
        compare([a], [b])
    found = compare([a], [b], ("mine", "theirs"), different_levels=True)
    assert title(found) == (
        "theirs (1 flight, vehicle cf21b) against mine (1 flight, vehicle unknown) "
        "on level0, level3"
    )


def test_numbers_of_marks_that_would_lie_upon_each_other_are_told_together():
    times = np.array([[1.0], [1.05], [3.0], [3.1], [9.0]])
    assert numbered(times, 0.2) == [("1,2", 0), ("3,4", 2), ("5", 4)]
    assert numbered(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.1]]), 0.2) == [("1,3", 0), ("2", 1)]
    assert numbered(np.empty((0, 2)), 0.2) == []
