"""Fault campaigns and validations as pages, from the JSON files that they leave."""

from __future__ import annotations

import base64
import math
from pathlib import Path
from typing import Any

from crazyarena.bounded_read import read_json
from crazyarena.errors import InputError
from crazyarena.runner.records.pages.charts import dots
from crazyarena.runner.records.pages.page import folded, page, section, table, wide

_MOST_PICTURE = 1_900_000  # bytes: in base64 it still fits into a mail
_MOST_ROWS = 3000
_SAFE = ("landed", "cut")  # ends of a flight after which nothing moves
# What the names of validate.json mean, in the order of the table.
_MEDIANS = {
    "flights": "flights",
    "rmse": "3-D RMSE, m",
    "aligned": "… with the best clock offset",
    "plane": "horizontal RMSE, m",
    "plane_aligned": "… with the best clock offset",
    "lag": "simulation behind reality, s",
    "takeoff_difference": "take-off later than reality, s",
    "sag_real": "sag of the real battery, V",
    "sag_simulated": "sag of the simulated battery, V",
    "strength": "thrust to hover, of the model's",
    "ideal": "for comparison: perfect tracking, m",
    "delayed": "for comparison: a pure delay, m",
}
_FLIGHT = {
    "name": "flight",
    "rmse": "RMSE m",
    "aligned": "aligned m",
    "plane": "horizontal m",
    "plane_aligned": "… aligned m",
    "axes": "RMSE x, y, z m",
    "offset": "mean offset x, y, z m",
    "duration": "duration s",
    "lag": "lag s",
    "excursion": "beyond the fence m",
    "safe_after": "safe after s",
    "speed": "speed m/s",
    "onset": "fault at s",
}
_CAMPAIGN = {
    "worst excursion": "furthest beyond the fence m (negative: inside)",
    "median time": "until safe s, median",
    "worst time": "… longest",
}


def campaign_page(file: Path) -> str:
    """The page of ``campaign.json``; raises InputError if it is none."""
    document, flights = _read(file)
    summary = [row for row in document.get("summary", []) if isinstance(row, dict)]
    safe = [flight.get("end") in _SAFE for flight in flights]
    style = "good" if all(safe) else "bad"
    told = f"{sum(safe)} of {len(flights)} flights ended in a safe state."
    parts = [f'<p class="lead {style}">{told}</p>']
    if summary:
        names = list(summary[0])
        parts.append(
            section(
                "Faults",
                table(
                    [_CAMPAIGN.get(name, name) for name in names],
                    [[row.get(name) for name in names] for row in summary],
                ),
            )
        )
    for label, key, zero in (
        ("furthest beyond the hard fence [m]; left of the line: inside", "excursion", 0.0),
        ("from the fault to motors off [s]", "safe_after", 0.0),
    ):
        rows: dict[str, list[tuple[float, str]]] = {}
        for flight, good in zip(flights, safe, strict=True):
            value = flight.get(key)
            if isinstance(value, int | float):
                style = "s2" if good else "s0"
                rows.setdefault(str(flight.get("fault")), []).append((float(value), style))
        if rows:
            parts.append(section(label, wide(dots(label, list(rows.items()), zero))))
    order = sorted(range(len(flights)), key=lambda i: (safe[i], -_excursion(flights[i])))
    shown = [flights[i] for i in order]
    parts.append(
        folded(
            f"{len(flights)} flights, unsafe ones and those furthest out first",
            _flights(shown, [not safe[i] for i in order]),
        )
    )
    return page(str(document.get("campaign", "Fault campaign")), *parts)


def validate_page(file: Path) -> str:
    """The page of ``validate.json`` with the picture beside it; raises InputError if it is none."""
    document, flights = _read(file)
    parts = []
    found = document.get("medians")
    if isinstance(found, dict) and all(isinstance(group, dict) for group in found.values()):
        keys = list(dict.fromkeys(key for group in found.values() for key in group))
        keys.sort(key=lambda key: [*_MEDIANS, key].index(key))
        rows = [
            (_MEDIANS.get(key, key), *(group.get(key) for group in found.values())) for key in keys
        ]
        parts.append(section("Medians", table(("", *found), rows)))
    parts.append(section("Flights", _flights(flights, [])))
    picture = file.with_suffix(".png")
    if picture.is_file() and picture.stat().st_size <= _MOST_PICTURE:
        encoded = base64.b64encode(picture.read_bytes()).decode()
        image = f'<img alt="every flight" src="data:image/png;base64,{encoded}">'
        parts.append(section("Paths", image))
    return page(f"{document.get('vehicle', 'vehicle')} against real flights", *parts)


def _excursion(flight: dict[str, Any]) -> float:
    value = flight.get("excursion")
    return float(value) if isinstance(value, int | float) else math.inf


def _read(file: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    document = read_json(file, "report")
    flights = document.get("flights") if isinstance(document, dict) else None
    if not isinstance(flights, list) or not all(isinstance(f, dict) for f in flights):
        raise InputError(f"{file}: field flights: need a list of mappings")
    return document, flights


def _flights(flights: list[dict[str, Any]], bad: list[bool]) -> str:
    """A row a flight; what has many parts is left to the file."""
    plain = [
        {k: v for k, v in flight.items() if not isinstance(v, list | dict) or len(v) <= 3}
        for flight in flights[:_MOST_ROWS]
    ]
    names = list(dict.fromkeys(name for flight in plain for name in flight))
    rows = [[flight.get(name) for name in names] for flight in plain]
    return table(
        [_FLIGHT.get(name, name) for name in names],
        rows,
        ["bad" if b else "" for b in bad[:_MOST_ROWS]],
    )
