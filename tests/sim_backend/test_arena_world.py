"""The world of a dry run: nothing in it keeps step with anything else."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.levels import load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.sim_backend.arena_world import SimulatedArena
from crazyarena.sim_backend.firmware.stack_2026 import F_TICK
from crazyarena.sim_backend.vehicles import load_vehicle
from crazyarena.sim_backend.vehicles.rows import told_params


def _moments(seed: int) -> list[float]:
    """When the vehicle was switched on for three episodes, s."""
    arena = SimulatedArena(np.random.default_rng(seed))
    draw = LevelRandom(load_level("sim2real"), 1).reset()
    moments = []
    for _ in range(3):
        arena.stage(draw)
        assert arena.fleet.memory[0, F_TICK] == 0  # just booted
        moments.append(arena.clock.now())
        arena.clock.sleep_until(arena.clock.now() + 1.0)
    arena.close()
    return moments


def test_vehicle_and_cameras_do_not_start_in_step():
    phases = np.array([_moments(seed) for seed in range(12)]) % (1.0 / 120.0)
    # Anywhere in the period of a frame, in every episode.
    assert (np.ptp(phases, axis=0) > 0.004).all()
    assert (np.std(phases, axis=0) > 0.001).all()


def test_the_same_seed_is_the_same_flight():
    assert _moments(3) == _moments(3)


@pytest.mark.parametrize("name", ["cf21plus", "cf21b"])
def test_a_ground_station_is_told_what_the_simulated_vehicle_flies_with(name):
    vehicle = load_vehicle(name, ["estimation.position_std=0.002"])
    told = told_params(vehicle)
    assert told["locSrv.extPosStdDev"] == 0.002
    assert told["locSrv.extQuatStdDev"] == vehicle.estimation.quaternion_std.value
    assert vehicle.firmware.params.items() <= told.items()
