"""Which positioning decks a vehicle carries, by its own parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from crazyarena.errors import BackendError

_DECKS = (
    ("lighthouse", ("deck.bcLighthouse4",)),
    ("LPS", ("deck.bcLoco", "deck.bcDWM1000")),
    ("flow", ("deck.bcFlow2", "deck.bcFlow")),
)


@dataclass(frozen=True, slots=True)
class Positioning:
    """decks: by which the vehicle knows its place, most useful first."""

    decks: tuple[str, ...] = ()

    @property
    def relative(self) -> bool:
        """Nothing on board knows the place itself: it is counted from where the estimator began,
        and drifts."""
        return self.decks == ("flow",)

    def __str__(self) -> str:
        return " and ".join(self.decks) or "none"


def positioning(get_param: Callable[[str], float]) -> Positioning:
    """Ask a vehicle; ``get_param(name)`` raises BackendError for a parameter that it lacks."""

    def fitted(name: str) -> bool:
        try:
            return bool(get_param(name))
        except BackendError:
            return False

    return Positioning(tuple(deck for deck, names in _DECKS if any(map(fitted, names))))
