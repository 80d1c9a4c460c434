"""The checklist of a trial, on the simulated rig: what grounds, and how it is waived."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.runner.rig.rig import simulated
from crazyarena.runner.trial.checklist import FlightChecklist, check_waivers, names
from crazyarena.runner.trial.phase import Aborted
from crazyarena.runner.trial.phases import Crew
from crazyarena.runner.trial.tracked_world import TrackedWorld
from crazyarena.safety.rehearsal import Rehearsals
from crazyarena.sim_backend.firmware.supervisor import INFO_ARMED
from crazyarena.sim_backend.physics.arena_plant import AB_CHARGE, AB_VOLTS, AP_CAPACITY
from crazyarena.sim_backend.vehicles import load_vehicle
from crazyarena.types import Pose
from tests.runner.trial.test_phases import QUICK

URI = "radio://0/80/2M/E7E7E7E701"


class Wall:
    time = 1e9

    def __call__(self):
        return self.time


@pytest.fixture
def stand(tmp_path):
    worlds = []

    def make(battery=1.0, place=(0.0, 0.0), stranger=None, deck=None, sets=(), **options):
        level = load_level("sim2real", sets)
        rig = simulated(level, 5, deck=deck)
        world = TrackedWorld(rig)
        worlds.append(world)
        draw = LevelRandom(level).reset()
        start = draw.start.copy()
        start[[0, 2]] += place
        draw = type(draw)(
            start, draw.mass, draw.inertia, draw.gates, draw.nominal_gates, draw.obstacles,
            draw._noise,
        )  # fmt: skip
        world.reset(draw)
        fleet = rig.safeguard.gate._backend._fleet
        used = 1.0 - battery
        fleet.bodies[0, AB_CHARGE] = used * fleet.plants[0, AP_CAPACITY]
        fleet.bodies[0, AB_VOLTS] -= 0.8 * used
        said = []
        checklist = FlightChecklist(
            rig,
            level,
            out=tmp_path,
            say=said.append,
            rehearsals=Rehearsals(tmp_path, Wall()),
            **options,
        )
        if stranger is not None:
            upright = Pose(np.array(stranger), np.array([0.0, 0.0, 0.0, 1.0]))
            on_frame = rig.listeners.on_frame

            def see(frame, result):
                on_frame(replace(frame, bodies={**frame.bodies, "person1": upright}), result)

            rig.pipeline._on_frame = (see,)
        crew = Crew(rig, world, level, timeouts=QUICK, checks=(checklist,), anywhere=True)
        return rig, crew, checklist, said

    yield make
    for world in worlds:
        world.close()


def test_a_vehicle_in_order_may_fly(stand):
    _, crew, checklist, said = stand()
    crew.prepare()
    (lines,) = checklist.record()["checks"]
    assert [line["name"] for line in lines if not line["ok"]] == []
    assert {line["name"] for line in lines} < set(names("cf1"))
    assert checklist.record()["waived"] == said == []


def test_every_line_can_be_waived_and_nothing_else(stand, tmp_path):
    _, crew, checklist, _ = stand(uri=URI, waive=names("cf1"), vehicle=load_vehicle())
    crew.prepare()
    (lines,) = checklist.record()["checks"]
    without_cameras = {"cf1 deck", "cf1 certain"}
    assert {line["name"] for line in lines} == set(names("cf1")) - without_cameras
    with pytest.raises(InputError, match=r"no such line .* cf1 battery"):
        check_waivers(["cf2 battery"], "cf1")
    with pytest.raises(InputError, match="no such line"):
        stand(waive=["batery"])


def test_a_vehicle_that_would_hover_low_grounds_where_there_are_people(stand):
    heavy = load_vehicle("cf21plus", ["body.mass=0.04"])
    _, crew, _, _ = stand(uri=URI, vehicle=heavy)
    with pytest.raises(Aborted, match=r"cf1 model: .* below its setpoint \(set ctrlMel\.mass to"):
        crew.prepare()
    # In simulation that is what is flown, to see what becomes of it.
    _, crew, _, _ = stand(vehicle=heavy)
    crew.prepare()


def test_a_low_battery_grounds_unless_waived(stand):
    rig, crew, _, _ = stand(battery=0.4)
    with pytest.raises(Aborted, match=r"pre-flight: cf1 battery: 3\.\d+ V .*--waive 'cf1 battery'"):
        crew.prepare()
    rig, crew, checklist, said = stand(battery=0.4, waive=["cf1 battery"])
    crew.prepare()
    crew.launch()
    assert rig.backend.telemetry(1).supervisor & INFO_ARMED
    record = checklist.record()
    assert record["waived"] == ["cf1 battery"]
    (line,) = [one for one in record["checks"][0] if one["name"] == "cf1 battery"]
    assert (line["ok"], line["waived"]) == (False, True)
    assert line["found"].endswith(" V")
    assert said[0].startswith("waived: cf1 battery (3.")


def test_a_vehicle_elsewhere_grounds_unless_waived(stand):
    _, crew, _, _ = stand(place=(1.0, 0.0))
    with pytest.raises(Aborted, match=r"cf1 at start: [01]\.\d+ m off"):
        crew.prepare()
    _, crew, _, _ = stand(place=(1.0, 0.0), waive=["cf1 at start"])
    crew.prepare()


@pytest.mark.parametrize(("place", "grounds"), [((0.0, 0.0, 1.7), True), ((5.0, 0.0, 1.7), False)])
def test_people_inside_the_fence_ground(stand, place, grounds):
    _, crew, _, _ = stand(stranger=place)
    if grounds:
        with pytest.raises(Aborted, match="arena clear: person1"):
            crew.prepare()
    else:
        crew.prepare()


def test_what_needs_a_hand_is_asked_for_where_there_are_people(stand, tmp_path):
    _, crew, _, _ = stand(uri=URI)
    with pytest.raises(Aborted, match=r"e-stop tested: .*cf1 is body cf1: not tried"):
        crew.prepare()
    rehearsals = Rehearsals(tmp_path, Wall())
    rehearsals.note_stop()
    rehearsals.note_body(URI, "cf1")
    _, crew, checklist, _ = stand(uri=URI)
    crew.prepare()
    assert checklist.record()["waived"] == []
    rehearsals.note_body(URI, "cf2")
    _, crew, _, _ = stand(uri=URI)
    with pytest.raises(Aborted, match="cf1 is body cf1: body cf2 was tipped with it"):
        crew.prepare()


# What was tried by hand


def test_rehearsals_grow_old_and_bodies_move_on(tmp_path):
    wall = Wall()
    first = Rehearsals(tmp_path, wall)
    assert first.stop_age() == math.inf
    first.note_stop()
    first.note_body("a", "cf1")
    wall.time += 60.0
    later = Rehearsals(tmp_path, wall)
    assert later.stop_age() == 60.0
    assert later.body("a") == ("cf1", 60.0)
    # The name has moved to another vehicle: what was known of the first is void.
    later.note_body("b", "cf1")
    assert later.body("a") == (None, math.inf)
    assert later.body("b") == ("cf1", 0.0)
    wall.time -= 3600.0
    assert later.stop_age() == math.inf


@pytest.mark.parametrize(
    "text", ["", "[]", "{", '{"stop": "now", "bodies": [1]}', '{"bodies": {"a": 1}}']
)
def test_a_damaged_record_remembers_nothing(tmp_path, text):
    (tmp_path / "rehearsed.json").write_text(text)
    damaged = Rehearsals(tmp_path, Wall())
    assert damaged.stop_age() == math.inf
    assert damaged.body("a") == (None, math.inf)
    damaged.note_stop()
    assert damaged.stop_age() == 0.0


@pytest.mark.parametrize("deck", ["lighthouse", "flow"])
def test_without_cameras_it_says_what_is_not_checked(deck, stand):
    _, crew, checklist, _ = stand(deck=deck)
    track = crew.prepare()
    assert track.source == "measured by hand"
    (lines,) = checklist.record()["checks"]
    by_name = {line["name"]: line for line in lines}
    assert [line["name"] for line in lines if not line["ok"]] == []
    unchecked = {line["name"] for line in lines if not line["checked"]}
    assert unchecked >= {"arena clear", "world axes", "cf1 heading", "cf1 agrees with cameras"}
    assert ("cf1 at start" in unchecked) == (deck == "flow")
    assert by_name["cf1 deck"]["found"] == deck


def test_a_vehicle_that_is_not_sure_of_its_place_is_grounded(stand):
    rig, crew, _, _ = stand(deck="lighthouse")
    fleet = rig.safeguard.gate._backend._fleet
    fleet.decks = type(fleet.decks)()  # no base station in sight
    with pytest.raises(Aborted, match="sure of its place to"):
        crew.prepare()


POLE = [
    "track.gates=[{x: 0.0, y: 0.0, yaw: 0.0, type: low}]",
    "track.obstacles=[{x: 0.0, y: 0.05}]",
]


def test_a_pole_in_a_gate_s_opening_grounds_unless_waived(stand):
    still = "randomization.gates_and_obstacles="
    _, crew, _, _ = stand(sets=[*POLE, still])
    with pytest.raises(Aborted, match=r"gates free: obstacle1 stands in the opening of gate1.*"):
        crew.prepare()
    _, crew, checklist, said = stand(sets=[*POLE, still], waive=["gates free"])
    crew.prepare()
    assert checklist.record()["waived"] == ["gates free"]
    assert "waived: gates free" in said[0]


def test_a_surveyed_track_is_what_counts(stand):
    level = load_level("sim2real")
    from crazyarena.safety.placement import nominal_track

    poses = nominal_track(level)
    gate = poses["gate1"]
    poses["obstacle1"] = Pose(gate.position + (0.0, 0.0, 0.0), gate.quaternion)
    _, crew, _, _ = stand(surveyed=poses)
    with pytest.raises(Aborted, match="obstacle1 stands in the opening of gate1"):
        crew.prepare()
