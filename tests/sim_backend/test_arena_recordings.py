"""The arena vehicle does to silence, emergency stop and watchdog what a real firmware did."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.firmware.supervisor import INFO_CAN_FLY, INFO_LOCKED
from tests.recorded import folder

MOTORS_OFF, FIRST_LOCK, LAST_INFO = "motors off", "locked", "last info"
PERIOD = 0.04  # s, of the supervisor
LOG_PERIOD = 0.01  # s


def _flights() -> list[Path]:
    found = []
    for path in sorted(folder("firmware_recordings").glob("*.json")):
        data = json.loads(path.read_text())
        if isinstance(data, dict) and {"columns", "log", "ops"} <= set(data):
            found.append(path)
    return found


FLIGHTS = _flights()


def stream(fleet, seconds):
    setpoint = c.FullState([0, 0, 1], [0, 0, 0], [0, 0, 0], 0.0, [0, 0, 0])
    for _ in range(round(seconds * 50)):
        fleet.send(setpoint, 0)
        yield from wait(fleet, 0.02)


def feed(fleet, seconds):
    for _ in range(round(seconds * 10)):
        fleet.emergency_watchdog(0)
        yield from wait(fleet, 0.1)


def wait(fleet, seconds):
    for _ in range(round(seconds * 100)):
        fleet.external_poses({0: fleet.true_pose(0)})
        fleet.advance(10)
        yield fleet.time, fleet.supervisor_info(0), fleet.rows(0).motors.max()


def perform(fleet, what, seconds):
    """Do what an entry of ``ops`` says and then let ``seconds`` pass."""
    if what.startswith("arm"):
        fleet.send(c.Arm(), 0)
        yield from wait(fleet, 0.1)
        seconds -= 0.1
    if "takeoff" in what:
        fleet.send(c.Takeoff(1.0, 2.0), 0)
    elif what.startswith("emergency"):
        fleet.send(c.Emergency(), 0)
    if what.startswith("stream"):
        yield from stream(fleet, seconds)
    elif what.startswith("feed"):
        yield from feed(fleet, seconds)
    else:
        yield from wait(fleet, seconds)


def delays(times, info, thrust, event):
    """When, after the event (s), the motors stopped and the vehicle was locked."""
    info = np.asarray(info, dtype=int)
    after = times >= event
    off = after & (info & INFO_CAN_FLY == 0) & (thrust == 0.0)
    locked = after & (info & INFO_LOCKED != 0)
    return {
        MOTORS_OFF: times[off][0] - event,
        FIRST_LOCK: times[locked][0] - event,
        LAST_INFO: int(info[-1]),
    }


@pytest.mark.parametrize("path", FLIGHTS, ids=lambda path: path.stem)
def test_the_vehicle_stops_and_locks_as_recorded(path):
    data = json.loads(path.read_text())
    columns = [data["columns"].index(n) for n in ("t", "supervisor.info", "stabilizer.thrust")]
    log = np.array([[float(row[i]) for i in columns] for row in data["log"]])
    ops = [(float(t), what) for t, what in data["ops"]]
    stops = [t for t, what in ops if what.startswith(("silence", "emergency", "stop feeding"))]
    if not stops:
        pytest.skip("nothing stops this vehicle")
    recorded = delays(log[:, 0], log[:, 1], log[:, 2], stops[0])

    fleet = ArenaFleet([[0.0, 0.0, 0.0]])
    for _ in wait(fleet, 2.0):
        pass
    start = fleet.time - ops[0][0]
    rows = []
    for (t, what), (following, _) in pairwise(ops):
        rows.extend(perform(fleet, what, following - t))
    table = np.array(rows)
    found = delays(table[:, 0] - start, table[:, 1], table[:, 2], stops[0])

    # The feeding at 10 Hz and the stream at 50 Hz end somewhere before the note of it.
    slack = 0.1 if any(what.startswith("feed") for _, what in ops) else 0.02
    for name in (MOTORS_OFF, FIRST_LOCK):
        assert found[name] == pytest.approx(recorded[name], abs=slack + PERIOD + 3 * LOG_PERIOD), (
            name
        )
    assert found[LAST_INFO] == recorded[LAST_INFO]
    # Nothing brings it back.
    later = table[:, 0] - start > stops[0] + found[FIRST_LOCK]
    assert (table[later, 2] == 0.0).all()
