"""Live pages in a real browser, of a flight that is only published."""

from __future__ import annotations

import contextlib
import http.client
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.live import POSITION, STOP, Live
from crazyarena.runner.records.shown_scene import level_scene
from crazyarena.runner.viewer.server import Rights, from_here
from crazyarena.safety.estop_socket import SocketSource
from crazyarena.viewer_process import View, ViewerProcess, ViewOptions
from tests.browser import browser, errors, needs_browser, needs_viser, open_tab, press, text
from tests.waiting import eventually

LABEL = "STOP – cut the motors"
PATIENCE = 240.0


class Button:
    """An emergency stop that only remembers."""

    def __init__(self):
        self.pulled = []

    def trigger(self, source, reason=""):
        self.pulled.append(reason)

    def tested(self):
        pass

    def outcome(self, final):
        return "stopped"


# A swarm of 50 is for graphics processors: a browser without one, beside other programs, may not
# answer its driver for a minute.
FEW = 4


@pytest.fixture
def flight(tmp_path, monkeypatch):
    """A published flight, with its stop and a thread that keeps it moving."""
    monkeypatch.setenv("CRAZYARENA_RUNTIME_DIR", str(tmp_path))
    level = load_level("level1")
    draw = LevelRandom(level, 3).reset()
    live = Live(FEW)
    live.scene(level_scene(level, draw.gates, draw.obstacles))
    button, landed = Button(), []
    source = SocketSource(button, land=landed.append, say=lambda text: None)
    flight = Published(live, button, landed)
    yield flight
    flight.end()
    source.close()


class Published:
    def __init__(self, live, button, landed):
        self.live, self.button, self.landed = live, button, landed
        self.facts = {"phase": "run", "level": "level1", "control": True, "time": 0.0}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._move)
        self._thread.start()

    def _move(self):
        live, k = self.live, 0
        number = np.arange(FEW)
        spots = np.stack([0.4 * number - 1.0, 0.0 * number], 1)
        while not self._ended.wait(0.03):
            k += 1
            live.rows[:, POSITION : POSITION + 2] = spots
            live.rows[:, POSITION + 2] = 1.0 + 0.3 * np.sin(0.1 * k + number)
            live.rows[:, STOP : STOP + 3] = live.rows[:, POSITION : POSITION + 3] + 0.1
            live.extend()
            self.facts["time"] = 0.03 * k
            live.publish(self.facts)

    def end(self):
        if not self._ended.is_set():
            self._ended.set()
            self._thread.join()
            self.live.close()


@pytest.fixture
def viewer(flight):
    viewer = ViewerProcess(flight.live.file, ViewOptions(port=0))
    yield viewer
    viewer.close()


@needs_viser
def test_a_viewer_says_where_it_is_and_ends_with_the_flight(flight, viewer):
    assert viewer.url.startswith("http://127.0.0.1:")
    connection = http.client.HTTPConnection(viewer.url.removeprefix("http://"), timeout=30)
    connection.request("GET", "/")
    assert connection.getresponse().status == 200
    connection.close()
    assert viewer.running
    flight.end()
    eventually(lambda: not viewer.running, PATIENCE)


@needs_viser
def test_a_port_that_is_taken_is_told(flight, viewer):
    port = int(viewer.url.rpartition(":")[2])
    with pytest.raises(InputError, match="another port with --view-port"):
        ViewerProcess(flight.live.file, ViewOptions(port=port))


@needs_viser
def test_a_token_that_others_can_read_is_told(flight, tmp_path):
    token = tmp_path / "token"
    token.write_text("0123456789abcdef")
    token.chmod(0o644)
    with pytest.raises(InputError, match="chmod 600"):
        ViewerProcess(flight.live.file, ViewOptions(port=0, token=token))


@needs_viser
def test_a_viewer_that_is_killed_or_hangs_does_not_touch_the_flight(flight, viewer):
    os.kill(viewer._process.pid, signal.SIGSTOP)
    before = flight.facts["time"]
    eventually(lambda: flight.facts["time"] > before + 0.5)
    os.kill(viewer._process.pid, signal.SIGKILL)
    before = flight.facts["time"]
    eventually(lambda: flight.facts["time"] > before + 0.5)
    viewer.close()


@needs_viser
def test_a_viewer_whose_flight_was_killed_ends_once_nobody_looks(tmp_path, monkeypatch):
    monkeypatch.setenv("CRAZYARENA_RUNTIME_DIR", str(tmp_path))
    code = (
        "import sys, time; from crazyarena.viewer_process import *;"
        "view = View(ViewOptions(port=0), print);"
        "print(view._viewer._process.pid, flush=True); sys.stdin.read()"
    )
    runner = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with runner:
        url = runner.stdout.readline().split()[-1]
        viewer = int(runner.stdout.readline())
        runner.kill()
        runner.wait()
    # Nobody has it open: it ends by itself.
    eventually(lambda: not Path(f"/proc/{viewer}").exists() or _ended(viewer), PATIENCE)
    assert url


def _ended(pid):
    with contextlib.suppress(FileNotFoundError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    return True


@needs_viser
def test_without_a_flight_there_is_nothing_to_view(tmp_path):
    with pytest.raises(InputError, match="no live flight"):
        ViewerProcess(tmp_path / "none.live", ViewOptions(port=0))


@pytest.mark.parametrize(
    ("peer", "host", "origin", "may"),
    [
        ("127.0.0.1", "127.0.0.1:8080", "http://127.0.0.1:8080", True),
        ("127.0.0.1", "localhost:8080", "http://localhost:8080", True),
        ("::1", "[::1]:8080", "http://[::1]:8080", True),
        # Another page in the same browser, another port, a name made to point here.
        ("127.0.0.1", "127.0.0.1:8080", "http://evil.example", False),
        ("127.0.0.1", "127.0.0.1:8080", "http://127.0.0.1:9000", False),
        ("127.0.0.1", "evil.example:8080", "http://evil.example:8080", False),
        ("127.0.0.1", "127.0.0.1:8080", "null", False),
        # From elsewhere, or not a browser at all.
        ("10.0.0.7", "10.0.0.5:8080", "http://10.0.0.5:8080", False),
        ("127.0.0.1", "127.0.0.1:8080", None, False),
        ("127.0.0.1", None, "http://127.0.0.1:8080", False),
    ],
)
def test_only_our_own_page_on_this_machine_may_without_a_token(peer, host, origin, may):
    assert from_here(peer, host, origin) is may


def test_over_a_network_only_the_token_gives_rights():
    rights = Rights("0.0.0.0", b"0123456789abcdef")
    assert not rights.without_token(object())
    assert rights.by_token
    assert rights.knows("0123456789abcdef\n")
    assert not rights.knows("0123456789abcdeF")
    assert not rights.knows("")
    assert not Rights("0.0.0.0", None).knows("")


@needs_browser
@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_two_browsers_stop_land_arm_and_come_back(flight, viewer):
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.by import By

    with browser(500, 500) as one, browser(360, 500, phone=True) as two:
        for driver in (one, two):
            driver.get(viewer.url)
        eventually(lambda: LABEL in text(one) and LABEL in text(two), PATIENCE)
        open_tab(one, "Operator")
        eventually(lambda: "run" in text(one), PATIENCE)
        # STOP and LAND, by the way of crazyarena estop.
        assert press(one, LABEL)
        eventually(lambda: flight.button.pulled == ["operator's page"], PATIENCE)
        assert press(two, "LAND")
        eventually(lambda: flight.landed == ["operator's page"], PATIENCE)
        assert flight.button.pulled == ["operator's page"]
        # A click does not arm; holding does.
        flight.facts["question"] = {"id": "now", "text": "Arm vehicle 1?"}
        eventually(lambda: "Hold to arm" in text(one), PATIENCE)
        eventually(lambda: "Arm vehicle 1?" in text(one), PATIENCE)
        button = one.find_element(By.XPATH, "//button[contains(., 'Hold to arm')]")
        button.click()
        assert flight.live.reply().get("confirm") is None
        ActionChains(one).click_and_hold(button).perform()
        eventually(lambda: flight.live.reply().get("confirm") == "now", PATIENCE)
        ActionChains(one).release().perform()
        flight.facts["question"] = None
        # It comes back after a reload, and the other page has not noticed.
        one.refresh()
        eventually(lambda: LABEL in text(one), PATIENCE)
        assert press(one, LABEL)
        eventually(lambda: len(flight.button.pulled) == 2, PATIENCE)
        eventually(lambda: flight.live.reply().get("browsers") == 2, PATIENCE)
        # After the flight the page stays, without buttons.
        flight.facts["phase"] = "over"
        eventually(lambda: "over" in text(one), PATIENCE)
        flight.end()
        eventually(lambda: LABEL not in text(one) and LABEL not in text(two), PATIENCE)
        assert viewer.running
        for driver in (one, two):
            assert errors(driver) == []


# Everything in one task of the page: whatever shares a sender with STOP comes within 50 ms.
_AT_ONCE = """
    const [label, before, after] = arguments;
    const boxes = [...document.querySelectorAll('input[type=checkbox]')];
    const others = n => { for (let k = 0; k < n; k++) boxes[k % boxes.length].click(); };
    const button = [...document.querySelectorAll('button')].find(b => b.innerText.trim() === label);
    others(before);
    button.click();
    others(after);
"""


@needs_browser
@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_no_stop_is_lost_among_other_inputs(flight, viewer):
    with browser(500, 500) as driver:
        driver.get(viewer.url)
        eventually(lambda: LABEL in text(driver), PATIENCE)
        pulled, landed = flight.button.pulled, flight.landed
        for k in range(25):
            driver.execute_script(_AT_ONCE, LABEL, k % 5, k // 5)
            driver.execute_script(_AT_ONCE, "LAND", k // 5, k % 5)
            eventually(lambda k=k: len(pulled) == len(landed) == k + 1, PATIENCE)
        # Also faster than answers come, and mixed.
        for _ in range(10):
            driver.execute_script(_AT_ONCE, "LAND", 1, 1)
            driver.execute_script(_AT_ONCE, LABEL, 1, 1)
        eventually(lambda: len(pulled) == len(landed) == 35, PATIENCE)
        assert errors(driver) == []


@needs_browser
@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_keys_stop_as_the_button_does_while_there_is_one(flight, viewer):
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.keys import Keys

    def keys(driver, letter):
        held = (Keys.CONTROL, Keys.ALT, Keys.SHIFT)
        chain = ActionChains(driver)
        for key in held:
            chain.key_down(key)
        chain.send_keys(letter)
        for key in held:
            chain.key_up(key)
        chain.perform()

    with browser(500, 500) as driver:
        driver.get(viewer.url)
        eventually(lambda: LABEL in text(driver), PATIENCE)
        keys(driver, "s")
        eventually(lambda: len(flight.button.pulled) == 1, PATIENCE)
        keys(driver, "l")
        eventually(lambda: len(flight.landed) == 1, PATIENCE)
        flight.facts["control"] = False
        eventually(lambda: LABEL not in text(driver), PATIENCE)
        keys(driver, "s")
        flight.facts["control"] = True
        eventually(lambda: LABEL in text(driver), PATIENCE)
        keys(driver, "l")
        eventually(lambda: len(flight.landed) == 2, PATIENCE)
        assert len(flight.button.pulled) == 1


@needs_browser
@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_a_second_laptop_may_only_look_until_it_knows_the_token(flight, tmp_path):
    from selenium.webdriver.common.by import By

    token = tmp_path / "token"
    token.touch(mode=0o600)
    token.write_text("0123456789abcdef")
    # Bound to every address, not even this machine's browsers may more than look.
    viewer = ViewerProcess(flight.live.file, ViewOptions("0.0.0.0", 0, token))
    try:
        with browser(600, 600) as driver:
            driver.get(f"http://127.0.0.1:{viewer.url.rpartition(':')[2]}")
            eventually(lambda: "Operator" in text(driver), PATIENCE)
            open_tab(driver, "Operator")
            eventually(lambda: "read only" in text(driver), PATIENCE)
            assert LABEL not in text(driver)
            # Selects and sliders bring inputs of their own, some of them hidden.
            fields = driver.find_elements(By.CSS_SELECTOR, "input[type=text], input:not([type])")
            field = [f for f in fields if f.is_displayed()][-1]
            field.send_keys("wrong")
            eventually(lambda: "this is not the token" in text(driver), PATIENCE)
            assert LABEL not in text(driver)
            field.clear()
            # One letter after the other, as fast as they come.
            field.send_keys("0123456789abcdef")
            eventually(lambda: LABEL in text(driver), PATIENCE)
            assert flight.button.pulled == []
            assert press(driver, LABEL)
            eventually(lambda: flight.button.pulled == ["operator's page"], PATIENCE)
    finally:
        viewer.close()


@needs_viser
def test_several_flights_share_a_view(tmp_path, monkeypatch):
    monkeypatch.setenv("CRAZYARENA_RUNTIME_DIR", str(tmp_path))
    said = []
    view = View(ViewOptions(port=0), said.append)
    assert view.shown
    view.finish()
    assert not view.shown
    view.finish()
    assert len(said) == 1
