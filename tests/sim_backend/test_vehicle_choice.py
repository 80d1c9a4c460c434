"""Which vehicle flies: levels, the command line, vehicle lists, virtual vehicles."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.clock import VirtualClock
from crazyarena.crazyswarm_compat.config import load_crazyflies_1, load_crazyflies_2
from crazyarena.crazyswarm_compat.options import parse
from crazyarena.crazyswarm_compat.registry import SimOptions, open_backend
from crazyarena.errors import InputError
from crazyarena.levels import dump_level, load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.runner.dry_run import DryRun
from crazyarena.runner.rig.rig import simulated
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.crtp.vehicle import VirtualCrazyflie
from crazyarena.sim_backend.physics import arena_plant as ap
from crazyarena.sim_backend.physics.rigid_body import P_INERTIA, P_MASS
from crazyarena.sim_backend.vehicles import (
    VehicleChoice,
    VehicleSupply,
    dump_vehicle,
    load_vehicle,
    resolve,
    vehicle_rows,
)

ARENA = ["profile=arena"]


def test_a_level_names_its_vehicle_and_the_contestant_is_told_of_it():
    level = load_level("sim2real", ["vehicle=cf21b"])
    told, vehicle = resolve(level, VehicleChoice())
    assert vehicle.name == "cf21b"
    assert told.vehicle.mass == 0.04338
    assert (told.vehicle.ixx, told.vehicle.izz) == (2.5e-5, 4.9e-5)


def test_the_command_line_comes_before_the_level_and_what_a_level_weighs_before_the_model():
    level = load_level("level1", [*ARENA, "vehicle={model: cf21, mass: 0.036}"])
    told, vehicle = resolve(level, VehicleChoice("cf21plus", ("rotors.lag_up=0.1",)))
    assert vehicle.name == "cf21plus"
    assert vehicle.rotors.lag_up.value == 0.1
    assert vehicle.body.mass.value == told.vehicle.mass == 0.036
    assert told.vehicle.iyy == 1.68e-5


def test_the_default_vehicle_flies_where_nobody_says():
    _, vehicle = resolve(load_level("level0", ARENA), VehicleChoice())
    assert vehicle == load_vehicle("cf21plus")


def test_the_competition_has_a_vehicle_of_its_own():
    with pytest.raises(InputError, match=r"vehicle: needs profile: arena"):
        load_level("level0", ["vehicle=cf21b"])
    with pytest.raises(InputError, match=r"--vehicle: level level0 .*profile=arena"):
        DryRun(None, "level0", vehicle=VehicleChoice("cf21b"))
    with pytest.raises(InputError, match=r"--vehicle: level level0"):
        DryRun(None, "level0", spread=True)


def test_the_text_of_a_level_without_a_model_is_what_it_was():
    """Recordings hold it, and those of the competition stay as they are."""
    assert "model" not in dump_level(load_level("level0"))
    assert "spread" not in dump_level(load_level("level0"))
    level = load_level("sim2real")
    assert "spread: true" in dump_level(level)


def test_a_dry_run_flies_its_own_file(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(dump_vehicle(load_vehicle("cf21plus", ["body.mass=0.0333"])))
    run = DryRun(None, "sim2real", vehicle=VehicleChoice(str(file)), spread=False)
    assert run.supply.next().body.mass.value == 0.0333
    assert not run.supply.spread


def test_a_seed_is_a_vehicle():
    vehicle = load_vehicle()
    first = [VehicleSupply(vehicle, seed).next() for seed in (1, 1, 2)]
    assert first[0] == first[1] != first[2]
    supply = VehicleSupply(vehicle, 1)
    drawn = [supply.next() for _ in range(3)]
    assert drawn[0] == first[0]
    assert drawn[0] != drawn[1] != drawn[2]
    assert VehicleSupply(vehicle).next() == vehicle


@pytest.mark.parametrize("spread", [False, True])
def test_a_rig_flies_the_vehicle_and_the_draw_of_the_level_on_top(spread):
    level = load_level("sim2real", ["randomization.inertia={mass: [0.001, 0.001]}"])
    level, vehicle = resolve(level, VehicleChoice("cf21"))
    supply = VehicleSupply(vehicle, 7 if spread else None)
    rig = simulated(level, 7, guarded=False, supply=supply)
    draw = LevelRandom(level, 7).reset()
    rig.stage(draw)
    plant = rig.backend._fleet.plants[0]
    flown = supply.flown
    assert plant[P_MASS] == pytest.approx(flown.body.mass.value + 0.001, rel=1e-12)
    assert plant[P_INERTIA] == pytest.approx(flown.body.inertia.value[0], rel=1e-12)
    assert plant[ap.AP_LAG_UP] == flown.rotors.lag_up.value
    assert (flown != vehicle) is spread
    assert len(rig.description["vehicles"]) == spread
    rig.close()


def test_cameras_follow_the_markers():
    rows = vehicle_rows(load_vehicle("cf21plus", ["markers.offset=[0.01, 0.0, 0.04]"]))
    fleet = ArenaFleet([[0.0, 0.0, 0.0]], [np.pi / 2], vehicles=rows)
    seen, centre = fleet.tracked_pose(0), fleet.true_pose(0)
    np.testing.assert_allclose(seen.position - centre.position, [0.0, 0.01, 0.04], atol=1e-12)


LIST = """
crazyflies:
  - {id: 1, initialPosition: [0, 0, 0], vehicle: cf21b}
  - {id: 2, initialPosition: [1, 0, 0]}
vehicle: cf21
"""


def test_vehicle_lists_name_models():
    fleet = load_crazyflies_1(LIST)
    assert [config.vehicle for config in fleet.vehicles] == ["cf21b", "cf21"]
    fleet = load_crazyflies_2(
        "robots: {a: {uri: radio://0/80/2M/E7E7E7E701, type: t, initial_position: [0, 0, 0]},"
        " b: {uri: radio://0/80/2M/E7E7E7E702, type: t, initial_position: [1, 0, 0],"
        " vehicle: cf21}}\nrobot_types: {t: {vehicle: cf21b}}\nall: {}\n"
    )
    assert [config.vehicle for config in fleet.vehicles] == ["cf21b", "cf21"]


def test_a_file_beside_the_list(tmp_path):
    (tmp_path / "mine.yaml").write_text(dump_vehicle(load_vehicle()))
    file = tmp_path / "crazyflies.yaml"
    file.write_text("crazyflies: [{id: 1, initialPosition: [0, 0, 0], vehicle: mine.yaml}]")
    assert load_crazyflies_1(str(file)).vehicles[0].vehicle == str(tmp_path / "mine.yaml")


def test_scripts_fly_the_models_of_the_list_or_of_the_flags():
    for options, masses in (
        (SimOptions(), (0.04338, 0.0319)),
        (SimOptions(vehicle="cf21plus", vehicle_set=["body.mass=0.035"]), (0.035, 0.035)),
    ):
        backend = open_backend("sim", load_crazyflies_1(LIST), VirtualClock(), options)
        np.testing.assert_array_equal(backend._fleet.plants[:, P_MASS], masses)
        backend.close()
    flags = parse("--sim --backend sim --vehicle cf21b --vehicle-set body.mass=0.05", None)
    assert (flags.vehicle, flags.vehicle_set) == ("cf21b", ["body.mass=0.05"])
    with pytest.raises(InputError, match="did you mean 'cf21plus'"):
        open_backend(
            "sim", load_crazyflies_1(LIST), VirtualClock(), SimOptions(vehicle="cf21pluss")
        )


def test_a_virtual_vehicle_boots_as_its_model_says():
    kit = vehicle_rows(load_vehicle("cf21plus_thrust_kit"))
    fleet = ArenaFleet([[0.0, 0.0, 0.0]], vehicles=kit)
    virtual = VirtualCrazyflie(fleet, 0)
    assert fleet.get_param(0, "ctrlMel.mass") == pytest.approx(0.0325)
    fleet.set_param(0, "ctrlMel.mass", 0.03)
    virtual.reboot()
    assert fleet.get_param(0, "ctrlMel.mass") == pytest.approx(0.0325)
    assert fleet.get_param(0, "ctrlMel.kp_z") == 1.25
