"""Replays in a real browser."""

from __future__ import annotations

import threading

import pytest

from crazyarena.runner.viewer.recorded import flights
from crazyarena.runner.viewer.replay import Replay
from crazyarena.runner.viewer.server import LOOPBACK, address, open_server
from tests.browser import browser, errors, needs_browser, needs_viser, press, text
from tests.runner.viewer.flights import circle
from tests.waiting import eventually

PATIENCE = 240.0  # s; browsers that render in software are slow beside others


@pytest.fixture
def replay(tmp_path):
    """A replay of two flights, and its address."""
    files = [
        circle(tmp_path / "first.mcap"),
        circle(tmp_path / "second.mcap", seconds=5.0, radius=0.5),
    ]
    server = open_server(LOOPBACK, 0, "test")
    shown = Replay(server, flights(files))
    stop = threading.Event()
    thread = threading.Thread(target=shown.run, args=(stop,))
    thread.start()
    yield shown, address(server, LOOPBACK)
    stop.set()
    thread.join()
    server.stop()


@needs_viser
def test_the_time_line_covers_all_flights_and_play_begins_anew_at_its_end(replay):
    shown, _ = replay
    assert (shown.begin, shown.end) == (0.0, 5.0)
    shown.seek(99.0)
    assert shown.time == 5.0
    shown.play(True)
    assert shown.time < 5.0
    eventually(lambda: shown.time > 0.0)
    shown.speed = 1000.0
    eventually(lambda: not shown.playing)
    assert shown.time == 5.0


@needs_browser
@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_two_browsers_load_scrub_and_play_without_errors(replay):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    shown, url = replay
    with browser(500, 400) as one, browser(360, 500, phone=True) as two:
        for driver in (one, two):
            driver.get(url)
        eventually(lambda: "first" in text(one) and "second" in text(two), PATIENCE)
        thumb = one.find_element(By.CSS_SELECTOR, "[role=slider]")
        thumb.send_keys(Keys.END)
        eventually(lambda: shown.time == 5.0, PATIENCE)
        # What one does, the other sees.
        for driver in (one, two):
            eventually(lambda driver=driver: "5.00 s" in text(driver), PATIENCE)
            eventually(lambda driver=driver: "gate passed" in text(driver), PATIENCE)
        thumb.send_keys(Keys.HOME)
        eventually(lambda: shown.time == 0.0, PATIENCE)
        eventually(lambda: press(two, "Play"), PATIENCE)
        eventually(lambda: shown.time > 0.1, PATIENCE)
        eventually(lambda: press(one, "Pause"), PATIENCE)
        eventually(lambda: not shown.playing, PATIENCE)
        one.refresh()
        eventually(lambda: "first" in text(one), PATIENCE)
        assert one.title != "taken"
        assert errors(one) == []
        assert errors(two) == []
