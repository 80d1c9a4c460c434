"""Crazyswarm scripts with the safety on, in simulation and over the virtual radio."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import socket
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import crazyswarm1, crazyswarm2
from crazyarena.crazyswarm_compat.guard import FlightEnded
from crazyarena.crazyswarm_compat.options import CrazyswarmWarning, parse
from crazyarena.errors import CommandError, InputError
from crazyarena.runner.rig.guarded import GuardOptions
from crazyarena.safety.estop_sources import stop_local
from crazyarena.safety.events import Action
from crazyarena.safety.gate import Policy

EXAMPLES = Path(__file__).resolve().parents[3] / "examples" / "crazyswarm"
TWO = """
crazyflies:
- {id: 1, channel: 100, initialPosition: [-1.0, 0, 0]}
- {id: 2, channel: 100, initialPosition: [1.0, 0, 0]}
"""
TWO_2 = """
robots:
  left: {uri: "radio://0/80/2M/E7E7E7E701", initial_position: [-1, 0, 0], type: cf21}
  right: {uri: "radio://0/80/2M/E7E7E7E702", initial_position: [1, 0, 0], type: cf21}
robot_types:
  cf21: {connection: crazyflie}
all: {firmware_params: {stabilizer: {controller: 2}}}
"""
ZERO = np.zeros(3)


@pytest.fixture
def swarm(tmp_path, monkeypatch):
    """Factory of guarded swarms of two vehicles; they are closed in the end."""
    monkeypatch.setenv("CRAZYARENA_RUNTIME_DIR", str(tmp_path))
    made = []

    def make(guard="--guard level0", flags="--sim", yaml=TWO, api=crazyswarm1):
        made.append(api.Crazyswarm(crazyflies_yaml=yaml, args=f"{flags} --vis null {guard}"))
        return made[-1]

    yield make
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CrazyswarmWarning)
        # As with statements would: each gives back the Ctrl-C that it found.
        for swarm in reversed(made):
            swarm.allcfs.close()


@pytest.fixture
def silent(recwarn):
    """Warnings of the safety during the test, as text."""
    return lambda: [str(w.message) for w in recwarn if w.category is CrazyswarmWarning]


def airborne(swarm):
    swarm.allcfs.takeoff(targetHeight=1.0, duration=2.0)
    swarm.timeHelper.sleep(2.5)
    return swarm.allcfs.crazyflies


def interventions(swarm):
    return [
        event
        for event in swarm.allcfs.guard.events
        if event.severity.takes_over or event.rule.startswith("gate_")
    ]


def fly_around(swarm):
    """Every kind of command, and where the vehicles are meanwhile."""
    rows = []
    sleep = swarm.timeHelper.sleep

    def watch(seconds):
        for _ in range(round(seconds / 0.1)):
            sleep(0.1)
            rows.append([cf.position() for cf in cfs])

    cfs = swarm.allcfs.crazyflies
    swarm.allcfs.takeoff(targetHeight=1.0, duration=2.0)
    watch(2.5)
    cfs[0].goTo([-1.0, 1.0, 1.2], 0.5, 2.0)
    cfs[1].goTo([0.0, -0.5, 0.0], 0.0, 2.0, relative=True)
    watch(2.5)
    for step in range(60):
        angle = step / 30
        place = np.array([1.0, -0.5, 1.0]) + 0.4 * np.array([math.sin(angle), 0, 0])
        cfs[1].cmdFullState(place, [0.4 * math.cos(angle), 0, 0], ZERO, 0.0, ZERO)
        watch(0.1)
    cfs[1].notifySetpointsStop()
    swarm.allcfs.goTo([0.3, 0, 0], 0, 2.0)
    watch(2.5)
    swarm.allcfs.land(targetHeight=0.04, duration=2.0)
    watch(2.5)
    return np.array(rows)


def test_flies_as_without_a_guard(swarm, silent):
    guarded = swarm()
    free = swarm(guard="--guard none", flags="--backend sim")
    assert free.allcfs.guard is None
    found, expected = fly_around(guarded), fly_around(free)
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() <= 1e-9
    assert np.ptp(found[:, :, 2]) > 0.9
    guarded.allcfs.close()
    assert not guarded.allcfs.guard.events
    assert not silent()


def test_keepalive_is_fed(swarm):
    guarded = swarm()
    cfs = airborne(guarded)
    # Nobody feeds any more, and time goes on.
    guarded.allcfs.guard._watchdog._feed = None
    guarded.timeHelper.clock.sleep_until(guarded.timeHelper.time() + 2.5)
    assert all(cf.position()[2] < 0.1 for cf in cfs)


@pytest.mark.parametrize("policy", ["clamp", "refuse"])
def test_go_to_outside_the_fence(swarm, policy):
    guarded = swarm(f"--guard level0,policy={policy}")
    cf = airborne(guarded)[0]
    before = cf.position()
    if policy == "clamp":
        with pytest.warns(
            CrazyswarmWarning, match=r"cf1: changed a command: goal .*outside the fence"
        ):
            cf.goTo([-3.5, 0.0, 1.0], 0.0, 3.0)
    else:
        with pytest.raises(CommandError, match=r"cf1: goTo: goal .* outside the fence"):
            cf.goTo([-3.5, 0.0, 1.0], 0.0, 3.0)
    guarded.timeHelper.sleep(12.0)
    reached = cf.position()
    if policy == "clamp":
        assert -3.0 < reached[0] < -2.8
    else:
        assert np.linalg.norm(reached - before) < 0.05
    assert guarded.allcfs.guard._watchdog.action(1) is Action.NONE


def test_stream_at_a_wall_is_held_inside(swarm):
    guarded = swarm()
    cf, other = airborne(guarded)
    furthest, ended = -math.inf, None
    place = cf.position()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CrazyswarmWarning)
        try:
            for _ in range(150):
                place = place + np.array([0.0, 2.0 / 30, 0.0])
                cf.cmdFullState(place, [0, 2.0, 0], ZERO, 0.0, ZERO)
                guarded.timeHelper.sleepForRate(30)
                furthest = max(furthest, cf.position()[1])
        except FlightEnded as error:
            ended = error
        guarded.allcfs.guard.finish()
    assert 2.0 < furthest < 3.05
    assert cf.position()[2] < 0.1
    assert other.position()[2] < 0.1
    assert ended is None or "cf1: the watchdog has taken over" in str(ended)


def test_guards_are_independent(swarm):
    guarded = swarm()
    cf, other = airborne(guarded)
    watchdog = guarded.allcfs.guard._watchdog
    watchdog.request(Action.LAND, "test", 1)
    with (
        pytest.warns(CrazyswarmWarning, match="cf1: LAND: test"),
        pytest.raises(FlightEnded, match="cf1: the watchdog has taken over: test"),
    ):
        guarded.timeHelper.sleep(1.0)
    # A script that goes on: told once, the other vehicle is still its own.
    other.goTo([1.0, 1.0, 1.0], 0.0, 2.0)
    guarded.timeHelper.sleep(8.0)
    with pytest.raises(FlightEnded, match="cf1: the watchdog has taken over"):
        cf.goTo([-1.0, 1.0, 1.0], 0.0, 2.0)
    assert cf.position()[2] < 0.1
    assert np.linalg.norm(other.position() - [1.0, 1.0, 1.0]) < 0.1
    assert watchdog.action(2) is Action.NONE
    with pytest.warns(CrazyswarmWarning, match="script ends while cf2 flies: landing it"):
        guarded.allcfs.close()
    assert other.position()[2] < 0.1


def test_emergency_stop_from_another_shell(swarm):
    guarded = swarm()
    airborne(guarded)
    assert [answer for _, answer in stop_local("smoke", folder=_folder())] == ["stopped"]
    with (
        pytest.warns(CrazyswarmWarning, match="emergency_stop"),
        pytest.raises(FlightEnded, match=r"emergency_stop .*\(shell: smoke\)"),
    ):
        guarded.timeHelper.sleep(1.0)
    guarded.timeHelper.clock.sleep_until(guarded.timeHelper.time() + 1.0)
    assert all(cf.position()[2] < 0.1 for cf in guarded.allcfs.crazyflies)


def _folder():
    return Path(os.environ["CRAZYARENA_RUNTIME_DIR"]) / f"crazyarena-{os.getuid()}"


def test_interrupt_lands(swarm):
    guarded = swarm()
    cfs = airborne(guarded)
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
    with pytest.warns(CrazyswarmWarning, match="LAND: interrupted by SIGINT"):
        guarded.allcfs.close()
    assert all(cf.position()[2] < 0.1 for cf in cfs)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_what_is_taken_cannot_be_flown_but_stopped(swarm):
    guarded = swarm()
    cf = airborne(guarded)[0]
    guarded.allcfs.guard._watchdog.request(Action.HOLD, "test")
    with pytest.warns(CrazyswarmWarning), pytest.raises(FlightEnded):
        guarded.timeHelper.sleep(0.1)
    with pytest.raises(FlightEnded, match="cf1: the watchdog"):
        guarded.allcfs.goTo([0.1, 0, 0], 0, 1.0)
    guarded.allcfs.emergency()
    guarded.timeHelper.clock.sleep_until(guarded.timeHelper.time() + 1.0)
    assert cf.position()[2] < 0.1


def test_groups(swarm):
    guarded = swarm()
    cf, other = guarded.allcfs.crazyflies
    cf.setGroupMask(1)
    other.setGroupMask(2)
    guarded.allcfs.takeoff(targetHeight=1.0, duration=2.0, groupMask=2)
    guarded.timeHelper.sleep(2.5)
    assert cf.position()[2] < 0.1 < 0.9 < other.position()[2]
    gate = guarded.allcfs.guard.gate
    assert gate.flying_since(1) is None
    assert gate.flying_since(2) is not None


def test_crazyswarm2(swarm):
    guarded = swarm(yaml=TWO_2, api=crazyswarm2)
    left, right = airborne(guarded)
    left.goTo([-1.0, 1.0, 1.0], 0.0, 2.0)
    guarded.timeHelper.sleep(2.5)
    assert np.linalg.norm(np.array(left.get_position()) - [-1.0, 1.0, 1.0]) < 0.1
    assert not interventions(guarded)
    assert guarded.allcfs.paramTypeDict["stabilizer.controller"]
    guarded.allcfs.guard._watchdog.request(Action.LAND, "test", 2)
    with pytest.warns(CrazyswarmWarning), pytest.raises(FlightEnded, match="right: the watchdog"):
        guarded.timeHelper.sleepForRate(10)
    with pytest.warns(CrazyswarmWarning, match="left: landed at"):
        guarded.allcfs.close()
    assert right._backend.telemetry(2).state.position[2] < 0.1


def test_controller_decides_the_braking(swarm):
    mellinger = swarm()
    pid = swarm(yaml=TWO_2.replace("controller: 2", "controller: 1"), api=crazyswarm2)
    assert pid.allcfs.guard.gate.limits.braking < mellinger.allcfs.guard.gate.limits.braking
    pid.allcfs.setParam("stabilizer.controller", 1)
    with pytest.raises(CommandError, match=r"set it in the vehicle list"):
        mellinger.allcfs.setParam("stabilizer/controller", 1)


def test_two_vehicles_that_fly_at_each_other_do_not_meet(swarm):
    guarded = swarm()
    left, right = airborne(guarded)
    left.goTo([1.0, 0.0, 1.0], 0.0, 2.5)
    right.goTo([-1.0, 0.0, 1.0], 0.0, 2.5)
    closest = math.inf
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CrazyswarmWarning)
        for _ in range(300):
            with contextlib.suppress(FlightEnded):
                guarded.timeHelper.sleep(0.01)
            closest = min(closest, math.dist(left.position(), right.position()))
    rules = {e.rule for e in guarded.allcfs.guard.events if e.severity.takes_over}
    assert "neighbour_predicted" in rules
    assert closest > 0.15
    assert not guarded.allcfs.contacts


@pytest.mark.parametrize("aside", [0.0, 0.15])
def test_one_taken_above_another_lands_beside_it(swarm, aside):
    """One hovers above, one takes off below: both are held, and are to land at the same time."""
    two = swarm()
    guard = two.allcfs.guard
    places = []

    def see(now):
        states = [guard._link.telemetry(vehicle).state for vehicle in guard.vehicles]
        places.append([np.asarray(state.position) for state in states])

    above, under = two.allcfs.crazyflies
    above.takeoff(targetHeight=0.8, duration=2.0)
    two.timeHelper.sleep(2.5)
    above.goTo([1.0, aside, 0.8], 0.0, 3.0)
    two.timeHelper.sleep(3.5)
    guard._clock.on_advance(see)
    with contextlib.suppress(FlightEnded, CommandError):
        under.takeoff(targetHeight=1.0, duration=2.5)
        two.timeHelper.sleep(3.0)
    end = guard._clock.now() + 8.0
    while guard._clock.now() < end:
        guard._clock.sleep_until(guard._clock.now() + 0.01)
    assert any(event.rule == "neighbour_predicted" for event in guard.events)
    assert min(np.linalg.norm(a - b) for a, b in places) > 0.15
    first, second = places[-1]
    assert max(first[2], second[2]) < 0.1
    assert np.linalg.norm(first - second) > 0.25


# How it is asked for


@pytest.mark.parametrize(
    ("text", "field", "value"),
    [
        ("level0", "policy", Policy.CLAMP),
        ("level0,policy=refuse", "policy", Policy.REFUSE),
        ("level0, seed=7", "seed", 7),
        ("level0,setpoint_speed=1.5", "limits", {"setpoint_speed": 1.5}),
        ("level0,allow_attitude=true", "limits", {"allow_attitude": True}),
    ],
)
def test_options(text, field, value):
    options = GuardOptions.parse(text)
    assert options.arena == "level0"
    assert getattr(options, field) == value


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("level0,policy=shrug", "--guard: policy: found 'shrug'; expected clamp or refuse"),
        ("level0,seed=x", "--guard: seed: found 'x'; expected a whole number"),
        ("level0,allow_attitude=1", "allow_attitude: found '1'; expected true or false"),
        ("level0,speed=1", "found 'speed=1'; expected policy=, seed= or a safety limit"),
        ("level0,braking=-1", "safety limit braking: found -1"),
        ("nowhere", "nowhere: no such level file"),
    ],
)
def test_wrong_options(swarm, text, message):
    with pytest.raises(InputError, match=message):
        swarm(f"--guard {text}")


def test_flags():
    assert parse("--sim --guard level0", None).backend == "sim"
    assert parse("--sim", None).guard is None
    with pytest.raises(InputError, match="--guard: perfect tracking has no dynamics"):
        parse("--backend ideal --guard level0", None)
    with pytest.raises(InputError, match="add --mocap"):
        parse("--guard level0", None)


def test_environment(swarm, monkeypatch):
    monkeypatch.setenv("CRAZYARENA_GUARD", "level1")
    assert swarm(guard="").allcfs.guard is not None
    assert swarm(guard="--guard none").allcfs.guard is None


def test_vehicle_list_and_a_file_with_nothing_but_an_arena(swarm, tmp_path):
    (tmp_path / "net.yaml").write_text("arena: {low: [-2, -2, -0.1], high: [2, 2, 1.5]}\n")
    path = tmp_path / "crazyflies.yaml"
    path.write_text("guard: net.yaml,seed=3\n" + TWO)
    guarded = swarm(guard="", yaml=path)
    assert guarded.allcfs.guard.fence.bounds == ((-2.0, -2.0, -0.1), (2.0, 2.0, 1.5))
    path.write_text("guard: level0\n" + TWO_2)
    assert swarm(guard="", yaml=path, api=crazyswarm2).allcfs.guard.fence.bounds[1] == (3, 3, 2)
    (tmp_path / "net.yaml").write_text("arena: {low: [0, -2, -0.1], high: [2, 2, 1.5]}\n")
    with pytest.raises(InputError, match=r"cf1 starts at .*1\.00 m outside"):
        swarm(f"--guard {tmp_path / 'net.yaml'}")
    (tmp_path / "net.yaml").write_text("arena: {low: [0, 0, 0], high: [2, 2, text]}\n")
    with pytest.raises(InputError, match=r"net\.yaml.*arena\.high"):
        swarm(f"--guard {tmp_path / 'net.yaml'}")


VIRTUAL = """
crazyflies:
- {id: 1, channel: 80, initialPosition: [0, 0, 0]}
"""
HOVER = """\
from pycrazyswarm import Crazyswarm
swarm = Crazyswarm()
cf = swarm.allcfs.crazyflies[0]
cf.takeoff(targetHeight=0.6, duration=1.5)
swarm.timeHelper.sleep(2.0)
cf.goTo([0.4, 0, 0.6], 0, 1.5)
swarm.timeHelper.sleep(2.0)
print("at", *cf.position(), len(swarm.allcfs.guard.events), flush=True)
swarm.timeHelper.sleep(30.0)
"""


@pytest.mark.slow
@pytest.mark.realtime
def test_interrupt_lands_over_the_radio(tmp_path):
    (tmp_path / "crazyflies.yaml").write_text(VIRTUAL)
    (tmp_path / "script.py").write_text(HOVER)
    port, zenoh = free_port(socket.SOCK_DGRAM), f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    arena = [sys.executable, "-m", "crazyarena", "virtual-cf", "--camera-noise"]
    arena += ["--port", str(port), "--mocap-endpoint", zenoh]
    script = [sys.executable, "script.py", "--guard", "level0", "--uri", f"udp://127.0.0.1:{port}"]
    script += ["--mocap", f"zenoh:{zenoh}", "--crazyflies-yaml", "crazyflies.yaml"]
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(arena, **pipes) as vehicle:
        try:
            assert vehicle.stdout.readline().startswith("udp://")
            with subprocess.Popen(script, cwd=tmp_path, stderr=subprocess.PIPE, **pipes) as flight:
                lines = iter(flight.stdout.readline, "")
                line = next((line for line in lines if line.startswith("at ")), None)
                flight.send_signal(signal.SIGINT)
                _, errors = flight.communicate(timeout=60)
        finally:
            vehicle.send_signal(signal.SIGINT)
    assert line is not None, errors
    *place, alarms = map(float, line.split()[1:])
    assert np.linalg.norm(np.array(place) - [0.4, 0.0, 0.6]) < 0.1
    assert alarms == 0
    assert flight.returncode != 0
    assert "cf1: LAND: interrupted by SIGINT" in errors
    assert "cf1: landed at (0.4" in errors


def free_port(kind):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


SCRIPT = """\
from crazyarena.safety.events import Action
from pycrazyswarm import Crazyswarm
swarm = Crazyswarm()
cf = swarm.allcfs.crazyflies[0]
cf.takeoff(targetHeight=1.0, duration=2.0)
swarm.timeHelper.sleep(2.5)
swarm.allcfs.guard._watchdog.request(Action.HOLD, "test", 1)
swarm.timeHelper.sleep(30.0)
print("not reached")
"""


def test_takeover_ends_the_script_with_the_vehicle_landed(tmp_path):
    (tmp_path / "crazyflies.yaml").write_text(TWO)
    (tmp_path / "script.py").write_text(SCRIPT)
    command = [sys.executable, "script.py", "--sim", "--vis", "null", "--guard", "level0"]
    done = subprocess.run(
        [*command, "--crazyflies-yaml", "crazyflies.yaml"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 1
    assert "not reached" not in done.stdout
    assert "FlightEnded: cf1: the watchdog has taken over: test" in done.stderr
    assert "cf1: landed at (-1.0" in done.stderr


@pytest.mark.parametrize(
    "name",
    [
        "swap",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("circle", "hover", "figure8", "gates")),
    ],
)
def test_examples_raise_no_alarm(name):
    flags = ["--sim", "--vis", "null", "--guard", "level0"]
    done = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", str(EXAMPLES / f"{name}.py"), *flags],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
