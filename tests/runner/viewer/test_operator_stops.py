"""STOP and LAND on the operator's page of a flight over the whole hardware path, in a browser."""

from __future__ import annotations

import re

import numpy as np
import pytest

from crazyarena.live import Watched, live_flights
from crazyarena.runner.records import export
from crazyarena.viewer_process import ViewerProcess, ViewOptions
from tests.browser import browser, errors, needs_browser, open_tab, press, text
from tests.runner.flying import Flying
from tests.waiting import eventually

pytestmark = [needs_browser, pytest.mark.slow, pytest.mark.realtime, pytest.mark.timeout(1200)]

PATIENCE = 240.0
STOP = "STOP – cut the motors"


def _told(watched, name):
    """A fact of the newest picture; None while one is being written."""
    state = watched.state()
    return None if state is None else state.facts.get(name)


@pytest.mark.parametrize("label", [STOP, "LAND"])
def test_the_page_ends_a_flight(tmp_path, monkeypatch, label):
    monkeypatch.setenv("CRAZYARENA_RUNTIME_DIR", str(tmp_path))
    # A viewer and a browser take longer to start on a busy machine than other tests fly.
    with Flying(tmp_path, seconds=240.0) as flying:
        # As somebody would who wants to see a flight that has begun already.
        (flight,) = live_flights()
        watched = Watched(flight)
        viewer = ViewerProcess(flight, ViewOptions(port=0))
        try:
            with browser(500, 500) as driver:
                driver.get(viewer.url)
                eventually(lambda: label in text(driver), PATIENCE)
                open_tab(driver, "Operator")
                eventually(lambda: re.search(r"battery\s+\d\.\d\d V", text(driver)), PATIENCE)
                assert press(driver, label)
                ladder = "CUT" if label == STOP else "LAND"
                eventually(lambda: _told(watched, "ladder") == ladder)
                # The vehicle's own word.
                eventually(lambda: _told(watched, "motors") == [0.0] * 4, 30.0)
                result, printed = flying.end()
                assert errors(driver) == []
        finally:
            viewer.close()
    assert result["termination"] == "SAFETY", printed
    names = [event["event"] for event in result["events"]]
    assert ("safety: emergency_stop" if label == STOP else "safety: operator_land") in names, names
    recording = export.read(flying.out / "episode_000.mcap")
    motors = recording.tables["vehicle"]
    columns = recording.columns["vehicle"]
    commands = motors[:, [columns.index(f"motors_{k}") for k in range(4)]]
    assert np.all(commands[-1] == 0.0)
