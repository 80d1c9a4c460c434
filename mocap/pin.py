"""One publisher at a time: who began is believed."""

from __future__ import annotations

import math

from crazyarena.errors import InputError


class PublisherPin:
    """Believes the publisher that came first, until it is silent for ``release_after`` s.

    Raises
    ------
    InputError: ``release_after`` is not above 0.
    """

    def __init__(self, release_after: float = 0.5) -> None:
        if not release_after > 0.0:
            raise InputError(f"mocap release_after: found {release_after}; need seconds above 0")
        self._release_after = release_after
        self._heard = -math.inf
        self.run = 0

    def believes(self, run: int, now: float) -> bool:
        """Whether a frame of the publisher's run ``run`` counts at ``now``, s."""
        if run != self.run:
            if now - self._heard < self._release_after:
                return False
            self.run = run
        self._heard = now
        return True
