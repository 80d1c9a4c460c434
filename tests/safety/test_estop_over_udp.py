"""Every source of the emergency stop cuts the motors of a virtual vehicle over UDP."""

from __future__ import annotations

import os
import pty
import select
import signal
import socket
import struct
import subprocess
import sys
from types import SimpleNamespace

import pytest

from crazyarena.clock import WallClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.radio import RadioBackend, RadioOptions
from crazyarena.safety.estop import EmergencyStop, interrupt_policy
from crazyarena.safety.estop_sources import (
    GamepadSource,
    KeyboardSource,
    SocketSource,
    ZenohSource,
    stop_over_zenoh,
)
from crazyarena.safety.estop_token import TokenCheck
from tests.crazyswarm_compat.radio.conftest import Hangar, eventually

pytestmark = pytest.mark.slow
SECRET = b"correct horse battery staple"
LOCKED = 1 << 6


@pytest.fixture(scope="module")
def toc(tmp_path_factory):
    return tmp_path_factory.mktemp("toc")


@pytest.fixture
def flying(toc):
    """A vehicle a metre up, its link, and an emergency stop on that link."""
    hangar = Hangar(1, 0)
    backend = RadioBackend(hangar.config(), WallClock(), RadioOptions(cache=toc))
    hangar.feed(backend)
    stop = EmergencyStop([backend], WallClock())
    try:
        eventually(lambda: hangar.info() & (1 << 3))
        backend.send(c.Takeoff(0.6, 1.0), 1)
        eventually(lambda: hangar.position(1)[2] > 0.4, 20.0)
        yield SimpleNamespace(hangar=hangar, backend=backend, stop=stop)
    finally:
        stop.close()
        backend.close()
        hangar.close()


def motors_are_cut(world) -> None:
    eventually(lambda: world.hangar.info() & LOCKED, 10.0)
    eventually(lambda: not world.hangar.fleet.rows(0).motors.any(), 10.0)


def test_keyboard(flying):
    master, slave = pty.openpty()
    source = KeyboardSource(flying.stop, None, slave)
    os.write(master, b" ")
    motors_are_cut(flying)
    source.close()
    os.close(master)
    os.close(slave)


def test_gamepad(flying):
    read, write = os.pipe()

    def events():
        ready, _, _ = select.select([read], [], [], 0)
        if ready:
            kind, code, value = struct.unpack("HHi", os.read(read, 8))
            yield SimpleNamespace(type=kind, code=code, value=value)

    source = GamepadSource(flying.stop, None, SimpleNamespace(fd=read, read=events))
    os.write(write, struct.pack("HHi", 1, 0x131, 1))
    motors_are_cut(flying)
    source.close()


def test_another_shell(flying, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    source = SocketSource(flying.stop)
    result = subprocess.run(
        [sys.executable, "-m", "crazyarena", "estop"], capture_output=True, timeout=60
    )
    assert result.returncode == 0
    motors_are_cut(flying)
    source.close()


def test_zenoh_with_token_and_not_without(flying):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    source = ZenohSource(flying.stop, TokenCheck(SECRET), listen=[endpoint])
    stop_over_zenoh(b"this is not the right secret", "", [endpoint])
    eventually(lambda: source.check.refused > 0)
    assert not flying.hangar.info() & LOCKED
    assert flying.hangar.fleet.rows(0).motors.any()
    stop_over_zenoh(SECRET, "", [endpoint])
    motors_are_cut(flying)
    source.close()


def test_second_interrupt(flying):
    landing = []
    with interrupt_policy(landing.append, flying.stop.trigger):
        os.kill(os.getpid(), signal.SIGINT)
        eventually(lambda: landing)
        assert not flying.hangar.info() & LOCKED
        os.kill(os.getpid(), signal.SIGINT)
        motors_are_cut(flying)


def test_dead_ground_station(flying):
    """Armed and then no longer fed, the vehicle's own watchdog stops it."""
    flying.backend.arm_watchdog(1)
    motors_are_cut(flying)
