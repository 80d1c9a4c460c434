"""Marker arrangements and limits as Crazyswarm's configuration files state them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from crazyarena.errors import InputError
from crazyarena.mocap.tracker import TrackerConfig
from crazyarena.types import Vector


def constellation(name: str, entry: Mapping[str, Any]) -> Vector:
    """Read one marker configuration; return (k, 3) positions in the body frame, m.

    Takes an entry of ``markerConfigurations`` (Crazyswarm, ``crazyflieTypes.yaml``) or of
    ``marker_configurations`` (Crazyswarm2, ``motion_capture.yaml``): ``points`` by number,
    each shifted by ``offset``.

    Raises
    ------
    InputError: a field is missing or is not three finite numbers.
    """
    points = entry.get("points")
    if not isinstance(points, Mapping) or not points:
        raise InputError(f"marker configuration {name}: field points: need points by number")
    shift = _triple(name, "offset", entry.get("offset", (0.0, 0.0, 0.0)))
    rows = [_triple(name, f"points.{key}", points[key]) for key in points]
    stated = entry.get("numPoints", len(rows))
    if stated != len(rows):
        raise InputError(
            f"marker configuration {name}: field numPoints: found {stated}, but {len(rows)} points"
        )
    return np.array(rows) + shift


def limits(name: str, entry: Mapping[str, Any], config: TrackerConfig) -> TrackerConfig:
    """Return ``config`` with the limits of one dynamics configuration of either generation.

    Used are the tilt (the smaller of roll and pitch, rad) and the fitness, which those files
    state as a mean squared distance, m^2.
    """
    tilts = [
        _number(name, key, entry[key])
        for key in ("max_roll", "max_pitch", "maxRoll", "maxPitch")
        if key in entry
    ]
    fits = [
        _number(name, key, entry[key])
        for key in ("max_fitness_score", "maxFitnessScore")
        if key in entry
    ]
    if tilts:
        config = replace(config, max_tilt=min(tilts))
    if fits:
        config = replace(config, max_fitness=float(np.sqrt(fits[0])))
    return config


def _number(name: str, field: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
        raise InputError(f"configuration {name}: field {field}: found {value!r}; need above 0")
    return float(value)


def _triple(name: str, field: str, value: Any) -> Vector:
    try:
        numbers = np.array(value, dtype=float)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise InputError(
            f"marker configuration {name}: field {field}: found {value!r}; need three numbers"
        )
    return numbers
