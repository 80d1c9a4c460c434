"""Stops from other shells: found from anywhere, heard whatever was sent before, never held up."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import struct
import subprocess
import sys
import threading
from types import SimpleNamespace

import pytest

from crazyarena.clock import WallClock
from crazyarena.errors import InputError
from crazyarena.safety import estop_local, estop_socket
from crazyarena.safety.estop import EmergencyStop, Rehearsal
from crazyarena.safety.estop_local import places, runtime_folder, stop_local
from crazyarena.safety.estop_socket import SocketSource
from crazyarena.safety.estop_token import TokenCheck, make_message
from tests.waiting import eventually

PATIENCE = 20.0
MANY = 10_000


class Link:
    def __init__(self, broken: bool = False, vehicles: tuple[int, ...] = (1,)) -> None:
        self.broken = broken
        self.vehicles = vehicles
        self.stopped = threading.Event()
        self.sent: list[int | None] = []

    def send(self, command, vehicle=None):
        if self.broken:
            raise OSError("no radio")
        if len(self.sent) < 100:
            self.sent.append(vehicle)
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
def said():
    return []


@pytest.fixture
def source(stop, tmp_path, said):
    source = SocketSource(stop, tmp_path, said.append)
    yield source
    source.close()


def answers(folder, **options):
    return [answer for _, answer in stop_local(folder=folder, **options)]


# Always tried


def crazyarena_estop(environment, *arguments):
    return subprocess.run(
        [sys.executable, "-m", "crazyarena", "estop", *arguments],
        env=environment, capture_output=True, text=True, timeout=60,
    )  # fmt: skip


@pytest.mark.parametrize("mode", [0o777, 0o755, 0o000])
def test_a_folder_with_odd_permissions_is_sent_to_and_put_right(
    stop, link, tmp_path, monkeypatch, mode
):
    monkeypatch.setenv(estop_local.ONLY_PLACE, str(tmp_path))
    source = SocketSource(stop, say=lambda text: None)
    folder = source.path.parent
    monkeypatch.setattr(source._doors[0], "mend", lambda: None)
    folder.chmod(mode)
    try:
        done = crazyarena_estop(dict(os.environ))
        assert done.returncode == 0, done.stdout + done.stderr
        assert "permissions" in done.stderr
        assert link.stopped.is_set()
        assert folder.stat().st_mode & 0o777 == 0o700
    finally:
        folder.chmod(0o700)
        source.close()


def test_exit_code_is_of_what_a_link_confirms(tmp_path, monkeypatch):
    monkeypatch.setenv(estop_local.ONLY_PLACE, str(tmp_path))
    stop = EmergencyStop([Link(broken=True)], WallClock())
    source = SocketSource(stop)
    try:
        done = crazyarena_estop(dict(os.environ))
        assert done.returncode == 1
        assert "no radio" in done.stdout
        assert "NOT CONFIRMED" in done.stdout
    finally:
        source.close()
        stop.close()


def test_what_only_claims_to_be_a_flight_confirms_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv(estop_local.ONLY_PLACE, str(tmp_path))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as mute:
        mute.bind(str(runtime_folder() / "estop-1-aaaaaa.sock"))
        done = crazyarena_estop(dict(os.environ))
    assert done.returncode == 1
    assert "no answer" in done.stdout


def test_links_that_ask_their_vehicles_are_waited_for(tmp_path):
    link = Link(vehicles=(1, 2))
    confirmed = []
    link.stopped_since = lambda time: len(confirmed)
    stop = EmergencyStop([link], WallClock())
    source = SocketSource(stop, tmp_path)
    try:
        threading.Thread(
            target=lambda: link.stopped.wait(PATIENCE) and confirmed.extend([1, 2])
        ).start()
        assert answers(tmp_path) == ["stopped"]
        confirmed.pop()
        assert answers(tmp_path) == ["stopped, but only 1 of 2 vehicles confirm"]
        confirmed.pop()
        assert answers(tmp_path)[0].startswith("sent, not confirmed")
    finally:
        source.close()
        stop.close()


def test_one_vehicle_that_cannot_be_reached_does_not_keep_it_from_the_others():
    class Picky(Link):
        def send(self, command, vehicle=None):
            if vehicle in (None, 1):
                raise OSError("cf1 is gone")
            super().send(command, vehicle)

    link = Picky(vehicles=(1, 2, 3))
    stop = EmergencyStop([link], WallClock())
    stop.trigger("test")
    assert link.sent[:2] == [2, 3]
    stop.close()


def test_a_rehearsal_confirms_nothing_but_that_it_was_tried(tmp_path, monkeypatch):
    monkeypatch.setenv(estop_local.ONLY_PLACE, str(tmp_path))
    told = []
    source = SocketSource(Rehearsal(EmergencyStop([], WallClock()), told.append))
    try:
        assert crazyarena_estop(dict(os.environ), "--test").returncode == 0
        assert crazyarena_estop(dict(os.environ)).returncode == 1
        assert told == ["shell", "shell"]
    finally:
        source.close()


# Side by side


def test_programs_that_hang_delay_nobody(stop, link, tmp_path):
    """The last in line is sent to before anybody's answer is waited for."""
    hung = []
    for index in range(6):
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        sock.bind(str(tmp_path / f"estop-{index}-hung.sock"))
        hung.append(sock)
    # One whose queue is full already: sending there would wait for ever.
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as filler:
        filler.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                filler.sendto(b"x", str(tmp_path / "estop-0-hung.sock"))
    order = []
    source = SocketSource(stop, tmp_path)
    stop.on_stop(lambda _: order.append("stopped"))
    try:
        found = dict(stop_local(folder=tmp_path, timeout=1.0))
        order.append("returned")
    finally:
        source.close()
        for sock in hung:
            sock.close()
    assert order == ["stopped", "returned"]
    assert found.pop(source.name) == "stopped"
    assert found.pop("estop-0-hung.sock").startswith("does not listen")
    assert set(found.values()) == {"no answer"}
    assert len(found) == 5


# From anywhere


def test_found_whatever_the_environment_says(tmp_path, link):
    """The listener and who stops have nothing in common but the user and the machine."""
    program = (
        "import sys, threading\n"
        "from crazyarena.clock import WallClock\n"
        "from crazyarena.safety.estop import EmergencyStop\n"
        "from crazyarena.safety.estop_socket import SocketSource\n"
        "class Link:\n    def send(self, command, vehicle=None): print('sent', flush=True)\n"
        "source = SocketSource(EmergencyStop([Link()], WallClock()))\n"
        "print(source.name, flush=True)\n"
        "threading.Event().wait(60)\n"
    )
    bare = {k: v for k, v in os.environ.items() if k in ("PATH", "PYTHONPATH")}
    one, other = tmp_path / "one", tmp_path / "other"
    one.mkdir()
    other.mkdir()
    flying = subprocess.Popen(
        [sys.executable, "-c", program],
        env={**bare, "XDG_RUNTIME_DIR": str(one), "TMPDIR": str(one)},
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        name = flying.stdout.readline().strip()
        # A rehearsal, as other sessions of this user may be flying on this machine.
        seek = (
            "from crazyarena.safety.estop_local import stop_local\n"
            f"print(dict(stop_local(test=True)).get({name!r}))"
        )
        for different in (
            {},
            {"XDG_RUNTIME_DIR": str(other), "TMPDIR": str(other)},
            {"XDG_RUNTIME_DIR": "/nonexistent", "TMPDIR": "/nonexistent", "HOME": "/nonexistent"},
        ):
            done = subprocess.run(
                [sys.executable, "-c", seek],
                env={**bare, **different}, capture_output=True, text=True, timeout=60,
            )  # fmt: skip
            assert done.stdout.strip() == "tested", (different, done.stderr)
    finally:
        flying.kill()
        flying.wait()
        flying.stdout.close()


def test_the_places_do_not_depend_on_the_environment_alone(monkeypatch):
    monkeypatch.delenv(estop_local.ONLY_PLACE, raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/some/where")
    first = set(places())
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert first & set(places())


def test_leftovers_refuse_nothing(tmp_path, monkeypatch, stop, link, said):
    """A file, a link to elsewhere, a stale socket where the folder should be or is."""
    name = f"crazyarena-{os.getuid()}"
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / name).write_text("in the way")
    good = tmp_path / "good"
    good.mkdir()
    (good / name).mkdir(mode=0o777)
    (good / name).chmod(0o777)
    for module in (estop_local, estop_socket):
        monkeypatch.setattr(module, "places", lambda: [taken / name, good / name])
    assert runtime_folder() == good / name
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as gone:
        gone.bind(str(good / name / "estop-1-aaaaaa.sock"))
    source = SocketSource(stop, say=said.append)
    try:
        assert any("no folder" in text for text in said)
        assert answers(source.path.parent) == ["stopped"]
    finally:
        source.close()
    assert list((good / name).iterdir()) == []


# Always heard

HOSTILE = [
    b"",
    b"\0",
    b"[" * 2000,
    b'{"a":' * 400,
    b'{"test": true, "reason": ' + b"[" * 1900,
    b'{"test": ' + b"9" * 2000,
    b'{"reason": ' + b'["' * 500,
    b'{"reason": "\\ud800\\u001b[2J"}',
    b"\xff" * 4096,
    b'{"test": true}',
    b'{"test": 1e999}',
    json.dumps({"reason": "x" * 1900}).encode(),
]


def test_the_socket_survives_whatever_is_sent_and_then_still_stops(source, stop, link):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.bind("")  # answers come, and are never read
        files = [os.dup(0)]
        for index in range(MANY):
            message = HOSTILE[index % len(HOSTILE)]
            if index % 100 == 0:  # open files along with it
                rights = (socket.SOL_SOCKET, socket.SCM_RIGHTS, struct.pack("i", files[0]))
                sender.sendmsg([message], [rights], 0, str(source.path))
            else:
                sender.sendto(message, str(source.path))
        os.close(files[0])
    assert source._thread.is_alive()
    assert link.stopped.wait(PATIENCE)
    assert len(os.listdir("/proc/self/fd")) < 100
    link.stopped.clear()
    assert answers(source.path.parent, timeout=PATIENCE) == ["stopped"]
    assert link.stopped.is_set()
    assert "\x1b" not in stop.stopped.reason


def test_a_button_that_fails_does_not_end_the_listener(tmp_path, said):
    class Broken:
        pulls = 0

        def trigger(self, source, reason=""):
            self.pulls += 1
            raise RuntimeError("broken")

        def tested(self):
            raise RuntimeError("broken")

        def outcome(self, final):
            raise RuntimeError("broken")

    button = Broken()
    source = SocketSource(button, tmp_path, said.append)
    try:
        for pulls in (1, 2):
            answers(tmp_path, timeout=0.1)
            eventually(lambda pulls=pulls: button.pulls == pulls, PATIENCE)
        assert any("broken" in text for text in said)
    finally:
        source.close()


@pytest.mark.parametrize("secret", [None, b"correct horse battery staple"])
def test_messages_over_the_network_survive_the_same(secret, stop, link):
    """The receiver of the zenoh source, which zenoh calls in a thread of its own."""
    from crazyarena.safety.estop_sources import ZenohSource

    source = object.__new__(ZenohSource)
    source._stop, source.check = stop, TokenCheck(secret)
    more = [b'{"nonce":"","session":"","reason":"","mac":"","time":' + b"9" * 1500 + b"}"]

    class Payload(bytes):
        def to_bytes(self):
            return bytes(self)

    sent = [*HOSTILE, *more, b"x" * 100_000, make_message(secret, "x" * 3000)]
    for index in range(MANY):
        source._receive(SimpleNamespace(payload=Payload(sent[index % len(sent)])))
    source._receive(SimpleNamespace())  # not even a payload
    if secret is not None:
        assert not link.stopped.is_set()
        assert source.check.refused >= MANY
    source._receive(SimpleNamespace(payload=Payload(make_message(secret, "fire"))))
    assert link.stopped.is_set()


# Removed, shut off


def seen_to(said, words):
    eventually(lambda: any(words in text for text in said), PATIENCE)


def test_a_socket_that_was_removed_is_put_back(source, link, said):
    source.path.unlink()
    seen_to(said, "removed the stop socket")
    assert answers(source.path.parent) == ["stopped"]


def test_something_in_its_place_is_put_away(source, link, said):
    source.path.unlink()
    source.path.write_text("not a socket")
    seen_to(said, "removed the stop socket")
    assert answers(source.path.parent) == ["stopped"]


def test_a_socket_that_was_shut_off_is_opened_again(source, said):
    source.path.chmod(0o000)
    seen_to(said, "permissions")
    eventually(lambda: source.path.stat().st_mode & 0o777 == 0o600, PATIENCE)


def test_a_folder_that_was_opened_or_removed_is_put_right(stop, link, tmp_path, monkeypatch, said):
    monkeypatch.setenv(estop_local.ONLY_PLACE, str(tmp_path))
    source = SocketSource(stop, say=said.append)
    folder = source.path.parent
    try:
        folder.chmod(0o777)
        seen_to(said, "permissions")
        eventually(lambda: folder.stat().st_mode & 0o777 == 0o700, PATIENCE)
        source.path.unlink()
        folder.rmdir()
        seen_to(said, "removed the stop socket")
        assert answers(None) == ["stopped"]
        source.path.unlink()
        folder.rmdir()
        folder.write_text("in the way")
        seen_to(said, "MAY NOT BE HEARD")
        folder.unlink()
        eventually(folder.is_dir, PATIENCE)
    finally:
        source.close()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="abstract sockets")
def test_senders_of_another_user_are_refused_where_no_folder_keeps_them_out(
    tmp_path, monkeypatch, link, stop
):
    monkeypatch.delenv(estop_local.ONLY_PLACE, raising=False)
    monkeypatch.setattr(estop_socket, "places", lambda: [tmp_path / "mine"])
    monkeypatch.setattr(estop_socket, "_heeded", lambda: {os.getuid() + 1})
    source = SocketSource(stop)
    try:
        address = f"\0crazyarena-estop/{os.getuid()}/{source.name}"
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.bind("")
            sender.settimeout(PATIENCE)
            sender.sendto(b"{}", address)
            assert b"refused" in sender.recv(100)
        assert not link.stopped.is_set()
        with monkeypatch.context() as patch:
            patch.setattr(estop_socket, "_heeded", lambda: {os.getuid()})
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
                sender.sendto(b"{}", address)
            assert link.stopped.wait(PATIENCE)
    finally:
        source.close()


def test_nowhere_at_all_is_bad_input(stop, tmp_path):
    with pytest.raises(InputError, match="XDG_RUNTIME_DIR"):
        SocketSource(stop, tmp_path / "missing")


def test_a_session_that_can_is_asked_to_land_and_does_not_stop(stop, link, tmp_path):
    reasons = []
    source = SocketSource(stop, tmp_path, lambda text: None, reasons.append)
    try:
        assert answers(tmp_path, land=True, reason="wind") == ["landing"]
        assert reasons == ["wind"]
        assert not link.stopped.is_set()
        assert answers(tmp_path)[0].startswith("stopped")
        assert link.stopped.is_set()
    finally:
        source.close()


def test_a_session_without_a_watchdog_says_that_it_cannot_land(source, link, tmp_path):
    assert answers(tmp_path, land=True) == ["refused: nothing here can land it"]
    assert not link.stopped.is_set()


def test_a_listener_that_is_closed_while_it_is_busy_leaves_nothing(
    stop, said, tmp_path, monkeypatch
):
    """Nor does it say that its socket was taken from it."""
    busy, go_on = threading.Event(), threading.Event()
    monkeypatch.setattr(estop_socket, "_LOOK", 0.0)
    monkeypatch.setattr(estop_socket, "_CLOSES", 0.05)
    source = SocketSource(stop, tmp_path, say=said.append)
    confirm = source._confirm

    def late():
        busy.set()
        go_on.wait(PATIENCE)
        confirm()

    source._confirm = late
    assert busy.wait(PATIENCE)
    source.close()
    go_on.set()
    source._thread.join(PATIENCE)
    assert not source._thread.is_alive()
    assert list(tmp_path.iterdir()) == []
    assert said == []
