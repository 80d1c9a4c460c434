"""The bench: cflib over UDP and radio, cameras over zenoh, real time. Long, needs two CPUs."""

import json
import signal
import time

import pytest

from crazyarena.runner.records.compare import compare
from tests.runner.flying import (
    CIRCLE,
    EMPTY,
    FLIGHT_PROCESS,
    child_of,
    crazyarena,
    is_alive,
    sets,
)

pytestmark = pytest.mark.slow


def test_a_slow_controller_is_as_slow_in_the_dry_run(tmp_path):
    entry = tmp_path / "slow.py"
    entry.write_text(CIRCLE.format(think=0.08))
    out = tmp_path / "out"
    process = crazyarena("bench", entry, "--out", out, "--no-figure", *sets(EMPTY))
    printed, _ = process.communicate(timeout=300)
    # A vehicle that the crew has brought down needs nobody to land it.
    assert "the runner is gone" not in printed
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


def test_over_a_virtual_crazyradio(tmp_path):
    entry = tmp_path / "entry.py"
    entry.write_text(CIRCLE.format(think=0.0))
    out = tmp_path / "out"
    options = ("--link", "radio", "--mocap-rate", "100", "--no-dry", "--no-figure")
    process = crazyarena("bench", entry, "--out", out, *options, *sets(EMPTY))
    printed, _ = process.communicate(timeout=300)
    document = json.loads((out / "bench_00" / "result.json").read_text())
    assert document["episodes"][0]["termination"] == "MAX EPISODE DURATION", printed
    assert process.returncode == 0
    assert document["provenance"]["rig"]["backend"].startswith("radio://")


def test_over_a_virtual_crazyradio_by_its_own_estimate(tmp_path):
    entry = tmp_path / "entry.py"
    entry.write_text(CIRCLE.format(think=0.0))
    out = tmp_path / "out"
    options = ("--link", "radio", "--mocap", "onboard", "--no-dry", "--no-figure")
    process = crazyarena("bench", entry, "--out", out, *options, *sets(EMPTY))
    printed, _ = process.communicate(timeout=300)
    document = json.loads((out / "bench_00" / "result.json").read_text())
    (episode,) = document["episodes"]
    assert episode["termination"] == "MAX EPISODE DURATION", printed
    assert process.returncode == 0
    lines = {line["name"]: line for line in document["provenance"]["preflight"]["checks"][0]}
    assert lines["cf1 deck"]["found"] == "lighthouse"
    assert not lines["cf1 heading"]["checked"]
    (told,) = [event for event in episode["events"] if event["event"] == "safety: own_estimate"]
    assert "wrong_body" in told["detail"]


def test_a_killed_bench_leaves_no_process(tmp_path):
    entry = tmp_path / "entry.py"
    entry.write_text(CIRCLE.format(think=0.0))
    out = tmp_path / "out"
    process = crazyarena("bench", entry, "--out", out, "--no-dry", *sets(EMPTY))
    part = out / "bench_00" / "episode_000.mcap.part"
    deadline = time.monotonic() + 120.0
    while not (part.exists() and part.stat().st_size > 20_000):
        assert time.monotonic() < deadline, "it never flew"
        assert process.poll() is None, process.communicate()[0]
        time.sleep(0.3)
    children = [
        child_of(process.pid, module)
        for module in (
            FLIGHT_PROCESS,
            "crazyarena.runner.rig.virtual_arena",
            "crazyarena.runner.contestant.sandbox.child",
        )
    ]
    process.send_signal(signal.SIGKILL)
    printed, _ = process.communicate(timeout=60.0)
    assert "the vehicle is down" in printed
    deadline = time.monotonic() + 60.0
    while any(child is not None and is_alive(child) for child in children):
        assert time.monotonic() < deadline, children
        time.sleep(0.5)
    assert children[0] is not None
    assert children[1] is not None


@pytest.mark.realtime
@pytest.mark.parametrize(
    "cameras",
    [
        ("qualisys",), ("natnet",), ("vrpn",), ("zenoh",),
        ("vrpn", "--mocap-option", "client=motioncapture"),
    ],
)  # fmt: skip
def test_a_circle_is_flown_by_every_camera_protocol(cameras, tmp_path):
    entry = tmp_path / "entry.py"
    entry.write_text(CIRCLE.format(think=0.0))
    out = tmp_path / "out"
    process = crazyarena(
        "bench", entry, "--out", out, "--no-dry", "--no-figure", "--mocap", *cameras, *sets(EMPTY)
    )
    printed, _ = process.communicate(timeout=200)
    document = json.loads((out / "bench_00" / "result.json").read_text())
    (episode,) = document["episodes"]
    assert episode["termination"] == "MAX EPISODE DURATION", printed
    assert cameras[0] in json.dumps(document["provenance"])
