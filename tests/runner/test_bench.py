"""The bench: cflib over UDP, cameras over zenoh, real time. Long, and in need of two CPUs."""

import json

import pytest

from crazyarena.runner.compare import compare
from tests.runner.flying import CIRCLE, EMPTY, crazyarena, sets

pytestmark = pytest.mark.slow


def test_a_slow_controller_is_as_slow_in_the_dry_run(tmp_path):
    entry = tmp_path / "slow.py"
    entry.write_text(CIRCLE.format(think=0.08))
    out = tmp_path / "out"
    process = crazyarena("bench", entry, "--out", out, "--no-figure", *sets(EMPTY))
    printed, _ = process.communicate(timeout=300)
    episodes = []
    for name in ("dry_00", "bench_00"):
        document = json.loads((out / name / "result.json").read_text())
        episodes.append(document["episodes"][0])
        assert episodes[-1]["termination"] == "MAX EPISODE DURATION", printed
    dry, bench = episodes
    assert dry["missed_ticks"] > 250
    assert abs(bench["missed_ticks"] / dry["missed_ticks"] - 1.0) <= 0.05
    assert abs(bench["over_period"] / dry["over_period"] - 1.0) <= 0.05
    compared = compare([out / "dry_00"], [out / "bench_00"])
    assert compared.distance.mean() <= 0.05
    assert compared.distance.max() <= 0.10
