"""Fault campaigns and validations as pages, from the JSON files that they leave."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

from crazyarena.bounded_read import read_json
from crazyarena.errors import InputError
from crazyarena.runner.records.pages.charts import dots
from crazyarena.runner.records.pages.page import page, section, table

_MOST_PICTURE = 1_900_000  # bytes: in base64 it still fits into a mail
_MOST_ROWS = 3000


def campaign_page(file: Path) -> str:
    """The page of ``campaign.json``; raises InputError if it is none."""
    document, flights = _read(file)
    summary = [row for row in document.get("summary", []) if isinstance(row, dict)]
    safe = sum(bool(flight.get("safe")) for flight in flights)
    parts = [f'<p class="lead">{safe} of {len(flights)} flights ended in a safe state.</p>']
    if summary:
        names = list(summary[0])
        parts.append(
            section("Faults", table(names, [[row.get(name) for name in names] for row in summary]))
        )
    for label, key, zero in (
        ("furthest beyond the hard fence [m]; left of the line: inside", "excursion", 0.0),
        ("from the fault to motors off [s]", "safe_after", 0.0),
    ):
        rows: dict[str, list[tuple[float, str]]] = {}
        for flight in flights:
            value = flight.get(key)
            if isinstance(value, int | float):
                style = "s2" if flight.get("safe") else "s0"
                rows.setdefault(str(flight.get("fault")), []).append((float(value), style))
        if rows:
            parts.append(section(label, dots(label, list(rows.items()), zero)))
    parts.append(section("Flights", _flights(flights, [not f.get("safe") for f in flights])))
    return page(str(document.get("campaign", "Fault campaign")), *parts)


def validate_page(file: Path) -> str:
    """The page of ``validate.json`` with the picture beside it; raises InputError if it is none."""
    document, flights = _read(file)
    parts = []
    found = document.get("medians")
    if isinstance(found, dict) and all(isinstance(group, dict) for group in found.values()):
        keys = list(dict.fromkeys(key for group in found.values() for key in group))
        rows = [(key, *(group.get(key) for group in found.values())) for key in keys]
        parts.append(section("Medians", table(("", *found), rows)))
    parts.append(section("Flights", _flights(flights, [])))
    picture = file.with_suffix(".png")
    if picture.is_file() and picture.stat().st_size <= _MOST_PICTURE:
        encoded = base64.b64encode(picture.read_bytes()).decode()
        image = f'<img alt="every flight" src="data:image/png;base64,{encoded}">'
        parts.append(section("Paths", image))
    return page(f"{document.get('vehicle', 'vehicle')} against real flights", *parts)


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
    return table(names, rows, ["bad" if b else "" for b in bad[:_MOST_ROWS]])
