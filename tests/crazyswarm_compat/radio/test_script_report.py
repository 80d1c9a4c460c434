"""What a script hears over the radio: warnings that name vehicle, command and cause, and the end
of the flight when its vehicle is gone."""

import re
import subprocess
import sys
import threading
import time
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

from crazyarena.clock import VirtualClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.guard import FlightEnded
from crazyarena.crazyswarm_compat.options import CrazyswarmWarning
from crazyarena.crazyswarm_compat.radio import RadioOptions
from crazyarena.crazyswarm_compat.radio.events import LinkLost, LinkUp
from crazyarena.crazyswarm_compat.radio.script_report import ScriptReport
from tests.sim_backend.crtp.virtual_process import virtual_process
from tests.waiting import eventually

FLYING, LOCKED = 1 << 4, 1 << 6


class Script:
    """A report, and everything that it has said so far."""

    def __init__(self, backend, guarded=False):
        self.report = backend.script_report(guarded)
        self.said = []

    def check(self):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                self.report.check()
            finally:
                self.said += [str(w.message) for w in caught if w.category is CrazyswarmWarning]

    def hears(self, pattern):
        def said():
            self.check()
            return any(re.search(pattern, text) for text in self.said)

        eventually(said, 10.0)

    def loses(self, pattern):
        """Hears that the link is lost, and not that it is back: a busy machine may have lost it
        for a moment before."""

        def lost():
            self.check()
            last = [text for text in self.said if re.search("link lost|link is back", text)][-1:]
            return last and re.search(pattern, last[0])

        eventually(lost, 10.0)

    def ends(self, pattern):
        found = []

        def ended():
            try:
                self.check()
            except FlightEnded as end:
                found.append(str(end))
            return found

        eventually(ended, 15.0)
        assert re.search(pattern, found[0])


def scripted(clock=None):
    """A report on a vehicle in flight, what the vehicle tells, and a function for its events."""
    told = SimpleNamespace(supervisor=FLYING, state=None, timestamp=0.0)
    link = SimpleNamespace(
        name="cf1",
        connected=True,
        telemetry=SimpleNamespace(latest=told),
        outbox=SimpleNamespace(locked=False),
    )
    listeners = []
    events = SimpleNamespace(subscribe=listeners.append)
    report = ScriptReport({1: link}, events, clock or VirtualClock(), 60.0)
    return Script(SimpleNamespace(script_report=lambda _: report)), told, listeners[0]


def fly(hangar, backend):
    backend.prepare()
    backend.send(c.Takeoff(0.5, 1.0), 1)
    eventually(lambda: hangar.position(1)[2] > 0.4, 10.0)
    eventually(lambda: backend.telemetry(1).state.position[2] > 0.3, 5.0)
    eventually(lambda: backend.telemetry(1).supervisor & FLYING, 5.0)


class TestCommands:
    def test_a_flight_command_after_an_emergency(self, world):
        hangar, backend = world(fed=False)
        script = Script(backend)
        backend.send(c.Emergency(), 1)
        eventually(lambda: hangar.info() & LOCKED, 5.0)
        backend.send(c.Takeoff(1.0, 1.0), 1)
        script.hears(r"cf1: takeoff: did not happen; emergency stop")
        script.check()  # the script's own stop does not end its flight

    def test_what_the_vehicle_refuses(self, world):
        _, backend = world(fed=False)
        script = Script(backend)
        pieces = np.zeros((1, 33))
        pieces[:, 0] = 1.0
        backend.send(c.UploadTrajectory(200, 0, pieces), 1)
        script.hears(r"cf1: uploadTrajectory: did not happen; .*uploadTrajectory 200: refused")

    def test_a_trajectory_that_nobody_uploaded(self, world):
        _, backend = world(fed=False)
        script = Script(backend)
        backend.send(c.StartTrajectory(3), 1)
        script.hears(r"cf1: startTrajectory: trajectory 3 was not uploaded")
        script.said.clear()
        pieces = np.zeros((1, 33))
        pieces[:, 0] = 1.0
        backend.upload_trajectory(1, 3, 0, pieces)
        backend.send(c.StartTrajectory(3), 1)
        time.sleep(0.3)
        script.check()
        assert not any("not uploaded" in text for text in script.said)

    def test_velocities_for_the_mellinger_controller(self, world):
        _, backend = world(fed=False)
        script = Script(backend)
        backend.send(c.VelocityWorld([0.1, 0.0, 0.0]), 1)
        time.sleep(0.2)
        script.check()
        assert not script.said
        backend.set_param(1, "stabilizer.controller", 2)
        backend.send(c.Stop(), 1)
        backend.send(c.Position([0.0, 0.0, 0.0]), 1)
        for _ in range(5):
            backend.send(c.VelocityWorld([0.1, 0.0, 0.0]), 1)
        script.hears(r"cf1: cmdVelocityWorld: velocities are not followed")
        assert sum("velocities" in text for text in script.said) == 1
        backend.send(c.Hover(0.1, 0.0, 0.0, 0.5), 1)
        script.hears(r"cf1: cmdHover: velocities")

    def test_a_command_after_a_stream_that_was_not_declared_over(self, world):
        hangar, backend = world()
        script = Script(backend)
        fly(hangar, backend)
        backend.send(c.Position([0.0, 0.0, 0.5]), 1)
        backend.send(c.GoTo([0.0, 0.0, 0.6], 0.0, 1.0), 1)
        script.hears(r"cf1: goTo: follows streamed setpoints without notifySetpointsStop")
        script.said.clear()
        backend.send(c.Position([0.0, 0.0, 0.5]), 1)
        backend.send(c.NotifySetpointsStop(), 1)
        backend.send(c.GoTo([0.0, 0.0, 0.6], 0.0, 1.0), 1)
        time.sleep(0.3)
        script.check()
        assert not script.said
        backend.send(c.Position([0.0, 0.0, 0.5]), 1)
        script.hears(r"cf1: no setpoint and no other command came .* held in place")

    def test_a_command_that_never_arrives(self, world):
        hangar, backend = world(options=RadioOptions(link_timeout=5.0), fed=False)
        script = Script(backend)
        hangar.server.cut(4.0)
        backend.send(c.Takeoff(1.0, 1.0), 1)
        script.hears(r"cf1: takeoff: did not happen; not answered after 12 tries")


class TestGone:
    options = RadioOptions(link_timeout=0.4, gone_after=1.0)

    def test_out_of_reach_in_flight(self, world):
        hangar, backend = world(options=self.options)
        script = Script(backend)
        fly(hangar, backend)
        script.check()
        hangar.server.cut(60.0)
        script.loses(r"cf1: link lost \(nothing heard for .*\), in the air")
        script.ends(r"cf1: out of reach for \d\.\d s while it flew")
        script.check()  # once is enough
        assert not script.report.finish()

    def test_a_short_outage_in_flight(self, world):
        hangar, backend = world(options=RadioOptions(link_timeout=0.4, gone_after=5.0))
        script = Script(backend)
        fly(hangar, backend)
        hangar.server.cut(0.8)
        script.hears(r"cf1: link lost")
        script.hears(r"cf1: link is back after \d\.\d s")
        assert script.report.finish()

    def test_lost_on_the_ground_and_then_sent_off(self, world):
        hangar, backend = world(options=self.options, fed=False)
        script = Script(backend)
        eventually(lambda: backend.telemetry(1).supervisor is not None, 5.0)
        hangar.server.cut(60.0)
        script.loses(r"cf1: link lost .* on the ground")
        time.sleep(1.2)
        script.check()
        backend.send(c.Takeoff(1.0, 1.0), 1)
        script.ends(r"cf1: out of reach")

    def test_lost_when_the_script_ends(self, world, capsys):
        hangar, backend = world(options=RadioOptions(link_timeout=0.4, gone_after=60.0))
        script = Script(backend)
        fly(hangar, backend)
        script.check()
        hangar.server.cut(60.0)
        script.loses(r"cf1: link lost")
        assert not script.report.finish()
        assert "cf1: out of reach when the script ended" in capsys.readouterr().err

    def test_locked_by_somebody_else(self, world):
        hangar, backend = world()
        script = Script(backend)
        fly(hangar, backend)
        script.check()
        hangar.fleet.send(c.Emergency(), 0)
        script.ends(r"cf1: has locked itself in flight")

    def test_locked_while_out_of_reach(self, world):
        hangar, backend = world(options=RadioOptions(link_timeout=0.4, gone_after=60.0))
        script = Script(backend)
        fly(hangar, backend)
        script.check()
        hangar.server.cut(1.5)
        hangar.fleet.send(c.Emergency(), 0)
        script.hears(r"cf1: link lost .* in the air")
        script.ends(r"cf1: has locked itself in flight")

    def test_a_lock_that_is_the_first_word_after_an_outage(self):
        script, told, tell = scripted()
        tell(LinkLost(0.0, 1, "nothing heard for 0.4 s"))
        script.check()
        # The link is back and the lock is known before the script looks again.
        told.supervisor = LOCKED
        tell(LinkUp(1.5, 1, 1.5))
        with pytest.raises(FlightEnded, match="cf1: has locked itself in flight"):
            script.check()

    def test_a_lock_that_is_told_after_the_end_of_the_flight(self):
        script, told, _ = scripted()
        script.check()
        told.supervisor = 0
        script.check()
        told.supervisor = LOCKED
        with pytest.raises(FlightEnded, match="cf1: has locked itself in flight"):
            script.check()

    def test_a_vehicle_that_is_back_has_time_to_speak(self):
        clock = VirtualClock()
        script, _, tell = scripted(clock)
        tell(LinkLost(0.0, 1, "nothing heard for 0.4 s"))
        clock.sleep_until(4.0)
        tell(LinkUp(4.0, 1, 4.0))
        script.check()
        clock.sleep_until(7.1)
        with pytest.raises(FlightEnded, match="answers, but tells nothing any more"):
            script.check()

    def test_with_a_guard_it_only_warns(self, world):
        hangar, backend = world(options=self.options)
        script = Script(backend, guarded=True)
        fly(hangar, backend)
        script.check()
        hangar.server.cut(60.0)
        script.hears(r"cf1: out of reach")
        assert script.report.finish()

    def test_restarted_in_flight(self, world):
        hangar, backend = world()
        script = Script(backend)
        fly(hangar, backend)
        script.check()
        hangar.server.reboot()
        script.ends(r"cf1: answers, but tells nothing any more; was it restarted in flight")


@pytest.mark.slow
def test_a_script_whose_vehicle_dies_in_flight_fails(tmp_path):
    (tmp_path / "flight.py").write_text(
        "import sys\n"
        "from pycrazyswarm import Crazyswarm\n"
        "swarm = Crazyswarm('crazyflies: [{id: 1, channel: 80, initialPosition: [0, 0, 0]}]')\n"
        "swarm.allcfs.takeoff(0.8, 1.0)\n"
        "swarm.timeHelper.sleep(2.0)\n"
        "print('flying', flush=True)\n"
        "sys.stdin.readline()\n"
        "swarm.allcfs.land(0.04, 2.0)\n"
        "swarm.timeHelper.sleep(float(sys.argv[1]))\n"
        "print('landed')\n",
        encoding="utf-8",
    )
    for seconds, expected in ((8.0, "FlightEnded: cf1: out of reach"), (2.0, "error: cf1: out of")):
        with virtual_process("--port", "0", "--feed-poses", "100") as vehicle:
            script = subprocess.Popen(
                [sys.executable, "flight.py", str(seconds), "--uri", vehicle.uris[0]],
                cwd=tmp_path,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
            assert "flying\n" in iter(script.stdout.readline, "")
        out, err = script.communicate("\n", timeout=60)
        assert script.returncode == 1, (out, err)
        assert expected in err
        assert "cf1: link lost" in err


def test_threads_end_with_the_backend(world):
    before = {thread.name for thread in threading.enumerate()}
    options = RadioOptions(reconnect=True, reconnect_interval=0.05, link_timeout=0.2)
    hangar, backend = world(options=options, fed=False)
    hangar.server.cut(60.0)
    eventually(lambda: any(t.name.startswith("reconnect") for t in threading.enumerate()), 10.0)
    backend.close()

    def left():
        names = {t.name for t in threading.enumerate()} - before
        return [n for n in names if n.startswith(("reconnect", "send-", "radio-", "events"))]

    # One that is connecting notices at its next look.
    eventually(lambda: not left(), 20.0)
    # cflib's own end by themselves within the second that they wait for packets.
    kinds = ("IncomingPacketHandlerThread", "ParamUpdaterThread")
    eventually(
        lambda: not any(t.name in kinds and t.is_alive() for t in threading.enumerate()), 10.0
    )
