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
@pytest.mark.timeout(600)
def test_two_browsers_load_scrub_and_play_without_errors(replay):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    shown, url = replay
    with browser(700, 500) as one, browser(360, 640, phone=True) as two:
        for driver in (one, two):
            driver.get(url)
        eventually(lambda: "first" in text(one) and "second" in text(two), 60.0)
        thumb = one.find_element(By.CSS_SELECTOR, "[role=slider]")
        thumb.send_keys(Keys.END)
        eventually(lambda: shown.time == 5.0)
        # What one does, the other sees.
        for driver in (one, two):
            eventually(lambda driver=driver: "5.00 s" in text(driver), 60.0)
            eventually(lambda driver=driver: "gate passed" in text(driver), 60.0)
        thumb.send_keys(Keys.HOME)
        eventually(lambda: shown.time == 0.0)
        eventually(lambda: press(two, "Play"))
        eventually(lambda: shown.time > 0.1)
        eventually(lambda: press(one, "Pause"))
        eventually(lambda: not shown.playing)
        one.refresh()
        eventually(lambda: "first" in text(one), 60.0)
        assert one.title != "taken"
        assert errors(one) == []
        assert errors(two) == []
