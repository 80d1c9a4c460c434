"""Simulated time that passes no faster than people can watch."""

from __future__ import annotations

from crazyarena.clock import Clock

_HELD_UP = 1.0  # s; what a flight is late by is then not made up for


class Pace:
    """Holds a simulation back.

    Parameters
    ----------
    times: real time that simulated time may pass with; 0 for as fast as it goes.
    """

    def __init__(self, times: float, wall: Clock) -> None:
        self._times = times
        self._wall = wall
        self._began: tuple[float, float] | None = None

    def begin(self) -> None:
        """Simulated time begins anew."""
        self._began = None

    def keep(self, time: float) -> None:
        """Wait until simulated ``time``, s, is due."""
        if self._times <= 0.0:
            return
        now = self._wall.now()
        if self._began is None:
            self._began = (time, now)
        began, since = self._began
        due = since + (time - began) / self._times
        if due > now:
            self._wall.sleep_until(due)
        elif now - due > _HELD_UP:
            self._began = (time, now)
