"""The option of whatever draws the episodes that it flies."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer


class FigureChoice(StrEnum):
    """As :class:`crazyarena.runner.records.drawing.Figures`, which costs an import."""

    AUTO = "auto"
    ALL = "all"
    FAILURES = "failures"
    NONE = "none"


def figure_choice(
    figure: Annotated[
        FigureChoice,
        typer.Option(
            help="Which episodes get a PNG. auto: all, but of more than ten the first and up to "
            "four failures, and all on one sheet."
        ),
    ] = FigureChoice.AUTO,
    no_figure: Annotated[bool, typer.Option("--no-figure", help="As --figure none.")] = False,
) -> str:
    """A group of options: which episodes are drawn."""
    return FigureChoice.NONE if no_figure else figure
