"""The fault campaign as a table, a figure and a JSON file."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from rich.table import Table

from crazyarena import whole_file
from crazyarena.runner.campaign.faults import ALL_FAULTS
from crazyarena.runner.campaign.outcome import Outcome, summarise

SIMULATED = "Fault campaign in simulation"
UDP = "Fault campaign over the virtual radio, in real time"


def table(outcomes: Sequence[Outcome], title: str = SIMULATED) -> Table:
    """One row per fault."""
    view = Table(title=title)
    for name in ("fault", "flights", "safe", "landed", "cut", "taken over"):
        view.add_column(name, justify="left" if name == "fault" else "right", no_wrap=True)
    view.add_column("worst outside fence, m", justify="right")
    view.add_column("time to safe, median / worst, s", justify="right")
    for row in summarise(outcomes):
        outside = max(0.0, row["worst excursion"])
        view.add_row(
            row["fault"],
            *(str(row[name]) for name in ("flights", "safe", "landed", "cut", "taken over")),
            f"{outside:.2f}",
            f"{row['median time']:.1f} / {row['worst time']:.1f}",
        )
    return view


def write_json(path: Path, outcomes: Sequence[Outcome], title: str = SIMULATED) -> None:
    """Every flight with its events; infinities become null."""

    def plain(value: object) -> object:
        if isinstance(value, float):
            return value if math.isfinite(value) else None
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [plain(item) for item in value]
        return value

    document = {
        "campaign": title,
        "summary": plain(summarise(outcomes)),
        "flights": [plain(asdict(outcome)) for outcome in outcomes],
    }
    whole_file.write_whole(path, json.dumps(document, indent=1) + "\n")


def save_figure(path: Path, outcomes: Sequence[Outcome], title: str = SIMULATED) -> None:
    """Every flight as a dot: how far outside the fence, and how long until safe, per fault."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(outcome.fault for outcome in outcomes))
    colours = {"software": "tab:blue", "link": "tab:orange", "physical": "tab:red"}
    figure = Figure(figsize=(10, 1.5 + 0.28 * len(names)), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    left, right = figure.subplots(1, 2, sharey=True)
    for row, name in enumerate(names):
        mine = [outcome for outcome in outcomes if outcome.fault == name]
        colour = colours[ALL_FAULTS[name].kind]
        left.plot([o.excursion for o in mine], [row] * len(mine), ".", color=colour, alpha=0.5)
        times = [o.safe_after for o in mine if math.isfinite(o.safe_after)]
        right.plot(times, [row] * len(times), ".", color=colour, alpha=0.5)
    left.axvline(0.0, color="black", linewidth=1.0)
    left.axvline(0.1, color="black", linewidth=1.0, linestyle=":")
    left.set_xlabel("furthest beyond the hard fence, m (negative: inside)")
    right.set_xlabel("from the fault to motors off, s")
    left.set_yticks(range(len(names)), names)
    left.invert_yaxis()
    for kind, colour in colours.items():
        right.plot([], [], ".", color=colour, label=kind)
    right.legend(title="fault of", fontsize="small")
    whole_file.save_figure(figure, path, dpi=130)
