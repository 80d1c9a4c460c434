"""Rule sets: what qualifies, what is measured, and what it is worth. YAML, own or shipped."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from crazyarena.errors import InputError
from crazyarena.levels.document import parse, read_text
from crazyarena.levels.fields import validate
from crazyarena.levels.values import Model, Number, invalid

_FOLDER = Path(__file__).parent / "rules"

Text = Annotated[str, Field(min_length=1, max_length=80)]
Points = Annotated[Number, Field(ge=0.0, le=1e6)]


class Lives(StrEnum):
    """How long a controller object lives."""

    LEVEL = "level"
    """Through all episodes of a level, as in 2022."""
    EPISODE = "episode"


class Which(StrEnum):
    """Which episodes of a level."""

    LAST = "last"
    ALL = "all"
    SUCCESSFUL = "successful"


class Success(StrEnum):
    """What a success is."""

    CLEAN = "clean"
    """Completed, without collision and violation."""
    COMPLETED = "completed"
    """Completed, whatever was touched on the way."""


class Measure(StrEnum):
    """What is measured of an episode."""

    FLIGHT_TIME = "flight_time"
    """s, as the contract's own competition counts it."""
    TOTAL_TIME = "total_time"
    """s, flight and learning."""
    LEARNING_TIME = "learning_time"
    """s of wall time."""
    COMPUTE_TIME = "compute_time"
    """ms of wall time an answer, 99th percentile."""
    GATES = "gates"
    """Gates passed."""
    SUCCESS = "success"
    """1 for a success, 0 otherwise."""


class Statistic(StrEnum):
    """What many episodes come to."""

    MEAN = "mean"
    MEDIAN = "median"
    SUM = "sum"
    BEST = "best"
    WORST = "worst"


class Best(StrEnum):
    """Which value wins."""

    LOWEST = "lowest"
    HIGHEST = "highest"


class Ties(StrEnum):
    """What teams of equal value get."""

    SAME = "same"
    """All of them the points of the better place."""
    SHARED = "shared"
    """The mean of the points of the places that they take."""


class Overall(StrEnum):
    """What decides over all levels."""

    POINTS = "points"
    """The sum of points."""
    VALUE = "value"
    """Levels qualified in, then the sum of the (first) category's values."""


class Qualification(Model):
    """Who takes part in the categories of a level."""

    episodes: Which = Which.ALL
    success: Success = Success.CLEAN
    rate: Annotated[Number, Field(ge=0.0, le=1.0)] = 0.0
    """Share of those episodes that must be successes."""

    @model_validator(mode="after")
    def _not_of_successes(self) -> Self:
        if self.episodes is Which.SUCCESSFUL:
            raise invalid("expected last or all, found 'successful'", "episodes")
        return self


class Category(Model):
    """One ranking of a level."""

    name: Text
    measure: Measure = Measure.FLIGHT_TIME
    episodes: Which = Which.SUCCESSFUL
    statistic: Statistic = Statistic.MEAN
    best: Best = Best.LOWEST
    points: Annotated[tuple[Points, ...], Field(max_length=100)] = ()
    """Of the first, second, ... place."""
    weight: Annotated[Number, Field(ge=0.0, le=1e6)] = 1.0

    @model_validator(mode="after")
    def _points_fall(self) -> Self:
        if any(a < b for a, b in zip(self.points, self.points[1:], strict=False)):
            raise invalid("expected points that do not grow from place to place", "points")
        return self


class Rules(Model):
    """A rule set."""

    name: Text
    controller: Lives = Lives.EPISODE
    qualification: Qualification = Field(default_factory=Qualification)
    categories: Annotated[tuple[Category, ...], Field(min_length=1, max_length=20)]
    ties: Ties = Ties.SAME
    overall: Overall = Overall.POINTS

    @model_validator(mode="after")
    def _something_decides(self) -> Self:
        names = [category.name for category in self.categories]
        if len(set(names)) < len(names):
            raise invalid("two categories have one name", "categories")
        if self.overall is Overall.POINTS and not any(c.points for c in self.categories):
            raise invalid(
                "expected points in a category, found none. Add points, or overall: value",
                "categories",
            )
        return self


def shipped_rules() -> tuple[str, ...]:
    """Names that :func:`load_rules` knows without a path."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.yaml")))


def load_rules(name_or_path: str) -> tuple[Rules, str]:
    """Load a shipped rule set by name, or a file.

    Returns
    -------
    The rules and their text.

    Raises
    ------
    InputError: naming file, line, field, what was found and what is allowed.
    """
    shipped = name_or_path in shipped_rules()
    path = _FOLDER / f"{name_or_path}.yaml" if shipped else Path(name_or_path)
    if not path.is_file():
        raise InputError(
            f"--rules {name_or_path}: no such file (shipped: {', '.join(shipped_rules())})"
        )
    shown = f"{name_or_path}.yaml" if shipped else name_or_path
    text = read_text(path, shown)
    return parse_rules(text, shown), text


def parse_rules(text: str, source: str = "rules") -> Rules:
    """Rules from their text; raises InputError as :func:`load_rules`."""
    root = parse(text, source)
    if not isinstance(root.value, dict):
        root.expected("a rule set (name, qualification, categories)")
    return validate(root, Rules)
