"""Every hand on the emergency stop reaches the vehicles; forged ones over the network do not."""

from __future__ import annotations

import json
import os
import pty
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from crazyarena.clock import VirtualClock, WallClock
from crazyarena.crazyswarm_compat.commands import Command, Emergency
from crazyarena.errors import InputError
from crazyarena.safety.estop import DeadMan, EmergencyStop, interrupt_policy
from crazyarena.safety.estop_sources import (
    GamepadSource,
    KeyboardSource,
    SocketSource,
    ZenohSource,
    runtime_folder,
    stop_local,
    stop_over_zenoh,
)
from crazyarena.safety.estop_token import TokenCheck, make_message, read_secret
from tests.safety.pad import Pad
from tests.waiting import eventually

SECRET = b"correct horse battery staple"
PATIENCE = 10.0


class Link:
    """A vehicle link that counts."""

    def __init__(self, broken: bool = False) -> None:
        self.broken = broken
        self.sent: list[Command] = []
        self.stopped = threading.Event()

    def send(self, command: Command, vehicle: int | None = None) -> None:
        if self.broken:
            raise OSError("no radio")
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


def test_it_is_sent_before_the_call_returns_and_repeated(link):
    stop = EmergencyStop([link], VirtualClock())
    stop.trigger("test", "because")
    assert link.sent[0] == Emergency()
    assert (stop.stopped.source, stop.stopped.reason) == ("test", "because")
    stop._thread.join(PATIENCE)
    assert link.sent == [Emergency()] * 16
    stop.trigger("other")
    assert stop.stopped.source == "test"
    assert len(link.sent) == 17
    stop.close()


def test_links_and_listeners_that_fail_do_not_hold_it_up(link):
    stop = EmergencyStop([Link(broken=True), link], VirtualClock())
    told: list[Any] = []

    def fail(_: Any) -> None:
        raise RuntimeError("disk full")

    stop.on_stop(fail)
    stop.on_stop(told.append)
    stop.trigger("test")
    assert link.sent
    assert len(told) == 1
    assert any("no radio" in error for error in stop.errors)
    assert any("disk full" in error for error in stop.errors)
    stop.close()


def test_load_does_not_hold_it_up(link):
    """While every thread the interpreter will start is busy."""
    busy = threading.Event()
    hogs = [
        threading.Thread(target=lambda: sum(1 for _ in iter(busy.is_set, True))) for _ in "abcd"
    ]
    for hog in hogs:
        hog.start()
    try:
        stop = EmergencyStop([link], WallClock())
        stop.trigger("test")
        assert link.sent[0] == Emergency()
        stop.close()
    finally:
        busy.set()
        for hog in hogs:
            hog.join()


# Keyboard and gamepad


def test_keyboard_stops_and_holds(stop, link):
    master, slave = pty.openpty()
    dead_man = DeadMan(WallClock())
    keyboard = KeyboardSource(stop, dead_man, slave)
    try:
        os.write(master, b"x")
        os.write(master, b"h")
        waited = threading.Event()
        for _ in range(100):
            if dead_man.age() < PATIENCE:
                break
            waited.wait(0.05)
        assert dead_man.age() < PATIENCE
        assert not link.stopped.is_set()
        os.write(master, b" ")
        assert link.stopped.wait(PATIENCE)
        assert stop.stopped.source == "keyboard"
    finally:
        keyboard.close()
        os.close(master)
        os.close(slave)


def test_keyboard_needs_a_terminal(stop):
    read, write = os.pipe()
    with pytest.raises(InputError, match="terminal"):
        KeyboardSource(stop, None, read)
    os.close(read)
    os.close(write)


def test_gamepad_stops_holds_and_may_be_unplugged(stop, link):
    pad = Pad()
    dead_man = DeadMan(WallClock())
    gamepad = GamepadSource(stop, dead_man, pad)
    pad.press(0x136, 1)
    eventually(lambda: dead_man.age() < 0.5, 10.0)
    pad.press(0x136, 0)
    eventually(lambda: dead_man.age() == float("inf"), 10.0)
    pad.press(0x136, 1)
    eventually(lambda: dead_man.age() < 0.5, 10.0)
    pad.press(0x130, 1)
    assert not link.stopped.is_set()
    pad.press(0x131, 1)
    assert link.stopped.wait(PATIENCE)
    assert stop.stopped.source == "gamepad"
    pad.unplug()
    eventually(lambda: dead_man.age() == float("inf"), 10.0)
    gamepad.close()


# Another shell


def test_another_shell(stop, link, tmp_path):
    source = SocketSource(stop, tmp_path)
    try:
        assert [answer for _, answer in stop_local(test=True, folder=tmp_path)] == ["tested"]
        assert stop.last_test is not None
        assert not link.stopped.is_set()
        environment = {**os.environ, "CRAZYARENA_RUNTIME_DIR": str(tmp_path)}
        folder = tmp_path / f"crazyarena-{os.getuid()}"
        folder.mkdir(mode=0o700)
        os.link(source.path, folder / source.path.name)
        result = subprocess.run(
            [sys.executable, "-m", "crazyarena", "estop", "--reason", "smoke"],
            env=environment,
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert result.returncode == 0, result.stderr
        assert link.stopped.wait(PATIENCE)
        assert (stop.stopped.source, stop.stopped.reason) == ("shell", "smoke")
    finally:
        source.close()
    assert stop_local(folder=tmp_path) == []


def test_whatever_arrives_at_the_socket_is_a_stop(stop, link, tmp_path):
    source = SocketSource(stop, tmp_path)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.sendto(b"\xff not json", str(source.path))
    assert link.stopped.wait(PATIENCE)
    source.close()


def test_sockets_nobody_listens_on_are_removed(tmp_path):
    dead = tmp_path / "estop-1.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as gone:
        gone.bind(str(dead))
    assert stop_local(folder=tmp_path) == []
    assert not dead.exists()


def test_command_without_anything_to_stop_says_so(tmp_path):
    result = subprocess.run(
        [sys.executable, "-m", "crazyarena", "estop"],
        env={**os.environ, "CRAZYARENA_RUNTIME_DIR": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert result.returncode == 1
    assert "nothing" in result.stdout.lower()


# Signals


def test_interrupt_lands_and_once_more_stops():
    landed: list[str] = []
    stopped: list[tuple[str, str]] = []
    before = signal.getsignal(signal.SIGINT)
    with interrupt_policy(landed.append, lambda *why: stopped.append(why)):
        os.kill(os.getpid(), signal.SIGINT)
        eventually(lambda: landed == ["SIGINT"], 10.0)
        assert stopped == []
        os.kill(os.getpid(), signal.SIGTERM)
        eventually(lambda: stopped == [("signal", "SIGTERM")], 10.0)
    assert signal.getsignal(signal.SIGINT) is before


# Tokens


class Now:
    time = 1_000_000.0

    def __call__(self) -> float:
        return self.time


def test_token_is_accepted_once_and_only_with_the_secret():
    now = Now()
    check = TokenCheck(SECRET, now)
    message = make_message(SECRET, "fire", check.session, now)
    assert check.accept(message) == "fire"
    assert check.accept(message) is None  # replayed
    assert check.accept(make_message(b"another secret, long", "fire", check.session, now)) is None
    assert check.accept(make_message(None, "fire", check.session, now)) is None
    assert check.refused == 3


def test_token_of_another_session_is_refused():
    now = Now()
    old, new = TokenCheck(SECRET, now), TokenCheck(SECRET, now)
    message = make_message(SECRET, "", old.session, now)
    assert new.accept(message) is None
    assert old.accept(message) == ""


def test_token_without_a_session_is_good_for_a_short_time():
    now = Now()
    message = make_message(SECRET, "", "", now)
    now.time += 29.0
    assert TokenCheck(SECRET, now).accept(message) == ""
    now.time += 5.0
    assert TokenCheck(SECRET, now).accept(message) is None


@pytest.mark.parametrize("field", ["nonce", "time", "session", "reason", "mac"])
def test_token_covers_every_field(field):
    now = Now()
    check = TokenCheck(SECRET, now)
    fields = json.loads(make_message(SECRET, "why", check.session, now))
    fields[field] = 5.0 if field == "time" else "0" * 32
    assert check.accept(json.dumps(fields).encode()) is None


@pytest.mark.parametrize(
    "payload",
    [b"", b"{}", b"[]", b"null", b"\xff\xfe", b"[" * 3000, b'{"nonce": 1e999}', b"x" * 100_000],
)
def test_garbage_is_refused_with_a_secret_and_a_stop_without(payload):
    assert TokenCheck(SECRET).accept(payload) is None
    assert TokenCheck(None).accept(payload) is not None


def test_secret_files_must_be_private_and_long(tmp_path):
    path = tmp_path / "token"
    with pytest.raises(InputError, match="cannot read"):
        read_secret(path)
    path.write_bytes(b"short")
    path.chmod(0o600)
    with pytest.raises(InputError, match="16"):
        read_secret(path)
    path.write_bytes(SECRET + b"\n")
    assert read_secret(path) == SECRET
    path.chmod(0o644)
    with pytest.raises(InputError, match="chmod"):
        read_secret(path)


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def test_zenoh_stop_needs_the_token(stop, link):
    endpoint = free_endpoint()
    source = ZenohSource(stop, TokenCheck(SECRET), listen=[endpoint])
    try:
        assert stop_over_zenoh(None, "forged", [endpoint]) == [source.check.session]
        assert stop_over_zenoh(b"guessed, not known at all", "forged", [endpoint])
        eventually(lambda: source.check.refused >= 2, 10.0)
        assert not link.stopped.is_set()
        assert stop_over_zenoh(SECRET, "smoke", [endpoint]) == [source.check.session]
        assert link.stopped.wait(PATIENCE)
        assert (stop.stopped.source, stop.stopped.reason) == ("zenoh", "smoke")
    finally:
        source.close()


def test_zenoh_stop_without_tokens_takes_any(stop, link):
    endpoint = free_endpoint()
    source = ZenohSource(stop, TokenCheck(None), listen=[endpoint])
    try:
        stop_over_zenoh(None, "smoke", [endpoint])
        assert link.stopped.wait(PATIENCE)
    finally:
        source.close()


def test_a_folder_that_can_hold_no_socket_is_named(stop, tmp_path):
    deep = tmp_path / ("d" * 100)
    deep.mkdir()
    with pytest.raises(InputError, match=r"dddd.*estop-.*too long.*XDG_RUNTIME_DIR"):
        SocketSource(stop, deep)


def test_the_runtime_folder_is_put_right(tmp_path, monkeypatch):
    monkeypatch.setenv("CRAZYARENA_RUNTIME_DIR", str(tmp_path))
    folder: Path = runtime_folder()
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    assert runtime_folder() == folder
    assert folder.stat().st_mode & 0o777 == 0o700
