"""Stop options: what cannot be opened is said beforehand, and what is open pulls the stop."""

from __future__ import annotations

import os
import pickle
import pty
import socket
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from crazyarena.clock import WallClock
from crazyarena.crazyswarm_compat.commands import Emergency
from crazyarena.errors import CrazyarenaError, DependencyMissing, InputError
from crazyarena.runner.rig.stops import DeadManBy, StopOptions, open_stops
from crazyarena.safety import estop_sources
from crazyarena.safety.estop import EmergencyStop
from crazyarena.safety.estop_sources import stop_local, stop_over_zenoh
from tests.safety.pad import Pad
from tests.waiting import eventually

PATIENCE = 10.0
SECRET = b"correct horse battery staple"


class Link:
    def __init__(self) -> None:
        self.sent: list[object] = []
        self.stopped = threading.Event()

    def send(self, command, vehicle=None) -> None:
        self.sent.append(command)
        self.stopped.set()


@pytest.fixture
def link():
    return Link()


@pytest.fixture
def stop(link):
    stop = EmergencyStop([link], WallClock())
    yield stop
    stop.close()


@pytest.fixture
def terminal():
    master, slave = pty.openpty()
    yield master, slave
    os.close(master)
    os.close(slave)


@pytest.fixture
def pad(monkeypatch):
    pad = Pad()

    def opened(which="auto", button=0x131):
        assert which == "auto"
        return pad

    monkeypatch.setattr(estop_sources, "open_gamepad", opened)
    return pad


@pytest.fixture
def token(tmp_path) -> Path:
    file = tmp_path / "stop.token"
    file.write_bytes(SECRET)
    file.chmod(0o600)
    return file


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def test_options_travel_to_another_process():
    options = StopOptions(True, True, "auto", DeadManBy.KEY, False, ("tcp/a:1",), token=Path("t"))
    assert pickle.loads(pickle.dumps(options)) == options


def test_the_keyboard_may_stay_behind():
    options = StopOptions(
        keyboard=True, gamepad="auto", dead_man=DeadManBy.KEY, listen=("tcp/0.0.0.0:1",)
    )
    there, here = options.without_keyboard(), options.only_keyboard()
    assert not there.keyboard
    assert there.gamepad == "auto"
    assert there.dead_man is DeadManBy.KEY
    assert here == StopOptions(shell=False, keyboard=True, dead_man=DeadManBy.KEY)
    held = StopOptions(keyboard=True, gamepad="auto", dead_man=DeadManBy.GAMEPAD)
    assert held.only_keyboard().dead_man is None


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (StopOptions(dead_man=DeadManBy.GAMEPAD), "add --gamepad auto"),
        (StopOptions(dead_man=DeadManBy.KEY), "no terminal"),
        (StopOptions(keyboard=True), "no terminal"),
        (StopOptions(token=Path("nowhere")), "--stop-network"),
        (StopOptions(network=True, token=Path("nowhere")), "cannot read the stop token"),
    ],
)
def test_what_cannot_be_opened_is_said_before_anything_flies(options, words):
    read, write = os.pipe()
    try:
        with pytest.raises(InputError, match=words):
            options.check(stream=read)
    finally:
        os.close(read)
        os.close(write)


@pytest.mark.parametrize("name", ["/dev/input/event987", "/dev/null"])
def test_a_wrong_gamepad_is_named(name, monkeypatch):
    pytest.importorskip("evdev")
    with pytest.raises(InputError, match=name):
        StopOptions(gamepad=name).check()


def test_no_gamepad(monkeypatch):
    monkeypatch.setitem(sys.modules, "evdev", SimpleNamespace(list_devices=list))
    with pytest.raises(InputError, match="Plug it in"):
        StopOptions(gamepad="auto").check()


def test_no_evdev(monkeypatch):
    monkeypatch.setitem(sys.modules, "evdev", None)
    with pytest.raises(DependencyMissing, match=r"crazyarena\[gamepad\]"):
        StopOptions(gamepad="auto").check()


def test_a_background_process_leaves_the_terminal_alone(terminal, stop, monkeypatch):
    monkeypatch.setattr(os, "tcgetpgrp", lambda stream: os.getpgrp() + 1)
    with pytest.raises(InputError, match="background"):
        open_stops(StopOptions(shell=False, keyboard=True), stop, WallClock(), stream=terminal[1])


def test_one_that_fails_closes_the_others(stop, tmp_path):
    read, write = os.pipe()
    with pytest.raises(CrazyarenaError):
        open_stops(StopOptions(keyboard=True), stop, WallClock(), stream=read, folder=tmp_path)
    assert list(tmp_path.glob("*.sock")) == []
    os.close(read)
    os.close(write)


def test_every_source_is_open_and_says_so(stop, link, terminal, pad, tmp_path, token):
    endpoint = free_endpoint()
    master, slave = terminal
    options = StopOptions(
        keyboard=True, gamepad="auto", listen=(endpoint,), token=token, session="cf1"
    )
    stops = open_stops(options, stop, WallClock(), stream=slave, folder=tmp_path)
    try:
        assert len(stops.notes) == 4
        assert any("pad of the test" in note for note in stops.notes)
        assert any(endpoint in note and "with the token" in note for note in stops.notes)
        assert stops.dead_man is None
        assert [answer for _, answer in stop_local(test=True, folder=tmp_path)] == ["tested"]
        (session,) = stop_over_zenoh(b"not the secret of these", "", [endpoint])
        assert session.startswith("cf1-")
        eventually(lambda: stops.refused() > 0, 10.0)
        assert not link.stopped.is_set()
        stop_over_zenoh(SECRET, "smoke", [endpoint])
        eventually(lambda: stop.stopped is not None, 10.0)
        assert stop.stopped.source == "zenoh"
        count = len(link.sent)
        os.write(master, b" ")
        eventually(lambda: len(link.sent) > count + 15 or stop._thread.is_alive() is False, 10.0)
        pad.press(0x131, 1)
        assert set(link.sent) == {Emergency()}
    finally:
        stops.close()
    stops.close()
    assert stop_local(folder=tmp_path) == []


@pytest.mark.parametrize("source", ["keyboard", "gamepad", "shell"])
def test_each_source_alone(source, stop, link, terminal, pad, tmp_path):
    options = StopOptions(
        shell=source == "shell",
        keyboard=source == "keyboard",
        gamepad="auto" if source == "gamepad" else None,
    )
    stops = open_stops(options, stop, WallClock(), stream=terminal[1], folder=tmp_path)
    try:
        if source == "keyboard":
            os.write(terminal[0], b"q")
        elif source == "gamepad":
            pad.press(0x131, 1)
        else:
            stop_local(folder=tmp_path)
        assert link.stopped.wait(PATIENCE)
        assert stop.stopped.source == source
    finally:
        stops.close()


@pytest.mark.parametrize("by", list(DeadManBy))
def test_only_the_chosen_one_holds(by, stop, link, terminal, pad, tmp_path):
    options = StopOptions(keyboard=True, gamepad="auto", dead_man=by)
    stops = open_stops(options, stop, WallClock(), stream=terminal[1], folder=tmp_path)
    try:
        if by is DeadManBy.KEY:
            pad.press(0x136, 1)
            threading.Event().wait(0.3)
            assert stops.dead_man.age() == float("inf")
            os.write(terminal[0], b"h")
        else:
            os.write(terminal[0], b"h")
            threading.Event().wait(0.3)
            assert stops.dead_man.age() == float("inf")
            pad.press(0x136, 1)
        eventually(lambda: stops.dead_man.age() < PATIENCE, 10.0)
        assert not link.stopped.is_set()
    finally:
        stops.close()


def test_a_key_here_for_a_dead_man_elsewhere(stop, terminal, tmp_path):
    options = StopOptions(keyboard=True, dead_man=DeadManBy.KEY)
    there = open_stops(options.without_keyboard(), stop, WallClock(), folder=tmp_path)
    here = open_stops(
        options.only_keyboard(), stop, WallClock(), dead_man=there.dead_man, stream=terminal[1]
    )
    try:
        os.write(terminal[0], b"h")
        eventually(lambda: there.dead_man.age() < PATIENCE, 10.0)
    finally:
        here.close()
        there.close()


def test_a_stop_socket_that_is_tampered_with_goes_on_record(monkeypatch, tmp_path):
    from crazyarena.levels import load_level
    from crazyarena.runner.rig.rig import simulated

    monkeypatch.setenv("CRAZYARENA_RUNTIME_DIR", str(tmp_path))
    level = load_level("sim2real")
    rig = simulated(level, 1)
    try:
        guard = rig.safeguard
        guard.open_stops(StopOptions())
        (path,) = (tmp_path / f"crazyarena-{os.getuid()}").glob("estop-*.sock")
        path.unlink()
        eventually(
            lambda: any("removed the stop socket" in event.detail for event in guard.events()), 20.0
        )
    finally:
        rig.close()
