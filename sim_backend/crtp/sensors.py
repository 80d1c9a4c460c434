"""Log variables of sensors and decks that are not part of the simulated firmware, but follow from
what is simulated."""

from __future__ import annotations

import math
from collections.abc import Callable

from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.crtp.toc import Table
from crazyarena.sim_backend.decks import Flow, Lighthouse
from crazyarena.sim_backend.firmware import layout as la
from crazyarena.sim_backend.physics.arena_plant import AB_ROTOR
from crazyarena.sim_backend.physics.competition_step import B_POS

Getter = Callable[[], float]

_RAD = math.pi / 180.0
_RPM = 30.0 / math.pi
_SEA_LEVEL = 1013.25  # mbar
_ROOM = 25.0  # deg C
_STATIONS = 0b11  # lighthouse base stations 0 and 1
_TO_ESTIMATOR = 2  # lighthouse.status: its data reach the estimator
_LASER_MOST = 4000  # mm
_NO_RANGE = 32767  # mm


def sensor_getters(fleet: ArenaFleet, index: int, table: Table) -> dict[str, Getter]:
    """Functions that read them, by full name. The recorded simulation build has no sensors."""
    if table is Table.RECORDED:
        return {}
    rows, deck = fleet.rows(index), fleet.decks.on(index)
    body, state = rows.body, rows.state

    def height() -> float:
        return float(body[B_POS + 2])

    def pressure() -> float:
        # The barometric formula of the standard atmosphere.
        return float(_SEA_LEVEL * (1.0 - height() / 44330.8) ** 5.2559)

    found: dict[str, Getter] = {
        "baro.asl": height,
        "baro.temp": lambda: _ROOM,
        "baro.pressure": pressure,
        "ctrlMel.r_roll": lambda: _RAD * state[la.ST_GYRO],
        "ctrlMel.r_pitch": lambda: -_RAD * state[la.ST_GYRO + 1],
        "ctrlMel.r_yaw": lambda: _RAD * state[la.ST_GYRO + 2],
        "ctrlMel.accelz": lambda: state[la.ST_ACCEL + 2],
        "stabilizer.rtStab": lambda: 1000.0,
    }
    if table is Table.CF21_BRUSHLESS:
        # Only its speed controllers tell how fast they turn.
        speed = _RPM * fleet.models[index].rotor_speed

        def turns(motor: int) -> Getter:
            return lambda: speed * body[AB_ROTOR + motor]

        found |= {f"motor.m{motor + 1}rpm": turns(motor) for motor in range(4)}
    if isinstance(deck, Flow):

        def ranged() -> float:
            seen = 1e3 * height()
            return seen if seen <= _LASER_MOST else _NO_RANGE

        found["range.zrange"] = ranged
    if isinstance(deck, Lighthouse):
        found["lighthouse.status"] = lambda: _TO_ESTIMATOR
        for name in ("bsAvailable", "bsReceive", "bsActive", "bsGeoVal", "bsCalVal", "bsCalCon"):
            found[f"lighthouse.{name}"] = lambda: _STATIONS

        def placed(axis: int) -> Getter:
            return lambda: float(deck.place[axis])

        for axis, name in enumerate("xyz"):
            found[f"lighthouse.{name}"] = placed(axis)
    return found
