"""``crazyarena fly`` where there are no cameras, end to end: a vehicle with a positioning deck, on
the air of a virtual Crazyradio."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from crazyarena.levels import load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.mocap.survey import write_taped
from crazyarena.sim_backend.arena_world import feet, track_truth
from crazyarena.sim_backend.crazyradio.environment import with_dongles
from tests.sim_backend.crtp.virtual_process import virtual_process

pytestmark = pytest.mark.slow

LEVEL = "sim2real"


@pytest.fixture
def on_air(tmp_path):
    """Factory: a command line of crazyarena beside a vehicle with a deck among the gates."""

    def call(deck, *arguments):
        options = ("--radio", "--radio-port", "0", "--level", LEVEL, "--deck", deck)
        with virtual_process(*options) as process:
            environment = with_dongles(process.air)
            # What was tried by hand on this machine counts for its people.
            environment["CRAZYARENA_RUNTIME_DIR"] = str(tmp_path)
            words = [word.replace("URI", process.uris[0]) for word in arguments]
            return subprocess.run(
                [sys.executable, "-m", "crazyarena", *words],
                env=environment,
                cwd=tmp_path,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=240,
            )

    return call


def test_the_racer_flies_by_lighthouse_from_a_track_measured_by_hand(on_air, tmp_path):
    draw = LevelRandom(load_level(LEVEL)).reset()
    write_taped(tmp_path / "track.json", track_truth(feet(draw), draw.obstacles), LEVEL)
    waived = [word for name in ("e-stop tested", "disk") for word in ("--waive", name)]
    done = on_air(
        "lighthouse", "fly", "--level", LEVEL, "--uri", "URI", "--mocap", "onboard", "--survey",
        "track.json", "--yes", "--out", "out", "--episodes", "1", "--no-figure", *waived,
    )  # fmt: skip
    document = json.loads((tmp_path / "out/result.json").read_text())
    (episode,) = document["episodes"]
    assert episode["completed"], done.stdout + done.stderr
    assert document["provenance"]["rig"]["mocap"] == "onboard"
    unchecked = {
        line["name"]
        for line in document["provenance"]["preflight"]["checks"][0]
        if not line["checked"]
    }
    assert unchecked >= {"arena clear", "cf1 heading", "cf1 agrees with cameras"}
    assert any(event["event"] == "safety: own_estimate" for event in episode["events"])


def test_preflight_says_what_nobody_can_check(on_air, tmp_path):
    done = on_air(
        "flow", "preflight", "--uri", "cf1=URI", "--level", LEVEL, "--mocap", "onboard",
        "--report", "preflight.json", "--wait", "2",
    )  # fmt: skip
    lines = json.loads((tmp_path / "preflight.json").read_text())["lines"]
    by_name = {line["name"]: line for line in lines}
    assert by_name["cf1 deck"]["found"] == "flow", done.stdout + done.stderr
    assert by_name["cf1 certain"]["ok"], by_name["cf1 certain"]
    assert "the place itself drifts" in by_name["cf1 certain"]["found"]
    for name in ("gates", "arena clear", "cf1 heading", "cf1 at start", "cf1 agrees with cameras"):
        assert by_name[name]["ok"]
        assert by_name[name]["found"].startswith("not checked")
    assert by_name["cf1 controller"]["ok"]


def test_it_is_not_tipped_where_no_body_could_tip(on_air):
    done = on_air("flow", "preflight", "--uri", "cf1=URI", "--mocap", "onboard", "--tip")
    assert done.returncode == 2
    assert "without cameras it has none" in done.stderr + done.stdout
