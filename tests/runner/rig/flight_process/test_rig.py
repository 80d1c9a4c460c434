"""The rig of a flight process, on a virtual vehicle that stays on the ground."""

import os
import signal
import time

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.errors import BackendError, CommandError, InputError
from crazyarena.levels import load_level
from crazyarena.mocap.estimator import Freshness
from crazyarena.mocap.opening import SourceSpec
from crazyarena.runner.rig.flight_process.client import connected
from crazyarena.runner.rig.stops import StopOptions
from crazyarena.runner.rig.virtual_arena import VirtualArena
from crazyarena.safety.estop_sources import stop_local
from crazyarena.safety.gate import Refused
from crazyarena.sim_backend.firmware.supervisor import INFO_LOCKED
from tests.runner.flying import is_alive
from tests.waiting import PATIENCE


@pytest.fixture(scope="module")
def level():
    return load_level("sim2real", ["track.gates=[]", "track.obstacles=[]"])


@pytest.fixture(scope="module")
def arena(level, tmp_path_factory):
    with VirtualArena(level, level.seed, tmp_path_factory.mktemp("arena")) as arena:
        yield arena


@pytest.fixture
def rig(level, arena, tmp_path, monkeypatch):
    monkeypatch.setenv("CRAZYARENA_RUNTIME_DIR", str(tmp_path))
    source = SourceSpec("zenoh", {"connect": [arena.endpoint]})
    rig = connected(level, arena.uri, source, real_time=False)
    yield rig
    rig.close()


def let_pass(rig, seconds):
    rig.clock.sleep_until(rig.clock.now() + seconds)


def until(rig, holds, seconds=20.0):
    end = rig.clock.now() + PATIENCE * seconds
    while not holds():
        assert rig.clock.now() < end
        let_pass(rig, 0.02)


def test_what_is_refused_over_there_is_raised_here(rig):
    with pytest.raises(CommandError, match=r"cf1: cmdFullState: pos is") as wrong:
        rig.backend.send(
            cs.FullState((np.nan, 0, 1), (0, 0, 0), (0, 0, 0), 0.0, (0, 0, 0)), rig.vehicle
        )
    assert not isinstance(wrong.value, Refused)
    # The gate over there has said the same, which the next setpoint hears; the one after it flies.
    setpoint = cs.FullState((0, 0, 1), (0, 0, 0), (0, 0, 0), 0.0, (0, 0, 0))
    let_pass(rig, 0.2)
    with pytest.raises(CommandError, match=r"cf1: cmdFullState: pos is"):
        rig.backend.send(setpoint, rig.vehicle)
    with pytest.raises(Refused, match="no such vehicle") as refused:
        rig.backend.send(cs.Takeoff(1.0, 2.0), 7)
    assert type(refused.value) is Refused
    with pytest.raises(BackendError, match=r"nothing\.here"):
        rig.backend.get_param(rig.vehicle, "nothing.here")
    assert rig.backend.get_param(rig.vehicle, "commander.enHighLevel") in (0.0, 1.0)
    assert rig.safeguard.verdict() is None


def test_a_setpoint_is_not_waited_for(rig):
    pid = rig.backend._process.pid
    setpoint = cs.FullState((0, 0, 1), (0, 0, 0), (0, 0, 0), 0.0, (0, 0, 0))
    os.kill(pid, signal.SIGSTOP)
    try:
        before = rig.clock.now()
        rig.backend.send(setpoint, 7)
        # Nobody over there can have answered.
        assert rig.clock.now() - before < 1.0
    finally:
        os.kill(pid, signal.SIGCONT)
    let_pass(rig, 0.2)
    with pytest.raises(Refused, match="cf7: cmdFullState: no such vehicle"):
        rig.backend.send(setpoint, rig.vehicle)
    # A refusal is told once, and only to a setpoint.
    rig.backend.send(setpoint, 7)
    let_pass(rig, 0.2)
    rig.backend.send(cs.Land(0.0, 1.0), rig.vehicle)
    rig.backend.send(setpoint, 7)


def test_no_frame_is_lost_while_the_runner_is_stalled(rig):
    frames = []
    rig.listeners.frames.append(lambda frame, result: frames.append(frame))
    until(rig, lambda: len(frames) > 5)
    stalled = len(frames)
    time.sleep(4.0)
    let_pass(rig, 0.2)
    # Those of the stall, all at once and in order.
    ids = [frame.frame_id for frame in frames]
    assert len(frames) - stalled > 200
    missing = rig.pipeline.source.status.lost
    assert len(ids) - 1 + missing >= ids[-1] - ids[0]
    assert ids == sorted(set(ids))
    # Over there nobody has waited for this: most were received long before the stall was over.
    received = np.array([frame.received for frame in frames])
    captured = np.array([frame.timestamp for frame in frames])
    assert np.median(received - captured) < 1.0
    until(rig, lambda: rig.clock.now() - rig.backend.telemetry(rig.vehicle).timestamp < 1.0)
    until(rig, lambda: rig.pipeline.live)
    seen = (Freshness.FRESH, Freshness.BRIDGED)
    until(rig, lambda: rig.pipeline.estimate(rig.body).freshness in seen)


def test_both_pipelines_agree(rig):
    until(rig, lambda: rig.pipeline.estimate(rig.body).freshness is Freshness.FRESH)
    seen = rig.pipeline.estimate(rig.body)
    assert seen.age < 1.0
    assert abs(float(seen.state.position[2])) < 0.1
    assert rig.pipeline.estimate(rig.body, seen.state.timestamp - 0.01).age < seen.age + 1e-9


def test_a_wrong_source_is_an_input_error(level, arena):
    with pytest.raises(InputError, match="mocap source: found 'sextant'"):
        connected(level, arena.uri, SourceSpec("sextant"), real_time=False)


def test_a_vehicle_that_is_not_there_is_a_backend_error(level, arena):
    with pytest.raises(BackendError, match="19"):
        connected(
            level,
            "udp://127.0.0.1:19",
            SourceSpec("zenoh", {"connect": [arena.endpoint]}),
            real_time=False,
        )


def test_an_orderly_end_leaves_no_process(level, arena):
    source = SourceSpec("zenoh", {"connect": [arena.endpoint]})
    rig = connected(level, arena.uri, source, real_time=False)
    process = rig.backend._process
    rig.close()
    rig.close()
    assert process._process.returncode == 0
    assert not is_alive(process.pid)
    assert rig.lost() is None


def test_a_dead_flight_process_is_noticed_and_told(level, arena, monkeypatch):
    source = SourceSpec("zenoh", {"connect": [arena.endpoint]})
    rig = connected(level, arena.uri, source, real_time=False)
    rig.backend._process._process.kill()
    until(rig, lambda: rig.lost() is not None)
    assert "the flight process ended (SIGKILL)" in rig.safeguard.verdict()
    with pytest.raises(BackendError, match="SIGKILL"):
        rig.backend.send(cs.Stop(), rig.vehicle)
    # It is known to be gone: nobody waits for its answers.
    process = rig.backend._process
    with monkeypatch.context() as patch:
        patch.setattr(process, "listen", lambda timeout=0.0: pytest.fail("waited"))
        assert rig.safeguard.end()
        assert rig.safeguard.events() == []
    begin = rig.clock.now()
    let_pass(rig, 0.1)
    assert rig.clock.now() - begin >= 0.1
    rig.close()


def test_stops_are_pulled_over_there(rig, tmp_path):
    """The last test: the vehicle is locked after it."""
    notes, hold = rig.safeguard.open_stops(StopOptions())
    assert notes == ["crazyarena estop in another shell stops the motors"]
    assert hold is None
    folder = next(tmp_path.glob("crazyarena-*"))
    assert [answer for _, answer in stop_local(test=True, folder=folder)] == ["tested"]
    assert rig.safeguard.verdict() is None
    rig.safeguard.stop("signal", "SIGINT")
    until(rig, lambda: rig.safeguard.verdict() is not None)
    assert "emergency_stop" in rig.safeguard.verdict()
    until(rig, lambda: (rig.backend.telemetry(rig.vehicle).supervisor or 0) & INFO_LOCKED)
