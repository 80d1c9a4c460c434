"""Identification: an unknown vehicle's numbers from its flights, and what flights cannot tell."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import InputError
from crazyarena.runner.cli import make_app
from crazyarena.runner.records import identify_fit as fit
from crazyarena.runner.records import validate_flights as vf
from crazyarena.runner.records.identify import identify
from crazyarena.runner.records.validate import validate
from crazyarena.sim_backend.arena import ArenaFleet, SensorNoise
from crazyarena.sim_backend.firmware.layout import ST_GYRO
from crazyarena.sim_backend.firmware.stack_2026 import F_STATE
from crazyarena.sim_backend.physics import arena_plant as ap
from crazyarena.sim_backend.vehicles import load_vehicle, vehicle_rows
from crazyarena.types import Pose

REAL = Path(os.environ.get("CRAZYARENA_REAL_FLIGHTS", "../shared/real_flights"))
DRAG = (0.019, 0.0165, 0.02)
LAG = 0.11
STRENGTH = (0.9, 0.85, 0.95, 0.88)
RESISTANCE = 0.21
UNKNOWN = (
    f"body.drag={list(DRAG)}",
    f"rotors.lag_up={LAG}",
    f"rotors.lag_down={LAG}",
    f"rotors.strength={list(STRENGTH)}",
    f"battery.resistance={RESISTANCE}",
    "battery.drawn=0.1",
)
_EVERY = 2  # ms between samples
_ROTOR = 8695.0  # rad/s per root of N


def _eight(time: float, rate: float, radius: float) -> np.ndarray:
    angle = rate * max(time - 4.0, 0.0)
    height = 0.06 + 0.8 * np.clip((time - 0.2) / 1.5, 0.0, 1.0)
    height += 0.15 * np.sin(1.7 * max(time - 4.0, 0.0))
    return np.array([radius * np.sin(angle), radius * np.sin(2.0 * angle) / 1.3, height])


def _fly(file: Path, seed: int, rate: float, radius: float, seconds: float = 18.0) -> Path:
    """Log a flight of the unknown vehicle at 500 Hz."""
    rng = np.random.default_rng(seed)
    fleet = ArenaFleet(
        [(0.0, 0.0, 0.0)],
        vehicles=vehicle_rows(load_vehicle("cf21plus", UNKNOWN)),
        noise=SensorNoise(gyro=0.1, accelerometer=0.003),
        rng=rng,
    )
    fleet.set_param(0, "stabilizer.controller", 2)
    log: dict[str, list[object]] = {}
    target = np.full(3, np.nan)
    for k in range(round((2.0 + seconds) * 1e3 / _EVERY)):
        time = 1e-3 * k * _EVERY - 2.0
        pose = fleet.true_pose(0)
        if k * _EVERY % 10 == 0:
            seen = pose.position + rng.normal(0.0, 5e-4, 3)
            fleet.external_pose(0, Pose(seen, pose.quaternion), 0.012)
        if time >= 0.0 and k * _EVERY % 20 == 0:
            target = _eight(time, rate, radius)
            fleet.send(c.Position(tuple(target)), 0)
        sensed = fleet.memory[0, F_STATE + ST_GYRO : F_STATE + ST_GYRO + 6].copy()
        for name, value in (
            ("t", time + 5.0),
            ("position", pose.position),
            ("setpoint", target),
            ("quat", pose.quaternion),
            ("motors", fleet.rows(0).motors / 65535.0),
            ("vbat", [fleet.bodies[0, ap.AB_VOLTS]]),
            ("gyro_dps", sensed[:3]),
            ("acc_g", sensed[3:]),
            ("rotors", _ROTOR * fleet.bodies[0, ap.AB_ROTOR : ap.AB_ROTOR + 4]),
        ):
            log.setdefault(name, []).append(np.array(value))
        fleet.advance(_EVERY)
    arrays = {name: np.array(values) for name, values in log.items()}
    np.savez(file, controller="mellinger", **arrays)
    return file


@pytest.fixture(scope="session")
def unknown(tmp_path_factory):
    """Two logs of a vehicle that nobody knows."""
    folder = tmp_path_factory.mktemp("unknown")
    return [
        _fly(folder / "eight.npz", 0, 1.4, 0.8),
        _fly(folder / "wide.npz", 1, 1.1, 0.9),
    ]


def _slow_streams(flight: vf.RealFlight, keep: tuple[str, ...], every: int = 10) -> vf.RealFlight:
    """The flight as a radio logs it: only some streams, every so many samples."""
    changes = {}
    for name in ("motors", "volts", "acceleration", "attitude", "gyro", "rotors"):
        series = getattr(flight, name)
        thin = vf.Series(series.time[::every], series.value[::every])
        changes[name] = thin if name in keep else vf.EMPTY
    return dataclasses.replace(flight, **changes)


def test_it_finds_the_numbers_of_an_unknown_vehicle(unknown):
    result = identify(unknown, load_vehicle())
    found = {one.name: one for one in result.findings}
    assert found["body.drag"].value[:2] == pytest.approx(DRAG[:2], rel=0.10)
    assert found["rotors.lag_up"].value[0] == pytest.approx(LAG, rel=0.15)
    assert found["rotors.lag_down"].value[0] == pytest.approx(LAG, rel=0.15)
    assert found["rotors.strength"].value == pytest.approx(STRENGTH, rel=0.03)
    assert found["battery.resistance"].value[0] == pytest.approx(RESISTANCE, rel=0.15)
    # Each flight is explained better by what the other one told.
    assert result.unseen
    for before, after in result.errors.values():
        assert after < 0.7 * before
    for name in ("body.inertia", "body.mass"):
        assert name in result.refused
    vehicle = result.vehicle
    assert vehicle.rotors.strength.value == found["rotors.strength"].value
    assert vehicle.body.inertia == load_vehicle().body.inertia
    assert "2 flights" in vehicle.battery.resistance.origin


@pytest.mark.parametrize("at", [0, 1])
def test_turning_rates_tell_the_rotor_lag(unknown, at):
    flight = dataclasses.replace(vf.load(unknown[at]), rotors=vf.EMPTY)
    told = fit.lag(flight, vehicle_rows(load_vehicle()).plant)
    assert told.value == pytest.approx(LAG, rel=0.15)
    assert (told.error < 0.2 * LAG).all()


def test_what_a_radio_logs_tells_strength_drag_and_resistance_but_no_lag(unknown):
    plant = vehicle_rows(load_vehicle()).plant
    flight = _slow_streams(vf.load(unknown[0]), ("motors", "volts", "acceleration", "attitude"))
    assert fit.strength(flight, plant).value == pytest.approx(STRENGTH, rel=0.03)
    assert fit.resistance(flight, plant).value == pytest.approx(RESISTANCE, rel=0.15)
    mass = load_vehicle().body.mass.value
    assert mass * fit.drag(flight).value == pytest.approx(DRAG[:2], rel=0.10)
    with pytest.raises(fit.NotTold, match="190 Hz"):
        fit.lag(flight, plant)


def test_a_log_on_board_is_flown_again_with_the_frames_that_a_ground_station_sends(unknown):
    # Of 500 poses a second the estimator on board had 100.
    for pair in validate(unknown, load_vehicle("cf21plus", UNKNOWN), hover="none"):
        assert pair.outcome.rmse < 0.012
        assert abs(pair.outcome.lag) < 0.0101  # a frame


def test_poses_and_commands_alone_tell_thrust_drag_and_all_delays(unknown, tmp_path):
    files = []
    for log in unknown:
        with np.load(log) as held:
            poses = {name: held[name] for name in ("t", "position", "setpoint", "controller")}
        files.append(tmp_path / log.name)
        np.savez(files[-1], **poses)
    result = identify(files, load_vehicle())
    found = {one.name: one for one in result.findings}
    # Height of a Mellinger hover tells thrust over weight; each motor's own share stays untold.
    assert np.mean(found["rotors.strength"].value) == pytest.approx(np.mean(STRENGTH), rel=0.03)
    assert np.mean(found["body.drag"].value[:2]) == pytest.approx(np.mean(DRAG[:2]), rel=0.1)
    for one in found.values():
        assert "path" in one.source
        assert 0.0 < one.error < 0.5
    assert "battery.resistance" in result.refused
    # Of flights that were not fitted, nearly all of the error is gone.
    for before, after in result.errors.values():
        assert after < 0.4 * before


@pytest.mark.parametrize("shift", [-0.04, 0.04])
def test_clocks_of_streams_that_differ_do_not_spoil_the_drag(unknown, shift):
    flight = vf.load(unknown[0])
    pose = vf.Series(flight.pose.time + shift, flight.pose.value)
    told = fit.drag(dataclasses.replace(flight, pose=pose))
    assert load_vehicle().body.mass.value * told.value == pytest.approx(DRAG[:2], rel=0.10)


def test_a_mass_changes_strength_and_drag_in_proportion(unknown):
    light = identify(unknown[:1], load_vehicle(), mass=0.030)
    heavy = identify(unknown[:1], load_vehicle(), mass=0.036)
    assert not light.unseen  # one flight: nothing is left to judge by
    assert "body.mass" not in light.refused
    for group, key in (("rotors", "strength"), ("body", "drag")):
        small, large = (getattr(getattr(r.vehicle, group), key).value[0] for r in (light, heavy))
        assert large / small == pytest.approx(1.2, rel=0.01)


def test_a_flight_that_is_too_slow_or_short_is_told(unknown):
    flight = vf.load(unknown[0])
    still = vf.Series(flight.pose.time, np.tile(flight.pose.value[-1], (len(flight.pose), 1)))
    with pytest.raises(fit.NotTold, match="too slow"):
        fit.drag(dataclasses.replace(flight, pose=still))
    steady = flight.motors.time > 12.0
    motors = vf.Series(flight.motors.time[steady], np.full((steady.sum(), 4), 0.7))
    with pytest.raises(fit.NotTold, match="before take-off"):
        fit.resistance(
            dataclasses.replace(flight, motors=motors), vehicle_rows(load_vehicle()).plant
        )


def test_saturated_motors_are_told(unknown):
    flight = vf.load(unknown[0])
    full = flight.motors.value.copy()
    full[::4, 2] = 1.0
    flight = dataclasses.replace(flight, motors=vf.Series(flight.motors.time, full))
    assert fit.saturation(flight) == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize("mass", [0.0, 0.004, 0.6, float("nan"), -1.0])
def test_a_mass_that_is_none_is_refused(unknown, mass):
    with pytest.raises(InputError, match=r"--mass: .* 5 to 500 g"):
        identify(unknown, load_vehicle(), mass=mass)


def test_the_command_writes_a_vehicle_that_flies(unknown, tmp_path):
    out = tmp_path / "mine.yaml"
    run = CliRunner().invoke(
        make_app(), ["identify", str(unknown[0]), "--mass", "31.8", "-o", str(out)]
    )
    assert run.exit_code == 0, run.output
    assert "body.inertia" in run.output
    vehicle = load_vehicle(out)
    assert vehicle.name == "mine"
    assert vehicle.battery.resistance.value == pytest.approx(RESISTANCE, rel=0.15)
    vehicle_rows(vehicle)


def test_bad_files_and_names_are_refused(tmp_path):
    for arguments, word in (
        (["identify", str(tmp_path / "none.npz"), "-o", "x.yaml"], "no such file"),
        (["identify", str(tmp_path), "-o", "x.yaml"], "holds no flights"),
        (["identify", str(tmp_path), "-o", "x.txt"], "expected a .yaml"),
    ):
        run = CliRunner().invoke(make_app(), arguments)
        assert run.exit_code == 2
        assert word in run.output


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="no real flights here")
def test_it_explains_real_flights_that_it_has_not_seen():
    result = identify([REAL], load_vehicle())
    before, after = np.median(np.array(list(result.errors.values())), axis=0)
    assert after < 0.8 * before
    # 0.389 1/s from all flights of this set.
    drag = np.array(result.vehicle.body.drag.value[:2]) / result.vehicle.body.mass.value
    assert drag == pytest.approx(0.389, rel=0.15)
