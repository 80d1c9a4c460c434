"""Two groups of flights beside each other, on a page."""

from __future__ import annotations

import numpy as np

from crazyarena.errors import InputError
from crazyarena.runner.records.compare import Comparison
from crazyarena.runner.records.compare_figure import title
from crazyarena.runner.records.pages.charts import Line, chart
from crazyarena.runner.records.pages.flown import read_flown, scene
from crazyarena.runner.records.pages.page import page, section, table, text, wide

_MOST_PATHS = 6  # of a group, in the 3-D view


def comparison(found: Comparison) -> str:
    """View, charts and figures of a comparison."""
    s = found.summary()
    a, b = found.names
    rows = [
        ("flights", *s["flights"]),
        ("vehicle", *s["vehicles"]),
        ("duration, s", *s["duration"]),
        ("spread, cm", *_spread(found)),
        ("missed ticks", *s["missed_ticks"]),
    ]
    apart = [
        ("mean distance", f"{100 * s['mean_distance']:.2f} cm"),
        ("largest distance", f"{100 * s['max_distance']:.2f} cm"),
        ("RMSE x, y, z", ", ".join(f"{100 * v:.2f}" for v in s["rmse"]) + " cm"),
        ("gate times", ", ".join(f"{1e3 * v:+.0f}" for v in s["gate_time_difference"]) + " ms"),
    ]
    paths = []
    for group, colour in zip(found.groups, ("c1", "c0"), strict=True):
        for each in group[:_MOST_PATHS]:
            try:
                paths.append((read_flown(each.file), colour))
            except InputError:
                continue
    parts = [f"<p>{text(title(found))}</p>"]
    if paths:
        parts.append(scene(paths))
    charts = []
    for i, axis in enumerate("xyz"):
        lines = [
            Line(a, found.time, found.mean_a[:, i], "s1"),
            Line(b, found.time, found.mean_b[:, i], "s0"),
        ]
        charts.append(chart(f"{axis} [m]", lines))
    apart_line = Line("distance of the mean paths", found.time, 100 * found.distance, "s4")
    top = max(1.0, 110 * float(np.max(found.distance)))
    charts.append(chart("[cm]", [apart_line], limits=(0.0, top)))
    return "".join([*parts, wide(*charts), table(("", a, b), rows), table((), apart)])


def _spread(found: Comparison) -> list[float | None]:
    """Of each group, cm; one flight alone has none."""
    spread, flights = found.summary()["spread"], found.summary()["flights"]
    return [100 * far if many > 1 else None for far, many in zip(spread, flights, strict=True)]


def compare_page(found: Comparison) -> str:
    """The page of a comparison."""
    a, b = found.names
    body = section("Comparison", comparison(found)) + f"<p>{text(found.advice())}</p>"
    return page(f"{b} against {a}", body)
