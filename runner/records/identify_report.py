"""What an identification found, as tables for a terminal and as plain data."""

from __future__ import annotations

from typing import Any

import numpy as np

from crazyarena.plain_text import shown_line
from crazyarena.runner.records.identify import Identified

_UNITS = {
    "rotors.strength": ("", 1.0),
    "rotors.lag_up": ("ms", 1e3),
    "rotors.lag_down": ("ms", 1e3),
    "battery.resistance": ("Ohm", 1.0),
    "body.drag": ("g/s", 1e3),
}


def tables(result: Identified) -> list[Any]:
    """Rich tables: what was found, what was not, and how well it predicts."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    def table(*columns: str) -> Table:
        shown = Table(box=box.SIMPLE, header_style="bold", pad_edge=False)
        for at, column in enumerate(columns):
            shown.add_column(column, justify="left" if at == 0 else "right", overflow="fold")
        return shown

    found = table("found", "", "before", "spread", "told by")
    for one in result.findings:
        unit, scale = _UNITS[one.name]

        def text(values: tuple[float, ...], scale: float = scale, unit: str = unit) -> str:
            return f"{', '.join(f'{scale * v:.3g}' for v in values)} {unit}".strip()

        found.add_row(
            one.name,
            text(one.value),
            text(one.before),
            f"{100 * one.error:.1f} %",
            f"{one.source}, {one.flights} flight{'s' if one.flights > 1 else ''}",
        )
    kept = table("not told", "why")
    for name, why in result.refused.items():
        kept.add_row(name, why)
    errors = table("flight", "before", "after")
    for name, (before, after) in result.errors.items():
        errors.add_row(escape(shown_line(name)), f"{1e3 * before:.0f} mm", f"{1e3 * after:.0f} mm")
    both = np.median(np.array(list(result.errors.values())), axis=0)
    errors.add_row("median", *(f"{1e3 * value:.0f} mm" for value in both), style="bold")
    return [found, kept, errors]


def summary(result: Identified) -> dict[str, Any]:
    """Every figure as plain data, SI."""
    return {
        "vehicle": result.vehicle.name,
        "found": [
            {
                "name": one.name,
                "value": list(one.value),
                "before": list(one.before),
                "spread": one.error if np.isfinite(one.error) else None,
                "source": one.source,
                "flights": one.flights,
            }
            for one in result.findings
        ],
        "not_told": result.refused,
        "warnings": result.warnings,
        "unseen": result.unseen,
        "rmse": {name: list(pair) for name, pair in result.errors.items()},
    }
