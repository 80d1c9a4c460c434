"""A vehicle drawn from the spread of its model: one of those that one might have."""

from __future__ import annotations

from typing import Any

import numpy as np

from crazyarena.sim_backend.vehicles.schema import Quantity, Vehicle

_LIMIT = 2.0  # standard deviations at which draws are cut


def draw_vehicle(vehicle: Vehicle, rng: np.random.Generator) -> Vehicle:
    """A vehicle with every number that has a spread drawn anew.

    Draws are normal, cut at two standard deviations, in the order of the file's fields: the one
    of a quantity first, then those of its members against each other. ``battery.drawn`` only
    goes up: its spread is a share of the charge.
    """
    data = _drawn(vehicle, rng)
    battery = vehicle.battery.drawn
    gone = battery.value + battery.spread * abs(_normal(rng)) if battery.spread else battery.value
    data["battery"]["drawn"] = {"value": min(gone, 1.0), "from": battery.origin}
    return Vehicle.model_validate(data)


def _drawn(model: Any, rng: np.random.Generator) -> dict[str, Any]:
    data: dict[str, Any] = {}
    for name, field in type(model).model_fields.items():
        key, value = field.alias or name, getattr(model, name)
        if isinstance(value, Quantity):
            data[key] = _quantity(value, rng) if name != "drawn" else value.model_dump()
        elif hasattr(type(value), "model_fields"):
            data[key] = _drawn(value, rng)
        else:
            data[key] = value
    return data


def _quantity(quantity: Quantity[Any], rng: np.random.Generator) -> dict[str, Any]:
    value = quantity.value
    scale = 1.0 + quantity.spread * _normal(rng) if quantity.spread else 1.0
    if isinstance(value, tuple):
        apart = [1.0 + quantity.each * _normal(rng) if quantity.each else 1.0 for _ in value]
        value = tuple(scale * own * number for own, number in zip(apart, value, strict=True))
    else:
        value = scale * value
    return {"value": value, "from": quantity.origin}


def _normal(rng: np.random.Generator) -> float:
    while True:
        draw = float(rng.standard_normal())
        if abs(draw) <= _LIMIT:
            return draw
