"""Keyboard and gamepad survive whatever they are given, and then still stop."""

from __future__ import annotations

import os
import pty
import random
import struct
import threading
from types import SimpleNamespace

import pytest

from crazyarena.clock import WallClock
from crazyarena.safety.estop import DeadMan, EmergencyStop
from crazyarena.safety.estop_sources import GamepadSource, KeyboardSource
from tests.safety.test_estop import Link
from tests.waiting import eventually

MANY = 10_000
PATIENCE = 30.0
# The keys that stop are no attack, and those that are signals empty the queue: a kernel may then
# leave who writes and who reads waiting for each other.
STOPPING = set(b" \r\n\x1bqQ" + b"\x03\x1a\x1c")


@pytest.fixture
def link():
    return Link()


@pytest.fixture
def stop(link):
    stop = EmergencyStop([link], WallClock())
    yield stop
    stop.close()


class Broken:
    """A button that fails."""

    def __init__(self) -> None:
        self.pulls = 0

    def trigger(self, source, reason=""):
        self.pulls += 1
        raise RuntimeError("broken")


@pytest.fixture
def terminal():
    master, slave = pty.openpty()
    yield master, slave
    os.close(master)
    os.close(slave)


def test_the_keyboard_survives_ten_thousand_messages_and_then_still_stops(stop, link, terminal):
    master, slave = terminal
    said: list[str] = []
    dead_man = DeadMan(WallClock())
    keyboard = KeyboardSource(stop, dead_man, slave, said.append)
    rng = random.Random(1)
    try:
        for index in range(MANY):
            message = bytes(b for b in rng.randbytes(1 + index % 40) if b not in STOPPING)
            os.write(master, message or b"\xff")
            if index % 1000 == 0:  # another program makes the terminal non-blocking
                os.set_blocking(slave, index % 2000 == 0)
        assert keyboard._thread.is_alive()
        assert not link.stopped.is_set()
        os.write(master, b"q")
        assert link.stopped.wait(PATIENCE)
        assert said == []
    finally:
        os.set_blocking(slave, True)
        keyboard.close()


def test_a_key_that_fails_does_not_end_the_keyboard(terminal):
    master, slave = terminal
    button, said = Broken(), []
    keyboard = KeyboardSource(button, None, slave, said.append)
    try:
        for pulls in (1, 2):
            os.write(master, b" ")
            eventually(lambda pulls=pulls: button.pulls == pulls, PATIENCE)
        eventually(lambda: len(said) == 2, PATIENCE)
        assert "broken" in said[0]
    finally:
        keyboard.close()


class Wild:
    """A gamepad whose events are whatever somebody made of them."""

    def __init__(self, events) -> None:
        self.fd, self._write = os.pipe()
        self.events = list(events)
        self.read_all = threading.Event()
        os.write(self._write, b"x")

    def press(self, code: int) -> None:
        self.events.append(SimpleNamespace(type=1, code=code, value=1))

    def read(self):
        if not self.events:
            self.read_all.set()
            raise BlockingIOError("nothing there")
        event = self.events.pop(0)
        if isinstance(event, Exception):
            raise event
        yield event

    def close(self) -> None:
        os.close(self.fd)
        os.close(self._write)


def _hostile(rng: random.Random):
    kinds = (
        lambda: SimpleNamespace(
            type=rng.choice((0, 1, 2, 3, 4, 17, 21, -1, "1", None, 1.5)),
            code=rng.choice((0, 0x130, 0x136, 0x2FF, -1, 2**64, "B", None, [1], float("nan"))),
            value=rng.choice((0, 1, 2, -(2**31), 2**31, None, "held", float("inf"))),
        ),
        lambda: None,
        lambda: struct.pack("HHi", 1, 0x130, 1),
        lambda: SimpleNamespace(),
        lambda: SimpleNamespace(type=1),
        lambda: BlockingIOError("nothing there"),
        lambda: InterruptedError("a signal"),
    )
    return [rng.choice(kinds)() for _ in range(MANY)]


def test_the_gamepad_survives_ten_thousand_events_and_then_still_stops(stop, link):
    pad, said = Wild(_hostile(random.Random(2))), []
    gamepad = GamepadSource(stop, DeadMan(WallClock()), pad, say=said.append)
    try:
        assert pad.read_all.wait(PATIENCE)
        assert gamepad._thread.is_alive()
        assert not link.stopped.is_set()
        pad.press(0x131)
        assert link.stopped.wait(PATIENCE)
        assert said == []
    finally:
        gamepad.close()


def test_a_button_that_fails_does_not_end_the_gamepad():
    button, said = Broken(), []
    pad = Wild([])
    gamepad = GamepadSource(button, None, pad, say=said.append)
    try:
        for pulls in (1, 2):
            pad.press(0x131)
            eventually(lambda pulls=pulls: button.pulls == pulls, PATIENCE)
        eventually(lambda: len(said) == 2, PATIENCE)
    finally:
        gamepad.close()
