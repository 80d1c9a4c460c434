"""What a level tells a contestant, in the shapes of the 2022 competition.

Entries rely on details: lists that compare equal to literals, randomisation as Munch or an
empty dict (they infer the level from that), disturbances as Munch or None.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from munch import Munch, munchify

from crazyarena.levels.schema import INERTIA_NAMES, STATE_NAMES, GateType, Level

GRAVITY = 9.8
"""m/s^2, as the competition has it."""
KF = 3.16e-10
"""Thrust of one rotor over its speed squared, N/rpm^2."""
KM = 7.94e-12
"""Torque of one rotor over its speed squared, N m/rpm^2."""

_INIT = {
    name: f"init_{name[1:]}_dot" if name in ("vx", "vy", "vz") else f"init_{name}"
    for name in STATE_NAMES
}
_PROP = dict(zip(INERTIA_NAMES, ("M", "Ixx", "Iyy", "Izz"), strict=True))


def level_info(level: Level) -> dict[str, Any]:
    """Everything in ``initial_info`` that follows from the level alone; fresh on every call.

    Left to the runner: ``symbolic_model``, ``symbolic_constraints``, ``constraint_values``,
    ``urdf_dir`` and ``pyb_client``.
    """
    vehicle = level.vehicle
    length = level.episode_length
    x_reference = np.zeros(12)
    x_reference[[0, 2, 4]] = level.goal.position
    return {
        "ctrl_timestep": 1.0 / level.control_frequency,
        "ctrl_freq": level.control_frequency,
        "episode_len_sec": int(length) if length.is_integer() else length,
        "nominal_physical_parameters": {
            "quadrotor_mass": vehicle.mass,
            "quadrotor_ixx_inertia": vehicle.ixx,
            "quadrotor_iyy_inertia": vehicle.iyy,
            "quadrotor_izz_inertia": vehicle.izz,
        },
        "quadrotor_kf": KF,
        "quadrotor_km": KM,
        "x_reference": x_reference,
        "u_reference": np.full(4, vehicle.mass * GRAVITY / 4.0),
        "gate_dimensions": {
            kind.value: {"shape": "square", "height": kind.height, "edge": 0.45}
            for kind in GateType
        },
        # The height is the competition's word; the pillar itself ends at 0.925 m.
        "obstacle_dimensions": {"shape": "cylinder", "height": 1.05, "radius": 0.05},
        "nominal_gates_pos_and_type": [gate.row for gate in level.track.gates],
        "nominal_obstacles_pos": [obstacle.row for obstacle in level.track.obstacles],
        "initial_state_randomization": start_randomization(level),
        "inertial_prop_randomization": inertia_randomization(level),
        "gates_and_obs_randomization": track_randomization(level),
        "disturbances": disturbances(level),
    }


def start_randomization(level: Level) -> dict[str, Any]:
    """Munch of ``init_x: {distrib, low, high}`` ..., or ``{}`` when off."""
    return _ranges(level.randomization.start, _INIT)


def inertia_randomization(level: Level) -> dict[str, Any]:
    """Munch of ``M``, ``Ixx``, ``Iyy``, ``Izz``: ``{distrib, low, high}``, or ``{}`` when off."""
    return _ranges(level.randomization.inertia, _PROP)


def track_randomization(level: Level) -> dict[str, Any]:
    """Munch of ``gates``, ``obstacles``: ``{distrib, low, high}``, or ``{}`` when off."""
    names = {"gates": "gates", "obstacles": "obstacles"}
    return _ranges(level.randomization.gates_and_obstacles, names)


def disturbances(level: Level) -> Munch | None:
    """Munch of lists by mode (``action``, ``dynamics``), or None when there are none."""
    given = level.disturbances
    result: dict[str, Any] = {}
    if given.action is not None:
        std: Any = list(given.action.std)
        if len(set(std)) == 1:
            std = std[0]
        result["action"] = [{"disturbance_func": "white_noise", "std": std}]
    if given.dynamics is not None:
        result["dynamics"] = [
            {
                "disturbance_func": "uniform",
                "low": list(given.dynamics.low),
                "high": list(given.dynamics.high),
            }
        ]
    return munchify(result) if result else None


def _ranges(model: object | None, names: dict[str, str]) -> dict[str, Any]:
    if model is None:
        return {}
    result = Munch()
    for ours, theirs in names.items():
        bounds = getattr(model, ours)
        if bounds is not None:
            result[theirs] = Munch(distrib="uniform", low=bounds[0], high=bounds[1])
    return result
