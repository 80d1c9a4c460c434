"""For how long something has been so."""

from __future__ import annotations


class Lasting:
    """A condition that counts only once it has held for a while without a break."""

    __slots__ = ("_since",)

    def __init__(self) -> None:
        self._since: float | None = None

    def update(self, holds: bool, now: float) -> float | None:
        """s for which the condition has held up to ``now``; None if it does not."""
        if not holds:
            self._since = None
            return None
        if self._since is None:
            self._since = now
        return now - self._since
