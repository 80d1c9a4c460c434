"""Vehicle files to :class:`~.schema.Vehicle`, with errors that name file, line and field."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Sequence
from pathlib import Path

import yaml

from crazyarena.errors import InputError
from crazyarena.levels.document import Node, read
from crazyarena.levels.fields import assign, assignment, validate
from crazyarena.sim_backend.vehicles.schema import Vehicle

DEFAULT_VEHICLE = "cf21plus"
_FOLDER = Path(__file__).parent


def shipped_vehicles() -> tuple[str, ...]:
    """Names that :func:`load_vehicle` knows without a path."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.yaml")))


def load_vehicle(
    name_or_file: str | os.PathLike[str] = DEFAULT_VEHICLE,
    overrides: Sequence[str] = (),
    *,
    folder: Path | None = None,
) -> Vehicle:
    """Load a shipped vehicle model by name, or one of your own by path.

    Parameters
    ----------
    name_or_file: ``cf21plus`` and the like (:func:`shipped_vehicles`), or a path.
    overrides: ``body.mass=0.035``: single fields, with the value in YAML. A bare value replaces
        that of the file and is known exactly; ``rotors.lag_up.spread=0.1`` sets a spread.
    folder: where a relative path starts, the present folder by default.

    Raises
    ------
    InputError: naming file, line, field, what was found and what is allowed.
    """
    text = os.fspath(name_or_file)
    if text in shipped_vehicles():
        path, shown = _FOLDER / f"{text}.yaml", f"{text}.yaml"
    else:
        path, shown = _existing(text, folder), text
    root = read(path, shown)
    if not isinstance(root.value, dict):
        root.expected("a vehicle as a mapping of fields (see docs/fidelity.md)")
    for override in overrides:
        keys, value = assignment(override)
        root = assign(root, keys, value)
    if "name" not in root.value:
        stem = re.sub(r"[^A-Za-z0-9_.-]", "_", path.stem).lstrip("_.-")[:64] or "vehicle"
        root = assign(root, ["name"], Node(stem, "name", root.source))
    return validate(root, Vehicle)


def dump_vehicle(vehicle: Vehicle) -> str:
    """YAML text of a vehicle with every field written out; loads back as an equal vehicle."""
    data = vehicle.model_dump(mode="json", by_alias=True)
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=96)


def _existing(text: str, folder: Path | None) -> Path:
    path = Path(text).expanduser()
    if folder is not None and not path.is_absolute():
        path = folder / path
    try:
        if path.exists():
            return path
    except (OSError, ValueError):
        pass
    names = shipped_vehicles()
    bare = text.removesuffix(".yaml").removesuffix(".yml")
    close = [bare] if bare in names else difflib.get_close_matches(text, names, n=1)
    hint = f"; did you mean '{close[0]}'?" if close else ""
    shown = text if len(text) <= 200 else text[:197] + "..."
    raise InputError(f"{shown}: no such vehicle file (shipped vehicles: {', '.join(names)}){hint}")
