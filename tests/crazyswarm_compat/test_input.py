"""Gamepad and keyboard; the gamepad's device file is a named pipe."""

from __future__ import annotations

import io
import os
import struct

import pytest

from crazyarena.crazyswarm_compat.joystick import Joystick
from crazyarena.crazyswarm_compat.keyboard import KeyPoller
from crazyarena.crazyswarm_compat.linuxjsdev import Joystick as Device
from crazyarena.crazyswarm_compat.timehelper import TimeHelper
from crazyarena.crazyswarm_compat.visualizers import VisNull


@pytest.fixture
def time_helper():
    return TimeHelper(VisNull(), 0.01, False, 0.0)


@pytest.fixture
def gamepad(tmp_path, time_helper):
    """Input on a gamepad, and a function that presses (1) or releases (0) a button."""
    os.mkfifo(tmp_path / "js0")
    writer = os.open(tmp_path / "js0", os.O_RDWR)

    def press(button, value, kind=1):
        os.write(writer, struct.pack("=IhBB", 0, value, kind, button))

    yield Joystick(time_helper, Device(tmp_path)), press
    os.close(writer)


def when(time_helper, deadline, action):
    """Call ``action`` once, at the first tick from ``deadline`` on."""
    pending = [action]

    def observe(t, _):
        if pending and t >= deadline:
            pending.pop()()

    time_helper.addObserver(observe)


def test_button(gamepad):
    joystick, press = gamepad
    press(5, 0, kind=0x81)  # the state that a device reports when it is opened
    assert joystick.checkIfButtonIsPressed() is False
    press(4, 1)
    assert joystick.checkIfButtonIsPressed() is False
    assert joystick.checkIfAnyButtonIsPressed() == [0, 0, 0, 0, 1, 0]
    press(5, 1)
    assert joystick.checkIfButtonIsPressed() is True


def test_wait_for_press_and_release(gamepad, time_helper):
    joystick, press = gamepad
    when(time_helper, 0.5, lambda: press(5, 1))
    when(time_helper, 1.0, lambda: press(5, 0))
    joystick.waitUntilButtonPressed()
    assert 1.0 <= time_helper.time() < 1.1


def test_wait_for_any_button(gamepad, time_helper):
    joystick, press = gamepad
    when(time_helper, 0.2, lambda: press(3, 1))
    when(time_helper, 0.4, lambda: press(3, 0))
    assert joystick.waitUntilAnyButtonPressed() == [0, 0, 0, 1]
    assert 0.4 <= time_helper.time() < 0.5


def test_axes(tmp_path):
    os.mkfifo(tmp_path / "js2")
    writer = os.open(tmp_path / "js2", os.O_RDWR)
    device = Device(tmp_path)
    assert device.devices() == [{"id": 2, "name": "js2"}]
    device.open(2)
    os.write(writer, struct.pack("=IhBB", 0, -32767, 2, 1))
    assert device.read(2) == ([0.0, -1.0], [])
    device.close(2)
    os.close(writer)


def test_without_joystick(tmp_path, time_helper, capsys):
    joystick = Joystick(time_helper, Device(tmp_path))
    assert "No joystick found" in capsys.readouterr().out
    assert joystick.checkIfButtonIsPressed() is False
    assert joystick.checkIfAnyButtonIsPressed() is None
    assert joystick.waitUntilAnyButtonPressed() is None


def test_key_stands_in_for_the_button(tmp_path, time_helper, monkeypatch):
    read, write = os.pipe()
    with os.fdopen(read) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        joystick = Joystick(time_helper, Device(tmp_path))
        when(time_helper, 0.3, lambda: os.write(write, b"x"))
        joystick.waitUntilButtonPressed()
        assert 0.3 <= time_helper.time() < 0.4
    os.close(write)


@pytest.mark.parametrize("stdin", ["ended", "none", "no descriptor"])
def test_scripts_go_on_unattended(tmp_path, time_helper, monkeypatch, stdin):
    with open(os.devnull) as ended:
        streams = {"ended": ended, "none": None, "no descriptor": io.StringIO("")}
        monkeypatch.setattr("sys.stdin", streams[stdin])
        Joystick(time_helper, Device(tmp_path)).waitUntilButtonPressed()
    assert time_helper.time() < 0.1


def test_keys_in_order(monkeypatch):
    read, write = os.pipe()
    with os.fdopen(read) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        with KeyPoller() as keys:
            assert keys.poll() is None
            os.write(write, b"a")
            assert keys.poll() == "a"
            assert keys.poll() is None
            os.close(write)
            assert keys.poll() is None
            assert keys.ended
