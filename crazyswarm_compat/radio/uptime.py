"""Notices that a vehicle was restarted, by the time stamps of its log data.

They count the milliseconds since it was switched on, so that after a restart they begin anew. Only
if nothing was heard for longer than it had been on can they have grown all the same; then they stay
too low for the session's clock. Whatever delays them, a busy computer or what waited in the vehicle
while it was out of reach, keeps their order.
"""

from __future__ import annotations

_TICKS = 1 << 24  # ms, after which stamps begin anew by themselves
_DELAY = 2000.0  # ms by which links delay and clocks drift apart; a vehicle boots no faster
_AHEAD = 60_000.0  # ms by which stamps never run ahead of the clock
_SURE = 15  # stamps in a row that must be too low: more than wait in a vehicle


class Uptime:
    """Of one vehicle, over any number of connections."""

    def __init__(self) -> None:
        self._last: tuple[int, float] | None = None
        self._booted = 0.0
        self._low = 0

    def restarted(self, stamp: int, now: float) -> bool:
        """Note a stamp (ms modulo 2^24) that came at ``now`` s; whether it shows that the vehicle
        was restarted. Each restart is told once."""
        booted, last = (1e3 * now - stamp) % _TICKS, self._last
        self._last = stamp, now
        if last is None:
            self._booted = booted
            return False
        gap = 1e3 * (now - last[1])
        # Time that has gone on by more than the clock's is time that has gone back.
        back = (stamp - last[0]) % _TICKS > gap + _AHEAD
        if not back and abs(_apart(booted, self._booted)) <= _DELAY:
            self._booted, self._low = booted, 0
            return False
        if self._low or gap > last[0]:
            self._low += 1
        if not back and self._low < _SURE:
            return False
        self._booted, self._low = booted, 0
        return True


def _apart(a: float, b: float) -> float:
    """ms from ``b`` to ``a``, the short way round."""
    return (a - b + 0.5 * _TICKS) % _TICKS - 0.5 * _TICKS
