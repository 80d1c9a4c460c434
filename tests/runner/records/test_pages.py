"""Reports as pages: what they say, that they need nothing, and that nobody writes into them."""

import html.parser
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.clock import VirtualClock
from crazyarena.errors import InputError
from crazyarena.levels import dump_level, load_level
from crazyarena.runner.campaign.outcome import Outcome
from crazyarena.runner.campaign.report import write_json
from crazyarena.runner.judging import verdict_row
from crazyarena.runner.records.pages.charts import Line, chart, ticks
from crazyarena.runner.records.pages.flown import read_flown, scene
from crazyarena.runner.records.pages.page import data, page, table, text
from crazyarena.runner.records.pages.write import write_report
from crazyarena.runner.records.recorder import Recorder
from crazyarena.runner.records.scene import scene_update
from tests.runner.fakes import rows

HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\x1b[2J"


class Tags(html.parser.HTMLParser):
    """Counts what a browser would find."""

    def __init__(self, words):
        super().__init__()
        self.tags, self.attributes, self.open = [], [], []
        self.feed(words)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.attributes += attributes
        if tag not in ("meta", "input", "img"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append(tag)
        self.attributes += attributes

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def record(folder, level, shift=0.0, detail="gate 0"):
    gates = np.array([[*g.row[:2], g.centre[2], *g.row[3:]] for g in level.track.gates])
    obstacles = np.array([post.row for post in level.track.obstacles])
    metadata = {"level": level.name, "level_file": dump_level(level)}
    metadata |= {"gates": json.dumps(gates.tolist()), "obstacles": json.dumps(obstacles.tolist())}
    scene = scene_update(gates, obstacles, level)
    recorder = Recorder(folder / "episode_000.mcap", metadata, scene, VirtualClock())
    times = np.arange(1, 2001) / 500.0
    path = np.stack([times / 2 - 1.0, 0.0 * times - 2.5, 1.0 + 0.0 * times], axis=1) + shift
    verdict = np.zeros(verdict_row.SIZE)
    verdict[verdict_row.VD_TIME] = times[-1]
    recorder.step(rows(path, rate=500.0), verdict)
    recorder.event(3.0, 1500, "gate passed", "gate 0")
    recorder.event(3.9, 1950, "contact", detail)
    recorder.close()


def make_run(folder, why="COLLISION with gate 0 (left bar) at 3.90 s", episodes=1, **more):
    folder.mkdir(parents=True)
    level = load_level("level0")
    record(folder, level, detail=more.pop("detail", "gate 0"), shift=more.pop("shift", 0.0))
    each = [
        {
            "index": i, "termination": "COLLISION", "why": why, "flight_time": 3.9,
            "gates_passed": 1, "gates": 4, "clean": False, "collisions": 1, "violations": 0,
            "files": {"recording": "episode_000.mcap"}, "phases": {"run": 3.9},
            "compute_ms": {"p50": 0.1, "p99": 0.2, "max": 0.3}, "error": why,
        }
        for i in range(episodes)
    ]  # fmt: skip
    line = {"name": "battery", "ok": False, "found": "3.2 V", "remedy": "charge it"}
    origin = {"level": "level0", "seed": 4, "preflight": {"checks": [[line]]}, "command": [why]}
    document = {"finished": True, "isolated": True, "episodes": each, "provenance": origin, **more}
    (folder / "result.json").write_text(json.dumps(document))
    return folder


def self_contained(words):
    found = Tags(words)
    assert found.open == []
    for name, value in found.attributes:
        assert name not in ("href", "srcset", "action")
        assert not name.startswith("on")
        assert name != "src" or value.startswith("data:")
    assert "http://" not in words.replace("http://www.w3.org", "")
    assert "https://" not in words
    return found


def test_a_run_tells_why_shows_its_flight_checklist_and_provenance(tmp_path):
    file = write_report(make_run(tmp_path / "run"))
    assert file == tmp_path / "run" / "report.html"
    words = file.read_text()
    found = self_contained(words)
    assert "COLLISION with gate 0 (left bar) at 3.90 s" in words
    assert found.tags.count("canvas") == 1
    assert found.tags.count("svg") == 5
    assert "charge it" in words
    assert "3.2 V" in words
    assert "contact: gate 0" in words
    view = re.search(r'class="scene-data">(.*?)</script>', words)
    shown = json.loads(view[1])
    assert shown["low"] == [-3.0, -3.0, -0.1]
    assert shown["paths"][0]["points"][-1] == pytest.approx([1.0, -2.5, 1.0], abs=0.01)
    assert any(mark["text"] == "contact: gate 0" for mark in shown["marks"])


def test_nobody_writes_into_a_page(tmp_path):
    run = make_run(tmp_path / "run", why=HOSTILE, detail=HOSTILE)
    words = write_report(run).read_text()
    found = self_contained(words)
    kinds = [value for name, value in found.attributes if name == "type"]
    assert found.tags.count("script") == 1 + kinds.count("application/json")
    assert "img" not in found.tags
    assert "\x1b" not in words
    assert "&lt;script&gt;alert(1)" in words


@given(st.text())
def test_text_and_data_never_end_what_they_are_in(told):
    assert not set('<>"') & set(text(told))
    assert data("a", {"told": told}).count("<") == 2
    self_contained(page(told, table([told], [[told]])))


def test_a_recording_is_taken_from_its_own_folder_only(tmp_path):
    run = make_run(tmp_path / "run")
    document = json.loads((run / "result.json").read_text())
    (tmp_path / "episode_000.mcap").write_bytes((run / "episode_000.mcap").read_bytes())
    document["episodes"][0]["files"]["recording"] = "../episode_000.mcap"
    (run / "result.json").write_text(json.dumps(document))
    assert "<canvas>" not in write_report(run).read_text()


def test_a_thousand_episodes_can_still_be_mailed(tmp_path):
    file = write_report(make_run(tmp_path / "run", episodes=1000))
    assert file.stat().st_size < 3_000_000
    assert file.read_text().count("<canvas>") == 16


def test_a_bench_flight_stands_beside_its_dry_run(tmp_path):
    make_run(tmp_path / "bench_00", shift=0.03)
    make_run(tmp_path / "dry_00")
    words = write_report(tmp_path / "bench_00").read_text()
    assert "Against dry_00" in words
    assert "5.20 cm" in words
    whole = write_report(tmp_path).read_text()
    self_contained(whole)
    assert whole.count("<canvas>") == 3
    assert "0 of 1 bench flights clean" in whole
    assert "charge it" in whole
    (tmp_path / "dry_00" / "episode_000.mcap").unlink()
    whole = write_report(tmp_path).read_text()
    assert "Not compared" in whole
    assert whole.count("<canvas>") == 1


def test_a_comparison_names_its_runs_and_is_reported_from_them(tmp_path):
    from crazyarena.runner.records.compare import compare

    a, b = make_run(tmp_path / "a"), make_run(tmp_path / "b", shift=0.01)
    found = compare([a], [b], ("calm", "windy"))
    (tmp_path / "compare.json").write_text(json.dumps(found.document()))
    words = write_report(tmp_path).read_text()
    self_contained(words)
    assert "windy against calm" in words
    old = {key: value for key, value in found.document().items() if key != "runs"}
    (tmp_path / "compare.json").write_text(json.dumps(old))
    with pytest.raises(InputError, match="does not name its runs"):
        write_report(tmp_path)


def test_a_fault_campaign_and_a_validation_are_reported(tmp_path):
    outcomes = [
        Outcome("mocap_jump", 1, 0.2, math.inf, "flying", 0, "", 1.0, 4.0),
        Outcome("mocap_jump", 2, -0.5, 1.0, "cut", 5, "fence", 1.0, 4.0),
        Outcome("wall", 3, -0.1, 2.0, "landed", 3, "fence", 1.0, 4.0),
    ]
    (tmp_path / "c").mkdir()
    write_json(tmp_path / "c" / "campaign.json", outcomes, "Faults")
    words = write_report(tmp_path / "c").read_text()
    found = self_contained(words)
    assert "2 of 3 flights ended in a safe state" in words
    dots = [v for name, v in found.attributes if name == "class" and v.startswith("dot")]
    assert sorted(dots) == ["dot s0"] + 4 * ["dot s2"]
    assert words.count('<tr class="bad">') == 1
    (tmp_path / "v").mkdir()
    validation = {"vehicle": "cf21b", "medians": {"pid": {"rmse": 0.1}}, "flights": [{"rmse": 0.1}]}
    (tmp_path / "v" / "validate.json").write_text(json.dumps(validation))
    (tmp_path / "v" / "validate.png").write_bytes(b"png")
    words = write_report(tmp_path / "v").read_text()
    self_contained(words)
    assert "3-D RMSE, m" in words
    assert "data:image/png;base64,cG5n" in words


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("result.json", "[]", "need a mapping"),
        ("result.json", '{"episodes": 3}', "episodes"),
        ("result.json", '{"episodes": [3]}', "episodes"),
        ("campaign.json", '{"flights": [3]}', "flights"),
        ("compare.json", "[]", "does not name its runs"),
        ("other.json", "{}", "nothing to report"),
    ],
)
def test_what_is_none_of_ours_is_refused(tmp_path, name, content, told):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=told):
        write_report(tmp_path)


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6), st.integers(2, 12))
def test_ticks_are_round_and_inside(low, span, most):
    found = ticks(low, low + span, most)
    assert len(found) <= most + 1
    assert all(low - 1e-6 <= value <= low + span + 1e-6 for value in found)


def test_a_chart_leaves_gaps_where_nothing_is_known():
    time = np.arange(10.0)
    value = np.where((time > 3) & (time < 6), math.nan, time)
    assert chart("z", [Line("flown", time, value, "s0")]).count("<polyline") == 2
    assert "nan" not in chart("z", [Line("flown", time, np.full(10, math.nan), "s0")])


def test_a_flight_that_was_short_is_shown_with_all_that_stands_there(tmp_path):
    run = make_run(tmp_path / "run")
    flown = read_flown(run / "episode_000.mcap")
    flown = replace(flown, level=None, position=flown.position[:1], time=flown.time[:1])
    view = re.search(r'class="scene-data">(.*?)</script>', scene([(flown, "c0")]))
    shown = json.loads(view[1])
    corners = np.array([point for solid in shown["solids"] for point in solid["points"]])
    assert len(corners) > 0
    assert (corners.min(axis=0) >= np.array(shown["low"]) - 0.01).all()
    assert (corners.max(axis=0) <= np.array(shown["high"]) + 0.01).all()
