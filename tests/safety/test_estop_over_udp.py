"""Every source of the emergency stop cuts the motors of a virtual vehicle over UDP."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pty
import signal
import socket
import subprocess
import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from crazyarena.clock import WallClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.radio import RadioBackend, RadioOptions
from crazyarena.levels import load_level
from crazyarena.mocap.estimator import BodyEstimate, Freshness
from crazyarena.mocap.zenoh_session import open_session
from crazyarena.safety.estop import DeadMan, EmergencyStop, interrupt_policy
from crazyarena.safety.estop_sources import (
    ZENOH_KEY,
    GamepadSource,
    KeyboardSource,
    SocketSource,
    ZenohSource,
    stop_over_zenoh,
)
from crazyarena.safety.estop_token import TokenCheck, make_message
from crazyarena.safety.events import Action
from crazyarena.safety.fence import Fence
from crazyarena.safety.gate import CommandGate
from crazyarena.safety.watchdog import Watchdog
from crazyarena.types import VehicleState
from tests.crazyswarm_compat.radio.conftest import Hangar
from tests.safety.pad import Pad
from tests.waiting import eventually

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
        eventually(lambda: hangar.info() & (1 << 3), 5.0)
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
    pad = Pad()
    source = GamepadSource(flying.stop, None, pad)
    pad.press(0x131, 1)
    motors_are_cut(flying)
    source.close()


def test_another_shell(flying, tmp_path, monkeypatch):
    monkeypatch.setenv("CRAZYARENA_RUNTIME_DIR", str(tmp_path))
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
    eventually(lambda: source.check.refused > 0, 5.0)
    assert not flying.hangar.info() & LOCKED
    assert flying.hangar.fleet.rows(0).motors.any()
    stop_over_zenoh(SECRET, "", [endpoint])
    motors_are_cut(flying)
    source.close()


def test_second_interrupt(flying):
    landing = []
    with interrupt_policy(landing.append, flying.stop.trigger):
        os.kill(os.getpid(), signal.SIGINT)
        eventually(lambda: landing, 5.0)
        assert not flying.hangar.info() & LOCKED
        os.kill(os.getpid(), signal.SIGINT)
        motors_are_cut(flying)


def test_dead_ground_station(flying):
    """Armed and then no longer fed, the vehicle's own watchdog stops it."""
    flying.backend.arm_watchdog(1)
    motors_are_cut(flying)


# Dead-man


@pytest.fixture
def guarded(toc):
    """A vehicle in the air by the runner's command, with a watchdog that sees where it is."""
    hangar = Hangar(1, 0)
    clock = WallClock()
    backend = RadioBackend(hangar.config(), clock, RadioOptions(cache=toc))
    hangar.feed(backend)
    stop = EmergencyStop([backend], clock)
    dead_man = DeadMan(clock)
    fence = Fence.from_level(load_level("sim2real"))
    fastest = 0.0

    def estimate(body):
        nonlocal fastest
        true = hangar.fleet.true_state(0)
        fastest = min(fastest, float(true.velocity[2]))
        state = VehicleState(
            clock.now(), true.position, true.velocity, true.quaternion, np.zeros(3)
        )
        return BodyEstimate(body, state, Freshness.FRESH, 0.0)

    gate = CommandGate(backend, fence, clock)
    watchdog = Watchdog(
        gate, fence, clock, {"cf1": 1}, estimate, feed=backend.arm_watchdog, estop=stop,
        dead_man=dead_man,
    )  # fmt: skip
    world = SimpleNamespace(
        hangar=hangar, gate=gate, watchdog=watchdog, dead_man=dead_man, stop=stop,
        fastest=lambda: fastest,
    )  # fmt: skip
    try:
        eventually(lambda: hangar.info() & (1 << 3), 5.0)
        watchdog.start()
        yield world
    finally:
        watchdog.close()
        stop.close()
        backend.close()
        hangar.close()


@contextlib.contextmanager
def held(press):
    """Presses again and again, as a key that repeats does, until the block ends."""
    let_go = threading.Event()

    def hold():
        while not let_go.wait(0.03):
            press()

    thread = threading.Thread(target=hold)
    thread.start()
    try:
        yield
    finally:
        let_go.set()
        thread.join()


def letting_go_lands(world, holding) -> None:
    with holding:
        eventually(lambda: world.dead_man.age() < 0.3, 5.0)
        world.gate.runner.send(c.Takeoff(0.8, 1.5), 1)
        eventually(lambda: world.hangar.position(1)[2] > 0.6, 20.0)
        assert world.watchdog.action(1) <= Action.WARN
    eventually(lambda: world.watchdog.action(1) is Action.LAND, 10.0)
    assert "dead_man" in [event.rule for event in world.watchdog.events]
    eventually(lambda: world.watchdog.over(1), 20.0)
    # Down with its motors on: cut at this height it would have been at 3.5 m/s.
    assert world.watchdog.action(1) is Action.LAND
    assert world.hangar.position(1)[2] < 0.1
    assert world.fastest() > -1.5
    eventually(lambda: not world.hangar.fleet.rows(0).motors.any(), 10.0)


def test_letting_go_of_the_key_lands(guarded):
    master, slave = pty.openpty()
    source = KeyboardSource(guarded.stop, guarded.dead_man, slave)
    letting_go_lands(guarded, held(lambda: os.write(master, b"h")))
    source.close()
    os.close(master)
    os.close(slave)


def test_letting_go_of_the_button_lands(guarded):
    pad = Pad()

    @contextlib.contextmanager
    def button():
        pad.press(0x136, 1)
        yield
        pad.press(0x136, 0)

    source = GamepadSource(guarded.stop, guarded.dead_man, pad)
    letting_go_lands(guarded, button())
    source.close()


# Load


def spin(stop) -> None:
    while not stop.is_set():
        sum(range(10_000))


def flood(endpoint, stop, secret) -> None:
    """Garbage, and well-formed stops under a wrong secret, as fast as the link takes them."""
    session = open_session([endpoint])
    publisher = session.declare_publisher(ZENOH_KEY)
    forged = make_message(b"this is not the right secret", "forged")
    replies = [b"\xff" * 50, b"{" * 2000, b"x" * 200_000, forged, b"null"]
    while not stop.is_set():
        for payload in replies:
            publisher.put(payload)
    session.close()


def test_a_flood_of_garbage_and_busy_processors_do_not_hold_a_stop_up(flying, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    token = tmp_path / "token"
    token.write_bytes(SECRET)
    token.chmod(0o600)
    source = ZenohSource(flying.stop, TokenCheck(SECRET), listen=[endpoint])
    context = multiprocessing.get_context("spawn")
    enough = context.Event()
    load = [context.Process(target=spin, args=(enough,)) for _ in range(os.cpu_count() or 1)]
    load.append(context.Process(target=flood, args=(endpoint, enough, SECRET)))
    for process in load:
        process.start()
    try:
        eventually(lambda: source.check.refused > 2000, 60.0)
        assert flying.stop.stopped is None
        result = subprocess.run(
            [sys.executable, "-m", "crazyarena", "estop", "--connect", endpoint, "--token",
             str(token), "--reason", "in a flood"],
            env={**os.environ, "CRAZYARENA_RUNTIME_DIR": str(tmp_path)},
            capture_output=True, text=True, timeout=120,
        )  # fmt: skip
        assert result.returncode == 0, result.stdout + result.stderr
        eventually(lambda: flying.stop.stopped is not None, 5.0)
        assert flying.stop.stopped.source == "zenoh"
        assert flying.stop.stopped.reason == "in a flood"
        motors_are_cut(flying)
    finally:
        enough.set()
        for process in load:
            process.join(20.0)
            if process.is_alive():
                process.kill()
                process.join()
        source.close()
