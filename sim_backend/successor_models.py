"""Parameters of the vehicles that lsy_drone_racing simulates: read, checked, as published."""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from crazyarena.errors import InputError
from crazyarena.levels.values import Number

_FILE = Path(__file__).with_suffix(".toml")
GRAVITY = 9.81
MIXING = ((-1.0, -1.0, 1.0, 1.0), (-1.0, 1.0, 1.0, -1.0), (-1.0, 1.0, -1.0, 1.0))
"""Signs of the torques that the four motors make about x, y and z."""

_Above = Annotated[Number, Field(gt=0.0)]
_Three = Annotated[tuple[Number, ...], Field(min_length=3, max_length=3)]
_Four = Annotated[tuple[Number, ...], Field(min_length=4, max_length=4)]


class Model(BaseModel):
    """One vehicle; SI units, rotor speeds in rpm, polynomials in ascending powers."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    mass: _Above
    L: _Above
    """m, of the rotors from the centre along x and along y."""
    J: Annotated[tuple[_Above, ...], Field(min_length=3, max_length=3)]
    drag: Annotated[tuple[Annotated[Number, Field(le=0.0)], ...], Field(min_length=3, max_length=3)]
    """N per m/s along the body's axes, negative."""
    thrust_min: _Above
    """N a motor"""
    thrust_max: _Above
    pwm_min: _Above
    pwm_max: _Above
    rpm2thrust: _Three
    rpm2torque: _Three
    thrust2torque: _Above
    rotor_dyn_coef: _Four
    """Speeding up: 1/s and 1/(s rpm); slowing down: the same."""
    rotor_dyn_coef_simple: Number
    thrust_dyn_coef: Number
    vmotor2thrust: _Four
    vmotor2torque: _Four
    vmotor2rpm: Annotated[tuple[Number, ...], Field(min_length=2, max_length=2)]
    prop_radius: _Above
    prop_inertia: _Above
    controller_mass: _Above
    """kg, what the controller on board takes the vehicle for."""
    fits: dict[str, dict[str, Number | tuple[Number, ...]]]

    @property
    def inertia(self) -> NDArray[np.float64]:
        """(3, 3) kg m^2"""
        return np.diag(self.J)


@cache
def model(name: str) -> Model:
    """A vehicle by its published name, e.g. ``cf21B_500``; raises InputError for others."""
    with _FILE.open("rb") as stream:
        table = tomllib.load(stream)
    if name not in table:
        raise InputError(f"drone model '{name}': unknown; known are {', '.join(table)}")
    return Model.model_validate(table[name])


def load_params(physics: str, name: str) -> dict[str, Any]:
    """The dictionary that ``drone_models.core.load_params`` gives: fresh arrays on every call.

    Raises
    ------
    KeyError: no such vehicle, or no such kind of dynamics.
    """
    try:
        chosen = model(name)
    except InputError as error:
        raise KeyError(str(error)) from None
    if physics != "first_principles" and physics not in chosen.fits:
        raise KeyError(f"dynamics '{physics}': unknown")
    params: dict[str, Any] = {
        key: np.array(value) if isinstance(value, tuple) else value
        for key, value in chosen.model_dump(
            exclude={"J", "drag", "fits", "controller_mass"}
        ).items()
    }
    params |= {
        "gravity_vec": np.array([0.0, 0.0, -GRAVITY]),
        "J": chosen.inertia,
        "J_inv": np.linalg.inv(chosen.inertia),
        "mixing_matrix": np.array(MIXING),
        "drag_matrix": np.diag(chosen.drag),
    }
    for key, value in chosen.fits.get(physics, {}).items():
        params[key] = np.array(value) if isinstance(value, tuple) else value
    return params
