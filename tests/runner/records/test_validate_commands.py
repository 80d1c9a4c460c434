"""Flights of the high-level commander: commands in logs, flown again by the planner on board."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import InputError
from crazyarena.runner.records import validate as va
from crazyarena.runner.records import validate_flights as vf
from crazyarena.runner.records.validate_commands import end_of, read_commands
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.physics import arena_plant as ap
from crazyarena.sim_backend.vehicles import load_vehicle, vehicle_rows

HEAVY = "body.mass=0.0347"
SCRIPT = (
    (0.0, "takeoff 1.0 2.0"),
    (3.0, "goto 0.1 0.0 1.0 0.0 1.0"),
    (5.0, "trajectory eight.csv timescale=0.9 relative"),
    (13.5, "land 0.03 2.0"),
)


def eight(file):
    """A figure 8 of 8 s, 1 m across, in pieces fitted to it; written as Crazyswarm reads it."""
    lines, whole, count = [], 8.0, 16
    for k in range(count):
        t0, length = whole * k / count, whole / count
        local = np.linspace(0.0, length, 60)
        # From rest to rest: the phase itself is a polynomial.
        s = (t0 + local) / whole
        phase = 2.0 * np.pi * s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
        rows = [np.sin(phase) * 0.5, np.sin(2.0 * phase) * 0.25, 0.0 * local, 0.0 * local]
        fits = [np.polynomial.polynomial.polyfit(local, row, 7) for row in rows]
        lines.append(",".join(repr(float(v)) for v in (length, *np.concatenate(fits))))
    file.write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module", params=["pid", "mellinger"])
def flown(request, tmp_path_factory):
    """A heavier vehicle flies the script; (controller, folder, rows at 100 Hz)."""
    folder = tmp_path_factory.mktemp(request.param)
    eight(folder / "eight.csv")
    fleet = ArenaFleet([(0.0, 0.0, 0.0)], vehicles=vehicle_rows(load_vehicle("cf21plus", [HEAVY])))
    fleet.set_param(0, "stabilizer.controller", {"pid": 1, "mellinger": 2}[request.param])
    told = [
        (time, command)
        for time, command in read_commands(
            folder / "log.csv", [(time, words, "here") for time, words in SCRIPT]
        )
    ]
    rows = []
    for k in range(200 + 1650):
        time = 0.01 * (k - 200)
        pose = fleet.true_pose(0)
        fleet.external_pose(0, pose, 0.01)
        while told and told[0][0] <= time + 1e-9:
            fleet.send(told.pop(0)[1], 0)
        rows.append(
            [
                time + 7.0,
                *pose.position,
                *(fleet.rows(0).motors / 65535.0),
                fleet.bodies[0, ap.AB_VOLTS],
            ]
        )
        fleet.advance(10)
    fleet.close()
    return request.param, folder, np.array(rows)


def archive(folder, rows, controller, **changes):
    arrays = {
        "t": rows[:, 0],
        "pos": rows[:, 1:4],
        "motors": rows[::2, 4:8],
        "vbat": rows[::10, 8],
        "controller": controller,
        "command_t": np.array([time + 7.0 for time, _ in SCRIPT]),
        "command": np.array([words for _, words in SCRIPT]),
        **changes,
    }
    file = folder / "flight.npz"
    np.savez(file, **{key: value for key, value in arrays.items() if value is not None})
    return file


def test_a_flight_of_the_planner_on_board_is_flown_again(flown):
    controller, folder, rows = flown
    file = archive(folder, rows, controller)
    (pair,) = va.validate([file], load_vehicle("cf21plus", [HEAVY]))
    o = pair.outcome
    assert o.controller.lower() == controller
    assert o.plane < 0.005
    assert o.rmse < 0.01
    assert abs(o.lag) <= 0.01
    assert o.takeoff[1] == pytest.approx(o.takeoff[0], abs=0.05)
    assert o.strength == pytest.approx(1.0, abs=0.02)
    # Judged is what was flown between take-off and landing, not up to the last command alone.
    assert o.duration == pytest.approx(15.5 - 4.5 - 3.0, abs=0.05)
    assert np.ptp(pair.simulated.position[:, 0]) > 0.9
    (wrong,) = va.validate([file], load_vehicle("cf21plus", ["body.drag=[0.05, 0.05, 0.05]"]))
    assert wrong.outcome.plane > 2.0 * o.plane


def test_a_table_with_commands_is_read_as_the_archive(flown):
    controller, folder, rows = flown
    lines = ["t,x,y,z,m1,m2,m3,m4,vbat,command"]
    told = {round(time + 7.0, 2): words for time, words in SCRIPT}
    for row in rows:
        words = told.get(round(float(row[0]), 2), "")
        lines.append(",".join(repr(float(value)) for value in row) + "," + words)
    table = folder / f"table_{controller}.csv"
    table.write_text("\n".join(lines) + "\n")
    flights = [vf.load(table), vf.load(archive(folder, rows, controller))]
    for (t, one), (u, two) in zip(*(flight.commands for flight in flights), strict=True):
        assert t == pytest.approx(u)
        assert type(one) is type(two)
    assert flights[0].controller == flights[1].controller
    (pair,) = va.validate([table], load_vehicle("cf21plus", [HEAVY]))
    assert pair.outcome.plane < 0.005


def test_a_log_that_ends_on_the_way_is_judged_to_its_end(flown):
    controller, folder, rows = flown
    kept = rows[: 200 + 1200]
    few = SCRIPT[:3]
    file = archive(
        folder,
        kept,
        controller,
        command_t=np.array([time + 7.0 for time, _ in few]),
        command=np.array([words for _, words in few]),
    )
    (pair,) = va.validate([file], load_vehicle("cf21plus", [HEAVY]))
    # The trajectory takes 7.2 s from 5 s on, the log ends at 12 s.
    assert pair.real.end == pytest.approx(7.0 + 12.2)
    assert pair.outcome.duration == pytest.approx(12.2 - 3.0 - 4.5, abs=0.05)
    assert pair.outcome.plane < 0.005


def test_two_trajectories_share_the_memory(tmp_path):
    for name in ("a.csv", "b.csv"):
        eight(tmp_path / name)
    told = [
        (0.0, "trajectory a.csv", "1"),
        (9.0, "trajectory b.csv", "2"),
        (18.0, "trajectory a.csv timescale=2 reversed", "3"),
    ]
    commands = read_commands(tmp_path / "log.csv", told)
    uploads = [m for _, m in commands if isinstance(m, c.UploadTrajectory)]
    starts = [m for _, m in commands if isinstance(m, c.StartTrajectory)]
    assert [m.piece_offset for m in uploads] == [0, 16]
    assert [m.trajectory_id for m in starts] == [0, 1, 0]
    assert starts[2].reverse
    assert not starts[2].relative
    assert end_of(commands) == pytest.approx(18.0 + 16.0)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("hover 1 2", "one of takeoff HEIGHT DURATION"),
        ("takeoff 1", "takeoff HEIGHT DURATION"),
        ("takeoff up 2", "takeoff HEIGHT DURATION"),
        ("takeoff 1 0", "a duration > 0"),
        ("goto 1 2 3 0", "goto X Y Z YAW DURATION"),
        ("goto nan 2 3 0 1", "goto X Y Z YAW DURATION"),
        ("trajectory", "trajectory FILE"),
        ("trajectory eight.csv timescale=-1", "trajectory FILE"),
        ("trajectory missing.csv", "cannot read the trajectory"),
    ],
)
def test_a_wrong_command_is_told_by_file_and_place(tmp_path, words, named):
    rows = np.zeros((100, 9))
    rows[:, 0] = 0.01 * np.arange(100)
    rows[:, 8] = 4.0
    file = archive(tmp_path, rows, "pid", command_t=np.array([0.1]), command=np.array([words]))
    with pytest.raises(InputError) as told:
        vf.load(file)
    assert named in str(told.value)
    assert "missing.csv" in str(told.value) or "command[0]" in str(told.value)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"command_t": None}, "command_t: missing"),
        ({"command_t": np.array([1.0])}, "as many as command_t"),
        ({"command_t": np.array([1.0, np.nan, 2.0, 3.0])}, "command[1]: expected a time"),
        ({"command": np.array([1.0, 2.0, 3.0, 4.0])}, "expected texts"),
        ({"command": None, "command_t": None}, "or command and command_t"),
        ({"pos": np.full((1850, 3), 1000.0)}, "position: typical size 1732"),
        ({"t": 1000.0 * np.arange(1850)}, "expected s"),
        ({"vbat": np.full(185, 4100.0)}, "mV as vbat_mV"),
        ({"motors": np.full((925, 4), 40000.0)}, "motors_u16"),
    ],
)
def test_a_wrong_field_is_told(tmp_path, changes, named):
    rows = np.zeros((1850, 9))
    rows[:, 0] = 0.01 * np.arange(1850)
    rows[:, 8] = 4.0
    eight(tmp_path / "eight.csv")
    file = archive(tmp_path, rows, "pid", **changes)
    with pytest.raises(InputError) as told:
        vf.load(file)
    assert named in str(told.value)
    assert "flight.npz" in str(told.value)
