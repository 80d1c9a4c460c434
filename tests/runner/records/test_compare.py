"""Two groups of flights beside each other."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from crazyarena.clock import VirtualClock
from crazyarena.errors import InputError
from crazyarena.runner.cli import make_app
from crazyarena.runner.judging import verdict_row
from crazyarena.runner.records.compare import compare
from crazyarena.runner.records.recorder import Recorder
from tests.runner.fakes import rows


def record(
    folder,
    shift=(0.0, 0.0, 0.0),
    seconds=4.0,
    rate=100.0,
    delay=0.0,
    gates=(1.0, 2.0),
    vehicle=None,
    metadata=None,
):
    """A straight flight of 1 m/s, displaced by ``shift`` m or late by ``delay`` s."""
    folder.mkdir(parents=True)
    recorder = Recorder(
        folder / "episode_000.mcap",
        metadata or ({} if vehicle is None else {"vehicle": vehicle}),
        {},
        VirtualClock(),
    )
    times = np.arange(1, int(seconds * rate) + 1) / rate
    path = np.stack([times - delay, 0.0 * times, 1.0 + 0.0 * times], axis=1) + shift
    states = rows(path, rate=rate)
    verdict = np.zeros(verdict_row.SIZE)
    verdict[verdict_row.VD_TIME] = times[-1]
    recorder.step(states, verdict)
    for gate in gates:
        recorder.event(gate + delay, 0, "gate passed", "gate")
    recorder.close()
    return folder


def test_a_displacement_is_found_per_axis(tmp_path):
    a = [record(tmp_path / f"a{i}") for i in range(3)]
    b = [record(tmp_path / f"b{i}", shift=(0.03, -0.04, 0.0), rate=120.0) for i in range(2)]
    s = compare(a, b).summary()
    assert s["flights"] == [3, 2]
    assert s["mean_distance"] == pytest.approx(0.05, abs=1e-6)
    assert s["rmse"] == pytest.approx([0.03, 0.04, 0.0], abs=1e-6)
    assert s["mean_difference"] == pytest.approx([0.03, -0.04, 0.0], abs=1e-6)
    assert s["spread"] == pytest.approx([0.0, 0.0], abs=1e-9)


def test_a_delay_is_found_as_distance_and_in_the_gate_times(tmp_path):
    a = [record(tmp_path / "a")]
    b = [record(tmp_path / "b", delay=0.1, seconds=4.4)]
    s = compare(a, b).summary()
    assert s["mean_distance"] == pytest.approx(0.1, abs=1e-6)
    assert s["gate_time_difference"] == pytest.approx([0.1, 0.1])
    assert s["duration_ratio"] == pytest.approx(1.1)
    assert s["compared_time"] == pytest.approx(4.0, abs=0.02)


def test_both_vehicles_are_named_and_what_would_explain_a_difference_is_offered(tmp_path):
    ours = [record(tmp_path / "a", vehicle="cf21plus")]
    theirs = [record(tmp_path / "b", vehicle="mine")]
    unknown = [record(tmp_path / "c")]
    other, same, silent = (compare(ours, group) for group in (theirs, ours, unknown))
    assert other.summary()["vehicles"] == ["cf21plus", "mine"]
    assert "--vehicle mine" in other.advice()
    assert f"identify {tmp_path / 'a'}" in same.advice()
    assert silent.vehicles == ("cf21plus", "unknown")
    assert f"identify {tmp_path / 'c'}" in silent.advice()


def test_mean_paths_are_compared_not_pairs(tmp_path):
    a = [record(tmp_path / f"a{i}", shift=(0.0, y, 0.0)) for i, y in enumerate((-0.1, 0.1))]
    s = compare(a, [record(tmp_path / "b")]).summary()
    assert s["mean_distance"] == pytest.approx(0.0, abs=1e-9)
    assert s["spread"][0] == pytest.approx(0.1 / 3)


def test_command_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a0", "a1", "b0"):
        record(tmp_path / name, shift=(0.01 * (name == "b0"), 0.0, 0.0))
    result = CliRunner().invoke(make_app(), ["compare", "a0", "a1", "vs", "b0", "--out", "c"])
    assert result.exit_code == 0, result.output
    assert "1.00 cm" in result.output
    assert json.loads((tmp_path / "c" / "compare.json").read_text())["flights"] == [2, 1]
    assert (tmp_path / "c" / "compare.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["a"], "pass two"),
        (["a", "a", "a"], "with 'vs' between"),
        (["a", "vs"], "a group is empty"),
        (["a", "nowhere"], "nowhere"),
        (["a", "empty"], "no recordings"),
    ],
)
def test_wrong_calls_are_one_message(tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "a")
    (tmp_path / "empty").mkdir()
    result = CliRunner().invoke(make_app(), ["compare", *arguments])
    assert result.exit_code == 2
    assert words in result.output


def test_a_recording_without_a_flight_is_refused(tmp_path):
    record(tmp_path / "a")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "x.mcap").write_bytes(b"nothing")
    with pytest.raises(InputError):
        compare([tmp_path / "a"], [tmp_path / "b"])
