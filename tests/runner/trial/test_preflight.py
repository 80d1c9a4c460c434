"""``crazyarena preflight`` as it is called, with vehicles over UDP and cameras over zenoh."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import threading

import pytest

from tests.runner.fakes import controller
from tests.runner.stage import Stage

pytestmark = pytest.mark.slow

# What is as it is on the machine that runs the tests.
MACHINE = ("timer", "cpu governor", "real-time scheduling", "disk")
START = (-0.9, -2.9)


class Called:
    """A running ``crazyarena preflight``, and what it says."""

    def __init__(self, folder, stage, *options, uris=None, runtime=None):
        self.report = folder / "preflight.json"
        pairs = uris or [f"cf{i + 1}={uri}" for i, uri in enumerate(stage.uris)]
        self.environment = {**os.environ, "CRAZYARENA_RUNTIME_DIR": str(runtime or folder)}
        waived = [word for name in MACHINE for word in ("--waive", name)]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "crazyarena", "preflight", "--mocap", "zenoh",
             "--mocap-host", stage.endpoint, "--report", str(self.report),
             *(word for pair in pairs for word in ("--uri", pair)), *waived, *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            text=True,
            env=self.environment,
        )  # fmt: skip
        self.said: list[str] = []
        self._heard = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        for line in self._process.stdout:
            with self._heard:
                self.said.append(line)
                self._heard.notify_all()

    def until(self, words):
        with self._heard:
            heard = self._heard.wait_for(lambda: any(words in line for line in self.said), 60.0)
        assert heard, "".join(self.said)

    def rehearse(self):
        """Pull the emergency stop from another shell."""
        self.until("Listening")
        subprocess.run(
            [sys.executable, "-m", "crazyarena", "estop", "--test"],
            env=self.environment, check=True, capture_output=True, timeout=60,
        )  # fmt: skip

    def end(self):
        """Exit code, report, and the red lines that are not waived."""
        code = self._process.wait(120)
        self._reader.join(10)
        assert self.report.exists(), "".join(self.said)
        report = json.loads(self.report.read_text())
        red = {one["name"]: one for one in report["lines"] if not one["ok"] and not one["waived"]}
        assert report["ready"] == (not red) == (code == 0)
        for line in red.values():
            assert line["remedy"]
            # The table is as wide as nobody knows: a word of each remedy has to do.
            assert line["remedy"].split()[0] in "".join(self.said)
        return code, report, red


def test_everything_green_with_a_hand_at_the_vehicle_and_at_the_stop(tmp_path):
    with Stage(places=[START]) as stage:
        called = Called(tmp_path, stage, "--tip", "--wait", "6")
        called.until("Tip cf1 by hand")
        stage.tip(0, 0.5)
        called.until("Body cf1 was tipped")
        stage.put_down()
        called.rehearse()
        code, report, red = called.end()
        assert (code, red) == (0, {})
        assert "Ready to fly." in "".join(called.said)
        names = [line["name"] for line in report["lines"]]
        assert "cf1 is body cf1" in names
        assert set(report["waived"]) <= set(MACHINE)
        assert stage.fleet.supervisor_info(0) & (1 << 4) == 0  # not flying
        assert not stage.fleet.rows(0).motors.any()

        # What was tried is remembered by the next command.
        code, _, red = Called(tmp_path, stage, "--wait", "2").end()
        assert (code, red) == (0, {})


def test_away_from_the_start_with_a_low_battery_and_untried(tmp_path):
    with Stage(places=[(START[0] + 1.0, START[1])]) as stage:
        stage.server.set_battery(3.6)
        code, _, red = Called(tmp_path, stage, "--wait", "2").end()
        assert code == 1
        assert set(red) == {"cf1 at start", "cf1 battery", "e-stop tested", "cf1 is body cf1"}
        assert red["cf1 at start"]["found"].startswith("1.0")
        assert red["cf1 battery"]["found"].startswith(("3.6", "3.5"))

        waived = [word for name in red for word in ("--waive", name)]
        code, report, left = Called(tmp_path, stage, "--wait", "2", *waived).end()
        assert (code, left) == (0, {})
        assert set(report["waived"]) - set(MACHINE) == set(red)


def test_the_name_of_another_vehicle(tmp_path):
    """The vehicle that is called cf2 wears the markers of cf1, and the other way about."""
    with Stage(places=[START, (0.0, 0.0)]) as stage:
        called = Called(
            tmp_path, stage, "--tip", "--wait", "2", "--waive", "e-stop tested",
            uris=[f"cf2={stage.uris[0]}"],
        )  # fmt: skip
        called.until("Tip cf2 by hand")
        stage.tip(0, 0.5)
        called.until("Body cf1 was tipped")
        stage.put_down()
        code, _, red = called.end()
        assert code == 1
        assert red["cf2 is body cf2"]["found"] == "body cf1 was tipped with it"
        assert "cf1" in red["cf2 is body cf2"]["remedy"]
        assert red["arena clear"]["found"] == "cf1"
        assert "cf2 at start" in red


@pytest.mark.parametrize("degrees", [20, -45, 90, 180])
def test_a_body_whose_nose_is_not_the_vehicles(tmp_path, degrees):
    with Stage(places=[START], noses={"cf1": math.radians(degrees)}) as stage:
        called = Called(tmp_path, stage, "--tip", "--wait", "2", "--waive", "e-stop tested")
        called.until("Tip cf1 by hand")
        stage.tip(0, 0.5)
        called.until("Body cf1 was tipped")
        stage.put_down()
        code, _, red = called.end()
        assert code == 1
        (found,) = re.findall(r"nose is (\S+) deg", red["cf1 heading"]["found"])
        assert abs(math.remainder(float(found) - degrees, 360.0)) < 5.0
        (remedy,) = re.findall(r"by (\S+) deg about z", red["cf1 heading"]["remedy"])
        assert float(remedy) == -float(found)
        # The next command remembers it.
        code, _, red = Called(tmp_path, stage, "--wait", "2", "--waive", "e-stop tested").end()
        assert code == 1
        assert "cf1 heading" in red


def test_a_body_that_nobody_tips_is_not_taken_for_the_vehicle(tmp_path):
    """Somebody tips the other vehicle: this one feels nothing, whatever the cameras see."""
    with Stage(places=[START, (0.0, 0.0)]) as stage:
        called = Called(
            tmp_path, stage, "--tip", "--wait", "2", uris=[f"cf1={stage.uris[1]}"],
        )  # fmt: skip
        called.until("Tip cf1 by hand")
        stage.tip(0, 0.5)
        called.until("No body was tipped as cf1 felt it")
        stage.put_down()
        code, _, red = called.end()
        assert code == 1
        assert red["cf1 is body cf1"]["found"] == "not tried"


def test_cameras_that_do_not_see_it(tmp_path):
    with Stage(places=[START], names={"cf1": None}) as stage:
        code, _, red = Called(tmp_path, stage, "--wait", "2").end()
        assert code == 1
        assert red["cf1 at start"]["found"] == "cameras do not see it"
        assert red["cf1 agrees with cameras"]["found"] == "cameras do not see it now"


def test_a_vehicle_that_is_switched_off(tmp_path):
    with Stage(places=[START]) as stage:
        called = Called(tmp_path, stage, "--wait", "1", uris=["cf1=udp://127.0.0.1:9"])
        code, _, red = called.end()
        assert code == 1
        assert red["cf1 connected"]["found"] == "never heard"
        assert "switch it on" in red["cf1 connected"]["remedy"]


def test_fly_asks_the_same_and_records_what_is_waived(tmp_path):
    """A vehicle with a low battery that nobody has tipped, and a stop that nobody has tried."""
    entry = tmp_path / "idle.py"
    entry.write_text(controller("return Command.FINISHED, []"))
    red = ["cf1 battery", "e-stop tested", "cf1 is body cf1"]

    def fly(stage, out, *options):
        return subprocess.run(
            [sys.executable, "-m", "crazyarena", "fly", str(entry), "--uri", stage.uris[0],
             "--mocap", "zenoh", "--mocap-host", stage.endpoint, "--yes", "--out", str(out),
             "--no-figure", "--waive", "disk", *options],
            env={**os.environ, "CRAZYARENA_RUNTIME_DIR": str(tmp_path)},
            stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=120,
        )  # fmt: skip

    with Stage(places=[START]) as stage:
        stage.server.set_battery(3.6)
        done = fly(stage, tmp_path / "a")
        assert done.returncode == 1, done.stdout + done.stderr
        document = json.loads((tmp_path / "a" / "result.json").read_text())
        episode = document["episodes"][0]
        assert episode["termination"] == "ABORTED"
        for name in red:
            assert f"{name}: " in episode["error"]
        assert "arm" not in episode["phases"]
        assert document["provenance"]["preflight"]["waived"] == []

        done = fly(stage, tmp_path / "b", *(word for name in red for word in ("--waive", name)))
        document = json.loads((tmp_path / "b" / "result.json").read_text())
        assert "arm" in document["episodes"][0]["phases"], done.stdout + done.stderr
        preflight = document["provenance"]["preflight"]
        assert sorted(preflight["waived"]) == sorted(red)
        (lines,) = preflight["checks"]
        assert {line["name"] for line in lines if not line["ok"]} == set(red)
