"""Validation against flights: reading logs, flying them again, figures; and the real ones."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import InputError
from crazyarena.runner.records import validate as va
from crazyarena.runner.records import validate_flights as vf
from crazyarena.runner.records.validate_replay import hover_strength
from crazyarena.runner.records.validate_report import save_figure, tables
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.physics import arena_plant as ap
from crazyarena.sim_backend.vehicles import load_vehicle, vehicle_rows
from crazyarena.types import Pose

REAL = Path(os.environ.get("CRAZYARENA_REAL_FLIGHTS", "../shared/real_flights"))
STRENGTH = 0.8
HIGH = 0.04  # m, of the markers above the centre


def path(time):
    """A circle of 0.6 m at 0.8 m/s, 0.8 m high, begun from the ground."""
    angle = 1.3 * np.maximum(time - 4.0, 0.0)
    height = 0.06 + 0.8 * np.clip((time - 0.2) / 1.5, 0.0, 1.0)
    return np.stack([0.6 * np.cos(angle) - 0.6, 0.6 * np.sin(angle), height], axis=-1)


@pytest.fixture(scope="session")
def log():
    """A flight of a vehicle with weak motors, as arrays at 100 Hz."""
    strength = f"rotors.strength=[{STRENGTH}, {STRENGTH}, {STRENGTH}, {STRENGTH}]"
    fleet = ArenaFleet(
        [(0.0, 0.0, 0.0)], vehicles=vehicle_rows(load_vehicle("cf21plus", [strength]))
    )
    fleet.set_param(0, "stabilizer.controller", 2)
    rows: list[list[float]] = []
    for k in range(200 + 1600):
        time = 0.01 * (k - 200)
        target = path(np.array(time)) if time >= 0.0 else np.full(3, np.nan)
        pose = fleet.true_pose(0)
        seen = pose.position + (0.0, 0.0, HIGH)
        fleet.external_pose(0, Pose(seen, pose.quaternion), 0.01)
        if time >= 0.0:
            fleet.send(c.Position(target), 0)
        rows.append(
            [
                time + 5.0,
                *seen,
                *target,
                *(fleet.rows(0).motors / 65535.0),
                fleet.bodies[0, ap.AB_VOLTS],
                *fleet.bodies[0, ap.AB_ACCELERATION : ap.AB_ACCELERATION + 3] / 9.81,
            ]
        )
        fleet.advance(10)
    fleet.close()
    return np.array(rows)


@pytest.fixture
def npz(log, tmp_path):
    setpoint = np.nan_to_num(log[:, 4:7])
    file = tmp_path / "circle.npz"
    np.savez(
        file,
        t=log[:, 0],
        pos_0p1mm=np.round(log[:, 1:4] * 1e4).astype(np.int32),
        setpoint_0p1mm=np.round(setpoint * 1e4).astype(np.int32),
        motors_u16=np.round(log[::2, 7:11] * 65535).astype(np.uint16),
        vbat_mV=np.round(log[::10, 11:12] * 1000).astype(np.uint16),
        acc_mg=np.round(log[::2, 12:15] * 1000).astype(np.int16),
        controller="mell",
    )
    return file


@pytest.fixture
def table(log, tmp_path):
    file = tmp_path / "circle_mellinger.csv"
    names = "t,x,y,z,sp_x,sp_y,sp_z,m1,m2,m3,m4,vbat,acc.x,acc.y,acc.z"
    lines = [names]
    for row in log:
        lines.append(",".join("" if np.isnan(value) else repr(float(value)) for value in row))
    file.write_text("\n".join(lines) + "\n")
    return file


def test_a_flight_of_the_model_itself_is_flown_again_to_the_millimetre(npz):
    (pair,) = va.validate([npz], load_vehicle())
    outcome = pair.outcome
    assert outcome.controller == "Mellinger"
    assert outcome.rmse < 0.006
    assert outcome.aligned <= outcome.rmse
    assert abs(outcome.lag) <= 0.01
    assert outcome.takeoff[1] == pytest.approx(outcome.takeoff[0], abs=0.05)
    assert outcome.sag[1] == pytest.approx(outcome.sag[0], abs=0.03)
    assert outcome.delayed < outcome.ideal


def test_the_thrust_to_hover_comes_from_motors_and_battery(npz):
    rows = vehicle_rows(load_vehicle())
    assert hover_strength(vf.load(npz), rows) == pytest.approx(STRENGTH, rel=0.02)
    (blind,) = va.validate([npz], load_vehicle(), hover="none")
    (seeing,) = va.validate([npz], load_vehicle(), hover="set")
    # Mellinger flies a vehicle with stronger motors higher.
    assert blind.outcome.offset[2] > seeing.outcome.offset[2] + 0.03
    assert not blind.outcome.calibrated


def test_another_vehicle_flies_another_path(npz):
    other = load_vehicle("cf21plus", ["body.drag=[0.004, 0.004, 0.004]"])
    (wrong,) = va.validate([npz], other)
    (right,) = va.validate([npz], load_vehicle())
    assert wrong.outcome.rmse > 3.0 * right.outcome.rmse


def test_a_table_says_what_the_archive_says(npz, table):
    (one,), (two,) = (va.validate([file], load_vehicle()) for file in (npz, table))
    np.testing.assert_allclose(one.simulated.position, two.simulated.position, atol=2e-3)
    assert two.outcome.strength == pytest.approx(one.outcome.strength, rel=1e-2)


def test_a_shift_of_the_clocks_is_found(npz, tmp_path):
    with np.load(npz) as held:
        arrays = dict(held)
    late = 3  # poses logged 30 ms too late
    arrays["pos_0p1mm"] = np.roll(arrays["pos_0p1mm"], late, axis=0)
    arrays["pos_0p1mm"][:late] = arrays["pos_0p1mm"][late]
    file = tmp_path / "late_mell.npz"
    np.savez(file, **arrays)
    (pair,) = va.validate([file], load_vehicle())
    assert pair.outcome.lag == pytest.approx(-0.03, abs=0.006)
    assert pair.outcome.aligned < 0.5 * pair.outcome.rmse


def test_a_log_that_begins_in_the_air(npz, tmp_path):
    with np.load(npz) as held:
        arrays = {name: value for name, value in held.items() if value.ndim and len(value) == 1800}
    cut = {name: value[700:] for name, value in arrays.items()}
    file = tmp_path / "air_mell.npz"
    np.savez(file, **cut)
    (pair,) = va.validate([file], load_vehicle("cf21plus", ["rotors.strength=[0.8,0.8,0.8,0.8]"]))
    assert np.isnan(pair.outcome.takeoff[0])
    assert pair.outcome.plane < 0.03


def test_a_planner_on_board_gives_velocities_too(npz):
    flight = vf.load(npz, high_level=True)
    commands = [command for time, command in flight.commands if 12.0 < time < 15.0]
    assert all(isinstance(command, c.FullState) for command in commands)
    speeds = [np.linalg.norm(command.velocity) for command in commands]
    np.testing.assert_allclose(speeds, 0.78, atol=0.02)
    pulls = [np.linalg.norm(command.acceleration) for command in commands]
    np.testing.assert_allclose(pulls, 0.6 * 1.3**2, atol=0.1)


@pytest.mark.parametrize("width", [60, 80])
def test_report_fits_the_terminal_and_is_written(npz, tmp_path, width):
    from rich.console import Console

    longer = npz.with_name("B10_circle_at_a_length_of_its_name_fast_rep1.npz")
    longer.write_bytes(npz.read_bytes())
    pairs = va.validate([longer], load_vehicle())
    console = Console(width=width, record=True, file=open(os.devnull, "w"))  # noqa: SIM115
    for one in tables(pairs, load_vehicle()):
        console.print(one)
    text = console.export_text()
    assert max(len(line) for line in text.splitlines()) <= width
    outcome = pairs[0].outcome
    for number in (f"{outcome.rmse:.3f}", f"{1000 * outcome.lag:+.0f}", f"{outcome.offset[0]:.1f}"):
        assert number in text
    assert f"{outcome.strength:.2f}" in text
    # Of a long name the end is given up, of numbers nothing.
    assert not re.search(r"[0-9.+-]…|hov…", text)
    save_figure(tmp_path / "v.png", pairs, load_vehicle())
    assert (tmp_path / "v.png").stat().st_size > 10_000
    data = va.summary(pairs, load_vehicle(), "flight")
    assert json.loads(json.dumps(data, allow_nan=False))["medians"]["Mellinger"]["flights"] == 1


def rewritten(npz, tmp_path, **changes):
    with np.load(npz) as held:
        arrays = dict(held)
    for name, value in changes.items():
        if value is None:
            del arrays[name]
        else:
            arrays[name] = value
    file = tmp_path / "bad.npz"
    np.savez(file, **arrays)
    return file


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"pos_0p1mm": None}, r"position: missing; expected an array pos_0p1mm or pos"),
        ({"t": None}, r"t: missing"),
        ({"controller": None}, r"controller: not in the file; pass --controller"),
        ({"controller": np.array("lqr")}, r"controller: found 'lqr'; expected one of pid"),
        ({"t": np.zeros(1700)}, r"pos_0p1mm: expected 1700 rows"),
        ({"motors_u16": np.zeros((900, 3))}, r"motors_u16: expected \(n, 4\)"),
        ({"setpoint_0p1mm": np.zeros((1800, 3))}, r"setpoint: expected at least 20 samples"),
        ({"t": np.r_[np.arange(1799), 5.0]}, r"t\[1799\]: expected finite times that do not fall"),
        ({"vbat_mV": np.array(["x"] * 180)[:, None]}, r"vbat_mV: expected numbers"),
    ],
)
def test_a_wrong_archive_is_told_by_file_and_field(npz, tmp_path, changes, words):
    file = rewritten(npz, tmp_path, **changes)
    with pytest.raises(InputError, match=rf"bad\.npz: {words}"):
        vf.load(file)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", r"expected a line of column names"),
        ("t,x,y\n0,1,2\n", r"position: missing; expected columns pos_x, pos_y, pos_z or"),
        ("x,y,z\n0,1,2\n", r"t: missing; expected a column t in s, found x, y, z"),
        ("t,x,y,z,sp_x,sp_y,sp_z\n0,1,2,3,4,5\n", r"expected 7 columns, found 6"),
        ("t,x,y,z,sp_x,sp_y,sp_z\n0,1,2,3,4,five,6\n", r"sp_y: expected a number or nothing"),
        ("t,x,y,z,sp_x,sp_y,sp_z\n0,1,2,3,4,5,6\n", r"position: expected at least 20 samples"),
    ],
)
def test_a_wrong_table_is_told_by_file_line_and_column(tmp_path, text, words):
    file = tmp_path / "bad_pid.csv"
    file.write_text(text)
    with pytest.raises(InputError, match=rf"bad_pid\.csv.*{words}"):
        vf.load(file)


def test_what_is_no_flight_is_told(tmp_path):
    (tmp_path / "x.npz").write_bytes(b"PK\x03\x04 no archive")
    (tmp_path / "x.txt").write_text("")
    (tmp_path / "empty").mkdir()
    for path_, words in (
        (tmp_path / "nowhere.npz", "no such file"),
        (tmp_path / "x.txt", "not a kind of file"),
        (tmp_path / "empty", "holds no flights"),
    ):
        with pytest.raises(InputError, match=words):
            vf.find([path_])
    with pytest.raises(InputError, match="not a NumPy archive"):
        vf.load(tmp_path / "x.npz")


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="no real flights here")
def test_real_flights_are_explained():
    """Fifteen flights of a Crazyflie 2.1, mostly the fast ones of a public set."""
    found = va.medians(va.validate([REAL], load_vehicle()))
    pid, mellinger = found["PID"], found["Mellinger"]
    assert (pid["flights"], mellinger["flights"]) == (9, 6)
    assert pid["rmse"] <= 0.090
    assert pid["aligned"] <= 0.078
    assert mellinger["rmse"] <= 0.050
    assert mellinger["aligned"] <= 0.047
    assert abs(pid["lag"]) <= 0.03
    assert abs(mellinger["lag"]) <= 0.03
