"""Who is believed over zenoh, and who can reach it."""

from __future__ import annotations

import itertools
import os
import re
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.mocap_latency import free_port
from crazyarena.clock import VirtualClock, WallClock
from crazyarena.errors import InputError
from crazyarena.mocap import zenoh_session
from crazyarena.mocap.check import MocapCheck
from crazyarena.mocap.estimator import PoseEstimator
from crazyarena.mocap.events import EventKind
from crazyarena.mocap.pin import PublisherPin
from crazyarena.mocap.pipeline import PosePipeline
from crazyarena.mocap.source import SourceState, SourceStatus
from crazyarena.mocap.wire import PayloadError, decode, encode
from crazyarena.mocap.zenoh_link import ZenohPublisher, ZenohSource
from crazyarena.mocap.zenoh_session import open_session
from crazyarena.secret import read_secret
from crazyarena.types import Pose, PoseFrame
from tests.waiting import eventually

SECRET = b"0123456789abcdef0123456789abcdef"
HERE = {"cf1": Pose(np.array([1.0, 2.0, 3.0]))}


def payload(number: int, run: int, sent: float, secret: bytes | None = None, x: float = 0.0):
    return encode(
        number, sent - 0.005, sent, 99, run, {"cf1": Pose(np.array([x, 0.0, 1.0]))}, None, secret
    )


class Line:
    """A session that sends and a source that listens, on one machine."""

    def __init__(self, **options) -> None:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.session = open_session(listen=[endpoint])
        self.source = ZenohSource(WallClock(), key="trust", connect=[endpoint], **options)
        self.frames: list[PoseFrame] = []

    def meet(self, run: int, secret: bytes | None = None) -> int:
        """Send until a frame has come; return the last number."""
        numbers = itertools.count()
        last = 0

        def came() -> bool:
            nonlocal last
            last = next(numbers)
            self.put(payload(last, run, 1.0 + 0.01 * last, secret))
            return bool(self.take())

        eventually(came)
        return last

    def put(self, data: bytes) -> None:
        self.session.put("trust", data)

    def take(self) -> list[PoseFrame]:
        self.frames += self.source.frames(0.02)
        return self.frames

    def close(self) -> None:
        self.source.close()
        self.session.close()


def test_a_second_publisher_is_an_event_and_is_ignored():
    with closing(Line(release_after=30.0)) as line:
        last = line.meet(run=1)
        eventually(lambda: not line.source.frames(0.05))
        for k in range(1, 20):
            line.put(payload(last + k, 1, 5.0 + 0.01 * k))
            line.put(payload(last + k, 2, 5.0 + 0.01 * k, x=50.0))
        seen: list[PoseFrame] = []
        eventually(lambda: seen.extend(line.source.frames(0.05)) or len(seen) >= 19)
        eventually(lambda: line.source.status.foreign == 19)
        assert all(frame.bodies["cf1"].position[0] == 0.0 for frame in seen)
        assert line.source.status.reconnects == 0
        events = []
        pipeline = PosePipeline(
            line.source, PoseEstimator(["cf1"]), WallClock(), on_event=[events.append]
        )
        pipeline.poll()
        pipeline.poll()
        (event,) = [e for e in events if e.kind is EventKind.FOREIGN_PUBLISHER]
        assert "19 frames" in event.message
        check = MocapCheck()
        check.add(seen[0])
        assert any("another publisher" in p for p in check.report(line.source.status, 1).problems)


@given(st.lists(st.tuples(st.integers(1, 3), st.floats(0.0, 1.0)), max_size=60))
def test_a_publisher_is_released_only_when_it_is_silent(steps):
    pin, now, heard, believed = PublisherPin(0.5), 0.0, {}, None
    for run, pause in steps:
        now += pause
        took = pin.believes(run, now)
        if believed is None or run == believed:
            assert took
        else:
            assert took is (now - heard[believed] >= 0.5)
        if took:
            believed = run
            heard[run] = now


def test_signed_frames_only_are_believed_and_only_once(tmp_path):
    token = tmp_path / "token"
    token.write_bytes(SECRET)
    token.chmod(0o600)
    with closing(Line(token=token)) as line:
        last = line.meet(1, SECRET)
        eventually(lambda: not line.source.frames(0.05))
        before = line.source.status.malformed
        good = payload(last + 10, 1, 50.0, SECRET)
        line.put(payload(last + 1, 1, 20.0))  # not signed
        line.put(payload(last + 2, 1, 21.0, b"another secret of some length"))
        line.put(good[:-1] + bytes([good[-1] ^ 1]))
        line.put(good)
        line.put(good)  # replayed
        line.put(payload(last + 11, 1, 49.0, SECRET))  # older than what was heard
        seen: list[PoseFrame] = []
        eventually(lambda: line.source.status.malformed - before == 5)
        seen.extend(line.source.frames(0.05))
        assert len(seen) == 1
        assert "recording" in (line.source.status.error or "")


def test_publisher_and_source_share_a_token(tmp_path):
    token = tmp_path / "token"
    token.write_bytes(SECRET)
    token.chmod(0o600)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    publisher = ZenohPublisher(WallClock(), key="signed", listen=[endpoint], token=token)
    source = ZenohSource(WallClock(), key="signed", connect=[endpoint], token=token)
    numbers = itertools.count()

    def came() -> bool:
        publisher.publish(PoseFrame(0.0, 0.0, next(numbers), HERE))
        return bool(source.frames(0.02))

    eventually(came)
    assert source.status.malformed == 0
    source.close()
    publisher.close()


@pytest.mark.parametrize(
    ("content", "mode", "words"),
    [
        (None, 0o600, "cannot read"),
        (b"short", 0o600, "need 16 or more"),
        (SECRET, 0o644, "chmod 600"),
    ],
)
def test_a_bad_token_file_is_named(tmp_path, content, mode, words):
    file = tmp_path / "token"
    if content is not None:
        file.write_bytes(content)
        file.chmod(mode)
    with pytest.raises(InputError, match=words) as error:
        read_secret(file)
    assert str(file) in str(error.value)
    with pytest.raises(InputError):
        ZenohSource(WallClock(), token=file)


@given(st.binary(max_size=200), st.integers(0, 10_000))
def test_no_change_of_a_signed_frame_is_believed(garbage, where):
    good = payload(1, 2, 3.0, SECRET)
    assert decode(good, SECRET).frame_id == decode(good).frame_id == 1
    at = where % len(good)
    changed = good[:at] + bytes([good[at] ^ 0x55]) + good[at + 1 :]
    for bad in (changed, good[:at], garbage, good + garbage[:1] + b"x"):
        with pytest.raises(PayloadError):
            decode(bad, SECRET)


def own_sockets() -> set[str]:
    """Local addresses of this process's listening TCP and of its UDP sockets, in hexadecimal."""
    inodes = set()
    for fd in Path("/proc/self/fd").iterdir():
        try:
            found = re.match(r"socket:\[(\d+)\]", os.readlink(fd))
        except OSError:
            continue
        if found:
            inodes.add(found[1])
    addresses = set()
    for kind in ("tcp", "tcp6", "udp", "udp6"):
        for row in Path(f"/proc/self/net/{kind}").read_text().splitlines()[1:]:
            words = row.split()
            listening = words[3] == "0A" or kind.startswith("udp")
            if words[9] in inodes and listening:
                addresses.add(words[1].split(":")[0])
    return addresses


@pytest.mark.skipif(not Path("/proc/self/net/tcp").exists(), reason="needs Linux's /proc")
def test_without_endpoints_nothing_is_heard_from_outside():
    before = own_sockets()
    with closing(open_session()), closing(open_session()):
        assert own_sockets() - before <= {"0100007F"}


def test_programs_of_one_machine_meet_without_endpoints():
    source = ZenohSource(WallClock(), key=f"test/{os.getpid()}/poses")
    publisher = ZenohPublisher(WallClock(), key=f"test/{os.getpid()}/poses")
    numbers = itertools.count()

    def came() -> bool:
        publisher.publish(PoseFrame(0.0, 0.0, next(numbers), HERE))
        return bool(source.frames(0.02))

    eventually(came, 20.0)
    publisher.close()
    source.close()


def test_a_configuration_file_brings_users_and_endpoints(tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    users = tmp_path / "users.txt"
    users.write_text("pilot:secret\n")

    def file(name: str, text: str) -> Path:
        path = tmp_path / name
        path.write_text(text)
        return path

    served = file(
        "server.json5",
        f'{{listen: {{endpoints: ["{endpoint}"]}}, transport: {{auth: {{usrpwd: '
        f'{{user: "base", password: "x", dictionary_file: "{users}"}}}}}}}}',
    )
    flies = file(
        "pilot.json5",
        f'{{connect: {{endpoints: ["{endpoint}"]}}, transport: {{auth: {{usrpwd: '
        '{user: "pilot", password: "secret"}}}}',
    )
    publisher = ZenohPublisher(WallClock(), key="users", config=served)
    known = ZenohSource(WallClock(), key="users", config=flies)
    stranger = ZenohSource(WallClock(), key="users", connect=[endpoint])
    numbers = itertools.count()

    def came() -> bool:
        publisher.publish(PoseFrame(0.0, 0.0, next(numbers), HERE))
        return bool(known.frames(0.02))

    eventually(came)
    for _ in range(20):
        came()
    assert stranger.frames(0.0) == []
    for one in (known, stranger, publisher):
        one.close()


@pytest.mark.parametrize("content", [None, "{", "\x00\xff", "{no_such_field: 1}"])
def test_a_bad_configuration_file_is_one_line_that_names_it(tmp_path, content):
    path = tmp_path / "zenoh.json5"
    if content is not None:
        path.write_bytes(content.encode("latin-1"))
    with pytest.raises(InputError, match=r"zenoh\.json5") as error:
        open_session(config=path)
    assert "\n" not in str(error.value)


def test_a_virtual_clock_has_no_say_in_who_is_believed():
    assert PublisherPin().believes(1, VirtualClock().now())
    with pytest.raises(InputError, match="release_after"):
        PublisherPin(0.0)
    assert SourceStatus(SourceState.LIVE).foreign == 0


def test_the_usual_port_stays_free_and_what_listens_there_is_found(monkeypatch):
    usual = f"tcp/127.0.0.1:{free_port()}"
    monkeypatch.setattr(zenoh_session, "LOCAL", usual)
    key = f"test/{os.getpid()}/usual"
    source = ZenohSource(WallClock(), key=key)
    publisher = ZenohPublisher(WallClock(), key=key, listen=[usual])
    numbers = itertools.count()

    def came() -> bool:
        publisher.publish(PoseFrame(0.0, 0.0, next(numbers), HERE))
        return bool(source.frames(0.02))

    eventually(came, 20.0)
    publisher.close()
    source.close()
