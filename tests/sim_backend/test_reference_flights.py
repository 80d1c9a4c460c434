"""Whole flights of the 2022 pipeline, flown again with the recorded commands."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import commands
from crazyarena.sim_backend.competition import CompetitionWorld
from crazyarena.sim_backend.trace import NO_CONTACT, TR_CONTACT, TR_POS
from tests.recorded import arrays, folder

FLIGHTS = sorted(folder("reference_flights").glob("*.npz"))
_VERBS = {
    "FULLSTATE": lambda args: commands.FullState(*args[:5]),
    "TAKEOFF": lambda args: commands.Takeoff(*args[:2]),
    "LAND": lambda args: commands.Land(*args[:2]),
    "STOP": lambda _: commands.Stop(),
    "GOTO": lambda args: commands.GoTo(*args[:4]),
    "NOTIFYSETPOINTSTOP": lambda _: commands.NotifySetpointsStop(),
    "NONE": lambda _: None,
    "FINISHED": lambda _: None,
}


@dataclass
class UndisturbedDraw:
    """The world that a recording says it was flown in."""

    start: np.ndarray
    mass: float
    inertia: np.ndarray
    gates: np.ndarray
    obstacles: np.ndarray

    @staticmethod
    def tick_noise(n_ticks: int) -> np.ndarray:
        return np.zeros((n_ticks, 7))


def recorded_world(flight: dict) -> tuple[dict, UndisturbedDraw]:
    meta = json.loads(str(flight["meta_json"]))
    gates = [[*g[:6], 0.0 if g[2] > 0.75 else 1.0] for g in meta["gates"]]
    obstacles = [[*o[:3], 0.0, 0.0, 0.0] for o in meta["obstacles"]]
    draw = UndisturbedDraw(
        flight["initial_state"],
        meta["mass"],
        np.array(meta["inertia"]),
        np.array(gates, dtype=float).reshape(-1, 7),
        np.array(obstacles, dtype=float).reshape(-1, 6),
    )
    return meta, draw


def undisturbed() -> list[Path]:
    return [p for p in FLIGHTS if not json.loads(str(arrays(p)["meta_json"]))["disturbed"]]


def test_there_are_flights():
    assert undisturbed()


@pytest.mark.parametrize("path", undisturbed(), ids=lambda p: p.stem)
def test_position_from_take_off_to_touch_down(path):
    flight = arrays(path)
    _, draw = recorded_world(flight)
    world = CompetitionWorld(control_rate=1.0 / flight["t"][0])
    world.reset(draw)
    flown, contact = [], []
    orders = json.loads(str(flight["commands_json"]))[: len(flight["t"])]
    for k, (_, verb, args) in enumerate(orders):
        command = _VERBS[verb](args)
        if command is not None:
            world.send(command)
        world.clock.sleep_until(float(flight["t"][k]))
        last = world.poll()[-1]
        flown.append(last[TR_POS : TR_POS + 3])
        contact.append(last[TR_CONTACT] != NO_CONTACT)
    world.close()

    truth = flight["state"][: len(flown)][:, [0, 2, 4]]
    airborne = truth[:, 2] > 0.03
    assert airborne.any()
    take_off = int(np.argmax(airborne))
    touched = np.flatnonzero(flight["collision"][take_off : len(flown)])
    touch_down = take_off + int(touched[0]) if len(touched) else len(flown)
    error = np.linalg.norm(np.array(flown) - truth, axis=1)[take_off:touch_down]
    rmse = float(np.sqrt((error**2).mean()))
    assert rmse <= 0.01, f"RMSE {rmse:.4f} m"
    assert error.max() <= 0.04, f"maximum {error.max():.4f} m"
    # The same contacts at the same control steps, give or take one.
    ours = np.flatnonzero(contact[take_off:])
    if len(touched):
        assert len(ours)
        assert abs(int(ours[0]) - int(touched[0])) <= 1
    else:
        assert not len(ours)
