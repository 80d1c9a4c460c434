"""Marker arrangements and limits as Crazyswarm's configuration files state them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from crazyarena.errors import InputError
from crazyarena.mocap.tracker import TrackerConfig
from crazyarena.types import Vector

_LONGEST = 1 << 20
# No vehicle carries more markers.
MAX_POINTS = 64


def read_constellations(path: str | Path) -> dict[str, Vector]:
    """Read the marker configurations of a file of either generation; see :func:`constellation`.

    Takes ``crazyflieTypes.yaml`` (Crazyswarm) and ``motion_capture.yaml`` (Crazyswarm2, also below
    ``/motion_capture_tracking: ros__parameters:``); returns (k, 3) positions by name, m.

    Raises
    ------
    InputError: unreadable, no YAML, without marker configurations, or a field of them is wrong.
    """
    path = Path(path)
    document = _yaml(path)
    for key in ("/motion_capture_tracking", "motion_capture_tracking", "ros__parameters"):
        if isinstance(document, Mapping) and isinstance(document.get(key), Mapping):
            document = document[key]
    entries = None
    if isinstance(document, Mapping):
        entries = document.get("marker_configurations", document.get("markerConfigurations"))
    if not isinstance(entries, Mapping) or not entries:
        raise InputError(
            f"{path}: no marker configurations; need marker_configurations or markerConfigurations"
        )
    try:
        return {str(name): constellation(str(name), entry) for name, entry in entries.items()}
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _yaml(path: Path) -> Any:
    import yaml

    class Plain(yaml.SafeLoader):
        """YAML without aliases, a few of which can stand for any number of values."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                mark = self.peek_event().start_mark
                raise yaml.MarkedYAMLError(None, None, "aliases are not read", mark)
            return super().compose_node(parent, index)

    try:
        with path.open("rb") as stream:
            data = stream.read(_LONGEST + 1)
        if len(data) > _LONGEST:
            raise InputError(f"{path}: longer than {_LONGEST} bytes")
        return yaml.load(data, Loader=Plain)  # a SafeLoader
    except OSError as error:
        raise InputError(f"{path}: cannot read it: {error.strerror}") from None
    except yaml.MarkedYAMLError as error:
        at = error.problem_mark
        where = "" if at is None else f"line {at.line + 1}: "
        raise InputError(f"{path}: {where}not YAML: {error.problem}") from None
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(f"{path}: not YAML: {' '.join(str(error).split())[:200]}") from None
    except RecursionError:
        raise InputError(f"{path}: nested too deeply") from None


def constellation(name: str, entry: Mapping[str, Any]) -> Vector:
    """Read one marker configuration; return (k, 3) positions in the body frame, m.

    Takes an entry of ``markerConfigurations`` (Crazyswarm, ``crazyflieTypes.yaml``) or of
    ``marker_configurations`` (Crazyswarm2, ``motion_capture.yaml``): ``points`` by number,
    each shifted by ``offset``.

    Raises
    ------
    InputError: a field is missing or is not three finite numbers.
    """
    if not isinstance(entry, Mapping):
        raise InputError(f"marker configuration {name}: found {str(entry)[:60]!r}; need fields")
    points = entry.get("points")
    if isinstance(points, Mapping) and len(points) > MAX_POINTS:
        raise InputError(
            f"marker configuration {name}: field points: {len(points)} of them; at most "
            f"{MAX_POINTS}"
        )
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
    except (TypeError, ValueError, OverflowError):
        numbers = np.empty(0)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise InputError(
            f"marker configuration {name}: field {field}: found {str(value)[:80]}; need three "
            "numbers"
        )
    return numbers
