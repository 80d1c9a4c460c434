"""The bench: cflib over UDP, cameras over zenoh, real time. Long, and in need of two CPUs."""

import json
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from crazyarena.levels import load_level
from crazyarena.runner import export
from crazyarena.runner.compare import compare
from crazyarena.runner.virtual_arena import VirtualArena
from crazyarena.sim_backend.firmware.supervisor import INFO_FLYING

pytestmark = pytest.mark.slow

# A circle of 0.8 m diameter in 6 s, and 80 ms of thinking about every point of it.
SLOW = """
import math, time as clock
from competition_utils import Command

class Controller:
    def __init__(self, initial_obs, initial_info, use_firmware=False, verbose=False):
        self.x, self.y = initial_obs[0], initial_obs[2]

    def cmdFirmware(self, time, obs, reward=None, done=None, info=None):
        clock.sleep({think})
        rise = min(time / 3.0, 1.0)
        rise = rise * rise * (3.0 - 2.0 * rise)
        w = 2.0 * math.pi / 6.0
        a = max(0.0, time - 3.0) * w
        x, y = self.x + 0.4 * math.sin(a), self.y + 0.4 * (1.0 - math.cos(a))
        v = [0.4 * w * math.cos(a), 0.4 * w * math.sin(a), 0.0] if a > 0.0 else [0, 0, 0]
        return Command.FULLSTATE, [[x, y, max(1.0 * rise, 0.05)], v, [0] * 3, 0.0, [0] * 3]
"""
EMPTY = [
    "track.gates=[]",
    "track.obstacles=[]",
    "start.position=[0, -0.5, 0.03]",
    "goal.position=[2.5, 2.5, 1.5]",
    "episode_length=15.0",
]


def crazyarena(*arguments, **options):
    return subprocess.Popen(
        [sys.executable, "-m", "crazyarena", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        **options,
    )


def sets(overrides):
    return [word for override in overrides for word in ("--set", override)]


def test_a_slow_controller_is_as_slow_in_the_dry_run(tmp_path):
    entry = tmp_path / "slow.py"
    entry.write_text(SLOW.format(think=0.08))
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


def test_the_vehicle_outlives_the_runner(tmp_path):
    """SIGKILL in mid-flight: what was recorded is readable, and the vehicle comes down."""
    entry = tmp_path / "slow.py"
    entry.write_text(SLOW.format(think=0.0))
    level = load_level("sim2real", EMPTY)
    out = tmp_path / "out"
    with VirtualArena(level, level.seed, tmp_path) as arena:
        process = crazyarena(
            "fly", entry, "--uri", arena.uri, "--mocap", "zenoh", "--mocap-host", arena.endpoint,
            "--yes", "--out", out, *sets(EMPTY),
        )  # fmt: skip
        part = out / "episode_000.mcap.part"
        deadline = time.monotonic() + 120.0
        flown = 0.0
        while flown < 6.0:
            assert time.monotonic() < deadline, "it never flew"
            assert process.poll() is None, process.stdout.read()
            time.sleep(0.3)
            if part.exists() and part.stat().st_size > 20_000:
                flown = float(export.read(part).tables["state"][-1, 0])
        killed_at = time.monotonic()
        process.send_signal(signal.SIGKILL)
        process.communicate()
        recording = export.read(part)
        last = recording.tables["state"][-1]
        assert not recording.complete
        # It was in the air, and the recording goes on to the last second or so.
        assert last[3] > 0.5
        assert last[0] >= flown
        time.sleep(max(0.0, killed_at + 6.0 - time.monotonic()))
    assert arena.report["position"][2] < 0.1
    assert not arena.report["supervisor"] & INFO_FLYING
    assert np.isfinite(arena.report["position"]).all()
