"""Whatever happens to the two processes of a flight, the vehicle ends on the ground."""

import os
import signal
import time

import numpy as np
import pytest

from crazyarena.runner.records import export
from crazyarena.safety.estop_sources import stop_local
from crazyarena.sim_backend.firmware.supervisor import (
    INFO_CRASHED,
    INFO_FLYING,
    INFO_LOCKED,
    INFO_TUMBLED,
)
from tests.runner.flying import Flying, is_alive
from tests.waiting import eventually

pytestmark = pytest.mark.slow


@pytest.fixture
def flying(tmp_path):
    with Flying(tmp_path) as flying:
        yield flying


def test_the_vehicle_outlives_the_runner(flying):
    """SIGKILL in mid-flight: what was recorded is readable, and the watchdog lands the vehicle."""
    flying.runner.send_signal(signal.SIGKILL)
    # Its output ends when the last process that writes to it does.
    printed, _ = flying.runner.communicate(timeout=30.0)
    assert "the runner is gone: landing the vehicle" in printed
    assert "the vehicle is down" in printed
    assert not is_alive(flying.pilot)
    recording = export.read(flying.part)
    last = recording.tables["state"][-1]
    assert not recording.complete
    # It was in the air, and the recording goes on to the last second or so.
    assert last[3] > 0.5
    assert last[0] >= flying.flown
    report = flying.vehicle_at_rest()
    assert report["position"][2] < 0.1
    # Landed where it was, not dropped: its motors were stopped after touchdown.
    assert np.hypot(*(np.array(report["position"][:2]) - last[1:3])) < 1.0
    assert not report["supervisor"] & INFO_FLYING


def test_the_runner_outlives_the_flight_process(flying):
    os.kill(flying.pilot, signal.SIGKILL)
    episode, printed = flying.end()
    assert episode["termination"] == "SAFETY"
    assert "the flight process ended (SIGKILL)" in episode["error"]
    assert "its own watchdog stops its motors" in " ".join(printed.split())
    assert flying.runner.returncode == 1
    recording = export.read(flying.out / "episode_000.mcap")
    assert recording.complete
    assert recording.tables["state"][-1, 0] >= flying.flown
    time.sleep(3.0)
    report = flying.vehicle()
    assert report["position"][2] < 0.1
    assert not report["supervisor"] & INFO_FLYING


def test_an_emergency_stop_does_not_need_the_runner(flying):
    """From another shell, while the runner is blocked."""
    flying.runner.send_signal(signal.SIGSTOP)
    ((_, answer),) = stop_local("test", folder=flying.sockets)
    assert answer == "stopped"
    # Too early for the watchdog to have landed it for the runner's silence.
    time.sleep(0.7)
    flying.runner.send_signal(signal.SIGCONT)
    episode, _ = flying.end()
    # Falling down may be judged before anybody asks why.
    assert episode["termination"] in ("SAFETY", "COLLISION")
    assert any(e["event"] == "safety: emergency_stop" for e in episode["events"])
    report = flying.vehicle()
    assert report["supervisor"] & INFO_LOCKED
    assert report["position"][2] < 0.1


def test_a_runner_that_hangs_loses_the_vehicle(flying):
    flying.runner.send_signal(signal.SIGSTOP)
    time.sleep(8.0)
    flying.runner.send_signal(signal.SIGCONT)
    episode, _ = flying.end()
    assert episode["termination"] == "SAFETY"
    assert any(e["event"] == "safety: landed" for e in episode["events"])
    assert flying.vehicle()["position"][2] < 0.1
    # Everything the cameras saw meanwhile is on record.
    times = export.read(flying.out / "episode_000.mcap").tables["state"][:, 0]
    assert np.diff(times).max() < 0.2


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_the_runner_brings_the_vehicle_home(flying, number):
    flying.runner.send_signal(number)
    if number == signal.SIGINT:
        os.kill(flying.pilot, number)  # a terminal sends it to both
    episode, _ = flying.end()
    assert episode["termination"] == "INTERRUPTED"
    assert "return-and-land" in episode["phases"]
    report = flying.vehicle_at_rest()
    np.testing.assert_allclose(report["position"][:2], [0.0, -0.5], atol=0.2)
    # On the ground, where firmware that arms by itself stands ready, and is not locked.
    assert report["position"][2] < 0.05
    assert not report["supervisor"] & (INFO_FLYING | INFO_LOCKED | INFO_TUMBLED | INFO_CRASHED)
    assert not is_alive(flying.pilot)


def test_sigterm_to_the_flight_process_lands(flying):
    os.kill(flying.pilot, signal.SIGTERM)
    episode, _ = flying.end()
    assert episode["termination"] == "SAFETY"
    assert "terminated" in episode["error"]
    assert any(e["event"] == "safety: landed" for e in episode["events"])
    assert flying.vehicle()["position"][2] < 0.1
    eventually(lambda: not is_alive(flying.pilot), 5.0)
