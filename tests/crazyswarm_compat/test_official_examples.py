"""What the examples of Crazyswarm 1 and 2 do, by name, in our words: on perfect tracking, with
firmware and dynamics, and over the radio link (UDP)."""

from __future__ import annotations

import subprocess
import sys
from textwrap import dedent

import numpy as np
import pytest

from tests.sim_backend.crtp.virtual_process import virtual_process

LIST_1 = """
crazyflies:
- {id: 1, channel: 80, type: default, initialPosition: [0, 0, 0]%s}
- {id: 2, channel: 80, type: default, initialPosition: [0, 0.5, 0]%s}
"""
LIST_2 = """
robots:
  cf1: {uri: "radio://0/80/2M/E7E7E7E701", initial_position: [0, 0, 0], type: cf21}
  cf2: {uri: "radio://0/80/2M/E7E7E7E702", initial_position: [0, 0.5, 0], type: cf21}
robot_types:
  cf21: {connection: crazyflie}
all:
  firmware_params: {stabilizer: {estimator: 2, controller: 2}, locSrv: {extQuatStdDev: 0.05}}
"""
CIRCLE = """
def circle(pieces=4, radius=0.3, period=4.0):
    # Taylor pieces of (r cos wt - r, r sin wt), which begin and end at the origin.
    from math import cos, sin, pi, factorial
    from uav_trajectory import Polynomial4D, Trajectory
    w, T = 2 * pi / period, period / pieces
    out = Trajectory()
    for k in range(pieces):
        a = w * k * T
        px = [radius * cos(a + j * pi / 2) * w**j / factorial(j) for j in range(8)]
        py = [radius * sin(a + j * pi / 2) * w**j / factorial(j) for j in range(8)]
        px[0] -= radius
        flat = np.zeros(8)
        out.polynomials.append(Polynomial4D(T, np.array(px), np.array(py), flat, flat))
    out.duration = period
    return out
"""
PROLOGUE_1 = """
import numpy as np
from pycrazyswarm import *
swarm = Crazyswarm(crazyflies_yaml="crazyflies.yaml")
th, allcfs = swarm.timeHelper, swarm.allcfs
cfs = allcfs.crazyflies
cf = cfs[0]
where = lambda c: c.position()
"""
PROLOGUE_2 = """
import numpy as np
from crazyflie_py import Crazyswarm
swarm = Crazyswarm()
th, allcfs = swarm.timeHelper, swarm.allcfs
cfs = allcfs.crazyflies
cf = cfs[0]
where = lambda c: np.array(c.position)
"""
EPILOGUE = """
for c in cfs:
    print("at", *where(c))
allcfs.land(targetHeight=0.02, duration=1.5)
th.sleep(2.0)
for c in cfs:
    print("down", *where(c))
"""
TAKEOFF = """
allcfs.takeoff(targetHeight=0.6, duration=1.5)
th.sleep(2.0)
"""
SQUARE = """
for c in cfs:
    c.goTo(np.array(c.initialPosition) + np.array([0.3, 0, 0.6]), 0, 1.5)
th.sleep(2.0)
"""
FIGURE = """
for c in cfs:
    c.uploadTrajectory(0, 0, circle())
th.sleep(0.5)
allcfs.startTrajectory(0, timescale=1.0)
th.sleep(4.6)
"""
HOME = ([0, 0, 0.6], [0, 0.5, 0.6])
AWAY = ([0.3, 0, 0.6], [0.3, 0.5, 0.6])
ONE = ([0, 0, 0.6], [0, 0.5, 0.0])

# Name, script, where the vehicles are before they land.
EXAMPLES_1 = {
    "hello_world": ("cf.takeoff(targetHeight=0.6, duration=1.5)\nth.sleep(2.0)\n", ONE),
    "niceHover": (TAKEOFF + SQUARE, AWAY),
    "figure8_csv": (TAKEOFF + FIGURE, HOME),
    "groupMask": (
        dedent("""
        cfs[0].setGroupMask(1)
        cfs[1].setGroupMask(2)
        th.sleep(0.3)
        allcfs.takeoff(targetHeight=0.6, duration=1.5, groupMask=1)
        th.sleep(2.0)
        """),
        ONE,
    ),
    "cmdVelocityCircle": (
        TAKEOFF
        + dedent("""
        start = th.time()
        while (t := th.time() - start) < 4.0:
            w = 2 * np.pi / 4.0
            for c in cfs:
                c.cmdVelocityWorld(0.2 * np.array([np.cos(w * t), np.sin(w * t), 0]), 0)
            th.sleepForRate(20)
        for c in cfs:
            c.notifySetpointsStop()
            c.goTo(np.array(c.initialPosition) + np.array([0, 0, 0.6]), 0, 1.5)
        th.sleep(2.0)
        """),
        HOME,
    ),
    "setParam": (
        'allcfs.setParam("no/such", 3)\nallcfs.setParam("ring/effect", 7)\n' + TAKEOFF
        + 'for c in cfs:\n    c.setLEDColor(1, 0, 0)\n'
        + 'th.sleep(0.5)\nassert cf.getParam("ring/effect") == 7\n',
        HOME,
    ),
}  # fmt: skip
EXAMPLES_2 = {
    "hello_world": ("cf.takeoff(targetHeight=0.6, duration=1.5)\nth.sleep(2.0)\n", ONE),
    "nice_hover": (TAKEOFF + SQUARE, AWAY),
    "figure8": (
        'allcfs.setParam("commander.enHighLevel", 1)\nallcfs.setParam("no.such", 1)\n'
        + TAKEOFF + FIGURE,
        HOME,
    ),
    "multi_trajectory": (
        TAKEOFF
        + dedent("""
        for k, c in enumerate(cfs):
            c.uploadTrajectory(0, 0, circle(pieces=4 + k))
        th.sleep(0.5)
        allcfs.startTrajectory(0, timescale=1.0)
        th.sleep(4.6)
        """),
        HOME,
    ),
    "arming": ("for c in cfs:\n    c.arm(True)\nth.sleep(0.5)\n" + TAKEOFF, HOME),
    "cmd_full_state": (
        TAKEOFF
        + dedent("""
        figure, start = circle(), th.time()
        while (t := th.time() - start) < figure.duration:
            e = figure.eval(t)
            for c in cfs:
                place = e.pos + np.array(c.initialPosition) + np.array([0, 0, 0.6])
                c.cmdFullState(place, e.vel, e.acc, e.yaw, e.omega)
            th.sleepForRate(30)
        for c in cfs:
            c.notifySetpointsStop()
            c.goTo(np.array(c.initialPosition) + np.array([0, 0, 0.6]), 0, 1.5)
        th.sleep(2.0)
        """),
        HOME,
    ),
    "infinite_flight": (
        TAKEOFF
        + dedent("""
        laps = 0
        while laps < 2:
            assert cf.get_status()["pm_state"] in (0, 1, 2), cf.get_status()
            assert cf.get_status()["battery"] > 3.3 and cf.get_status()["supervisor"] & 16
            assert abs(cf.get_pose()["position"].z - 0.6) < 0.1
            laps += 1
            th.sleep(0.5)
        """),
        HOME,
    ),
}  # fmt: skip
# Unknown parameters, and Mellinger told to follow velocities: known, and said.
PID = ", firmwareParams: {stabilizer: {controller: 1}}"


def fly(folder, generation, name, *flags):
    body, expected = (EXAMPLES_1 if generation == 1 else EXAMPLES_2)[name]
    pid = PID if name == "cmdVelocityCircle" else ""
    text = LIST_1 % (pid, pid) if generation == 1 else LIST_2
    (folder / "crazyflies.yaml").write_text(text, encoding="utf-8")
    parts = [PROLOGUE_1 if generation == 1 else PROLOGUE_2, CIRCLE, body, EPILOGUE]
    (folder / f"{name}.py").write_text("\n".join(parts), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, f"{name}.py", "--vis", "null", *flags],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=200,
        stdin=subprocess.DEVNULL,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = {
        word: np.array(
            [line.split()[1:] for line in done.stdout.splitlines() if line.startswith(word + " ")],
            dtype=float,
        )
        for word in ("at", "down")
    }
    np.testing.assert_allclose(found["at"], expected, atol=0.12)
    assert found["down"][:, 2].max() < 0.1
    for line in done.stderr.splitlines():
        if "CrazyswarmWarning" in line:
            assert "no parameter 'no.such'" in line or "no --mocap" in line, done.stderr


ALL = [(1, name) for name in EXAMPLES_1] + [(2, name) for name in EXAMPLES_2]


@pytest.mark.parametrize("backend", ["ideal", "sim"])
@pytest.mark.parametrize(("generation", "name"), ALL)
def test_in_simulation(tmp_path, generation, name, backend):
    fly(tmp_path, generation, name, "--backend", backend)


@pytest.fixture
def uris():
    with virtual_process("--port", "0", "--count", "2", "--feed-poses", "100") as vehicles:
        yield ",".join(vehicles.uris)


@pytest.mark.slow
@pytest.mark.parametrize(("generation", "name"), ALL)
def test_over_the_radio(tmp_path, uris, generation, name):
    fly(tmp_path, generation, name, "--uri", uris)
