"""Every line of the checklist turns red for its own reason, and only by name is it waived."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from crazyarena.clock import VirtualClock
from crazyarena.errors import BackendError, InputError
from crazyarena.levels import load_level
from crazyarena.mocap.estimator import BodyEstimate, Freshness
from crazyarena.mocap.frames import pose_to_y_up
from crazyarena.runner.rig.flight_model import foretold
from crazyarena.safety import preflight as pf
from crazyarena.safety import tipping
from crazyarena.safety.estop import EmergencyStop
from crazyarena.safety.rehearsal import Rehearsals
from crazyarena.sim_backend.vehicles import load_vehicle
from crazyarena.sim_backend.vehicles.hover import mellinger_hover
from crazyarena.types import Pose, Telemetry, VehicleState

LEVEL = load_level("sim2real")
START = np.array(LEVEL.start.position)
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
READY = 1 << 0 | 1 << 1 | 1 << 3


def turned(yaw: float = 0.0, roll: float = 0.0) -> np.ndarray:
    if roll:
        return np.array([math.sin(roll / 2), 0.0, 0.0, math.cos(roll / 2)])
    return np.array([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)])


def state(position=START, quaternion=UPRIGHT) -> VehicleState:
    return VehicleState(10.0, np.array(position), np.zeros(3), quaternion, np.zeros(3))


def seen(freshness=Freshness.FRESH, **kwargs) -> BodyEstimate:
    return BodyEstimate("cf1", state(**kwargs), freshness, 0.01)


def ready() -> pf.Preflight:
    clock = VirtualClock()
    clock.sleep_until(10.0)
    estop = EmergencyStop([], clock)
    estop.tested()
    telemetry = Telemetry(9.9, 4.1, 1.0, -40.0, READY, state())
    vehicle = pf.VehicleFacts("cf1", "cf1", telemetry, seen(), [START] * 20, 2, "cf1")
    gates = {
        i: Pose(np.array(gate.centre), turned(gate.yaw)) for i, gate in enumerate(LEVEL.track.gates)
    }
    return pf.Preflight(
        LEVEL, [vehicle], gates, ["cf1", "gate0"], ["gate0"], estop=estop, clock=clock
    )


def red(p: pf.Preflight) -> list[str]:
    machine = {"cpu governor", "real-time scheduling", "timer"}
    return [line.name for line in p.run() if not line.ok and line.name not in machine]


def vehicle(p: pf.Preflight, **changes) -> pf.Preflight:
    p.vehicles = [replace(p.vehicles[0], **changes)]
    return p


def telemetry(p: pf.Preflight, **changes) -> pf.Preflight:
    return vehicle(p, telemetry=replace(p.vehicles[0].telemetry, **changes))


@pytest.mark.parametrize(
    ("fields", "params", "words"),
    [
        ([], {}, None),
        (["body.mass=0.0379"], {}, "set ctrlMel.mass to 0.0392"),
        (["rotors.strength=[0.8, 0.8, 0.8, 0.8]"], {}, "or ctrlMel.massThrust to 187"),
        (["body.mass=0.0379", "firmware.params={ctrlMel.mass: 0.039}"], {}, None),
        # What the vehicle itself has counts, where its file does not set it.
        (["firmware.params={}"], {"ctrlMel.mass": 0.024}, "set ctrlMel.mass"),
        (["firmware.params={}"], {"ctrlMel.mass": 0.033}, None),
        (["rotors.strength=[0.6, 0.6, 0.6, 0.6]"], {}, "make it lighter"),
    ],
)
def test_a_vehicle_that_hovers_low_is_told_what_to_set(fields, params, words):
    def parameter(name):
        if name not in params:
            raise BackendError(f"no {name}")
        return params[name]

    facts = foretold(load_vehicle("cf21plus", fields), 2, parameter)
    p = vehicle(ready(), model=facts)
    assert red(p) == ([] if words is None else ["cf1 model"])
    (line,) = [line for line in p.run() if line.name == "cf1 model"]
    assert "cf21plus: lifts" in line.found
    if words is not None:
        assert words in line.remedy
        if "ctrlMel.mass" in words:
            low = facts.flies.low
            assert f"{100 * abs(low):.0f} cm {'below' if low > 0 else 'above'}" in line.found
        for value in ("mass", "massThrust"):
            right = {f"ctrlMel.{value}": facts.mass if value == "mass" else facts.mass_thrust}
            told = {**params, **load_vehicle("cf21plus", fields).firmware.params, **right}
            assert abs(mellinger_hover(load_vehicle("cf21plus", fields), told).low) < 1e-3


def test_under_the_pid_height_is_kept():
    heavy = load_vehicle("cf21plus", ["body.mass=0.0379"])
    assert red(vehicle(ready(), model=foretold(heavy, 1, lambda name: math.nan))) == []


def test_everything_in_order_is_green():
    assert red(ready()) == []


def test_a_y_up_stream_is_named_with_its_remedy():
    p = ready()
    p.poses = {"cf1": Pose(START, turned())}
    assert red(p) == []
    p.poses = {"cf1": pose_to_y_up(Pose(START, turned(0.4)))}
    assert red(p) == ["world axes"]
    (line,) = [line for line in p.run() if line.name == "world axes"]
    assert "y-up" in line.found
    assert "axes=y-up" in line.remedy
    assert pf.may_fly(pf.Line(x.name, True, "") for x in p.run(["world axes"]) if x.waived)


@pytest.mark.parametrize(
    ("spoil", "line"),
    [
        (lambda p: telemetry(p, timestamp=5.0), "cf1 connected"),
        (lambda p: telemetry(p, supervisor=None), "cf1 state"),
        (lambda p: telemetry(p, supervisor=READY | 1 << 5), "cf1 state"),
        (lambda p: telemetry(p, supervisor=READY | 1 << 6), "cf1 state"),
        (lambda p: telemetry(p, supervisor=0), "cf1 state"),
        (lambda p: telemetry(p, battery=3.7), "cf1 battery"),
        (lambda p: telemetry(p, battery=None), "cf1 battery"),
        (lambda p: vehicle(p, own=[START, START + 0.05]), "cf1 estimator"),
        (lambda p: telemetry(p, state=state(START + 0.1)), "cf1 agrees with cameras"),
        (
            lambda p: telemetry(p, state=state(quaternion=turned(0.3))),
            "cf1 agrees with cameras",
        ),
        (lambda p: vehicle(p, controller=1), "cf1 controller"),
        (lambda p: vehicle(p, controller=None), "cf1 controller"),
        (lambda p: vehicle(p, tipped=None), "cf1 is body cf1"),
        (lambda p: vehicle(p, tipped="cf2"), "cf1 is body cf1"),
    ],
)
def test_one_line_turns_red(spoil, line):
    assert red(spoil(ready())) == [line]


def test_away_from_the_start_or_unseen():
    away = START + np.array([0.2, 0.0, 0.0])
    p = telemetry(ready(), state=state(away))
    assert red(vehicle(p, seen=seen(position=away))) == ["cf1 at start"]
    high = START + np.array([0.0, 0.0, 0.1])
    p = telemetry(ready(), state=state(high))
    assert red(vehicle(p, seen=seen(position=high))) == ["cf1 at start"]
    lost = vehicle(ready(), seen=seen(Freshness.STALE))
    assert red(lost) == ["cf1 agrees with cameras", "cf1 at start"]


def test_gates_strangers_disk_estop_and_no_vehicle():
    p = ready()
    del p.gates[2]
    assert red(p) == ["gates"]
    p = ready()
    p.gates[1] = Pose(p.gates[1].position + np.array([1.0, 0.0, 0.0]), p.gates[1].quaternion)
    assert red(p) == ["gates"]
    p = ready()
    p.gates[1] = Pose(p.gates[1].position, turned(LEVEL.track.gates[1].yaw + 0.8))
    assert red(p) == ["gates"]
    p = ready()
    p.gates[1] = Pose(p.gates[1].position, turned(LEVEL.track.gates[1].yaw + math.pi))
    assert red(p) == []
    p = ready()
    p.bodies = ["cf1", "gate0", "person"]
    assert red(p) == ["arena clear"]
    p = ready()
    p.tolerances = pf.Tolerances(disk=1 << 70)
    assert red(p) == ["disk"]
    p = ready()
    p.estop = EmergencyStop([], p.clock)
    assert red(p) == ["e-stop tested"]
    p = ready()
    p.estop.last_test = -5000.0
    assert red(p) == ["e-stop tested"]
    p = ready()
    p.vehicles, p.bodies = [], []
    assert red(p) == ["vehicles"]


def test_contradictory_fence_is_a_red_line():
    p = ready()
    zone = "{name: x, shape: {kind: box, low: [-2, -3, 0], high: [0, -2, 1]}}"
    p.level = load_level("sim2real", [f"arena.keep_out=[{zone}]"])
    assert red(p) == ["fence"]


def test_red_lines_ground_unless_waived_by_name():
    p = telemetry(ready(), battery=3.7)
    p.tolerances = replace(p.tolerances, timer=math.inf)
    assert not pf.may_fly(p.run())
    lines = p.run(["cf1 battery", "cpu governor", "real-time scheduling"])
    assert pf.may_fly(lines)
    (battery,) = [line for line in lines if line.name == "cf1 battery"]
    assert battery.waived
    assert not battery.ok
    assert battery.remedy
    with pytest.raises(InputError, match="cf9 battery"):
        p.run(["cf9 battery"])


def test_a_green_line_is_not_marked_as_waived():
    (line,) = [one for one in ready().run(["disk"]) if one.name == "disk"]
    assert line.ok
    assert not line.waived


def test_slow_governor_and_late_timer(tmp_path: Path):
    folder = tmp_path / "cpu0" / "cpufreq"
    folder.mkdir(parents=True)
    (folder / "scaling_governor").write_text("powersave\n")
    (line,) = pf._governor(ready(), tmp_path)
    assert not line.ok

    class LateClock(VirtualClock):
        def sleep_until(self, deadline: float) -> float:
            super().sleep_until(deadline)
            return 0.01

    p = ready()
    p.clock = LateClock()
    (line,) = pf._timer(p)
    assert not line.ok


def test_tipping_names_the_body():
    bodies = {"cf1": Pose(START, turned(roll=0.5)), "cf2": Pose(START + 1, UPRIGHT)}
    assert tipping.tipped_body(bodies, turned(roll=0.45)) == "cf1"
    assert tipping.tipped_body(bodies, UPRIGHT) is None
    bodies["cf2"] = Pose(START, turned(roll=0.5))
    assert tipping.tipped_body(bodies, turned(roll=0.45)) is None


angles = st.floats(-math.pi, math.pi)


@given(angles, angles, angles, st.floats(0.25, 1.2), angles)
def test_tipping_tells_between_the_noses(nose, own_yaw, true_yaw, size, direction):
    axis = [math.cos(direction), math.sin(direction), 0.0]
    tipped = Rotation.from_rotvec(size * np.array(axis))
    own = Rotation.from_euler("z", own_yaw) * tipped
    body = Rotation.from_euler("z", true_yaw) * tipped * Rotation.from_euler("z", nose)
    found = tipping.nose_between(own.as_quat(), body.as_quat())
    assert abs(math.remainder(found - nose, math.tau)) < 1e-6


def test_a_turned_body_grounds_and_says_how_to_turn_it():
    p = ready()
    p.vehicles[0].turned = math.radians(9.0)
    assert red(p) == []
    p.vehicles[0].turned = math.radians(-90.0)
    assert red(p) == ["cf1 heading"]
    (line,) = [line for line in p.run() if line.name == "cf1 heading"]
    assert "-90 deg" in line.found
    assert "by +90 deg about z" in line.remedy


def test_rehearsals_remember_the_nose(tmp_path):
    rehearsals = Rehearsals(tmp_path, lambda: 100.0)
    rehearsals.note_body("a", "cf1", 0.3)
    assert rehearsals.turned("a") == 0.3
    rehearsals.note_body("b", "cf2")
    assert rehearsals.turned("b") is None
    assert rehearsals.turned("c") is None
    assert rehearsals.body("a") == ("cf1", 0.0)


def test_slow_cameras_ground():
    p = ready()
    p.camera_rate = 100.0
    assert red(p) == []
    p.camera_rate = 10.0
    assert red(p) == ["camera rate"]


def test_a_mirrored_world_is_named():
    p = ready()
    p.gates = {
        k: Pose(pose.position * [1.0, -1.0, 1.0], pose.quaternion) for k, pose in p.gates.items()
    }
    (line,) = [line for line in p.run() if line.name == "gates"]
    assert not line.ok
    assert "mirrored" in line.remedy
    p = vehicle(telemetry(ready(), state=state(START)), seen=seen(position=START[[1, 0, 2]]))
    (line,) = [line for line in p.run() if line.name == "cf1 at start"]
    assert not line.ok
    assert "their y, x, z" in line.remedy


def test_a_vehicle_that_stands_and_is_seen_to_lean_grounds():
    p = ready()
    estimate = p.vehicles[0].seen
    lying = replace(estimate.state, quaternion=turned(roll=math.pi / 2))
    p = vehicle(p, seen=replace(estimate, state=lying))
    (line,) = [line for line in p.run() if line.name == "cf1 at start"]
    assert not line.ok
    assert "lean by 90 deg" in line.remedy
