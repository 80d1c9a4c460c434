"""Notices that a vehicle was restarted, by the time stamps of its log data.

They count the milliseconds since it was switched on, so that after a restart they begin anew. Or,
if nothing was heard for long, go on too low: on the session's clock the moment of switching on
stays where it is, but for what the link delays. What waited in the vehicle while it was out of
reach comes late, and is followed by what is not.
"""

from __future__ import annotations

_TICKS = 1 << 24  # ms, after which stamps begin anew by themselves
_DELAY = 2000.0  # ms by which links delay and clocks drift apart; a vehicle boots no faster
_SURE = 15  # stamps in a row that must be too low: more than wait in a vehicle


class Uptime:
    """Of one vehicle, over any number of connections."""

    def __init__(self) -> None:
        self._last = 0
        self._booted: float | None = None
        self._low = 0

    def restarted(self, stamp: int, now: float) -> bool:
        """Note a stamp (ms modulo 2^24) that came at ``now`` s; whether it shows that the vehicle
        was restarted. Each restart is told once."""
        booted, before = (1e3 * now - stamp) % _TICKS, self._booted
        back = _apart(stamp, self._last) < -_DELAY
        self._last = stamp
        if before is None or abs(_apart(booted, before)) <= _DELAY:
            self._booted, self._low = booted, 0
            return False
        self._low += 1
        if not back and self._low < _SURE:
            return False
        self._booted, self._low = booted, 0
        return True


def _apart(a: float, b: float) -> float:
    """ms from ``b`` to ``a``, the short way round."""
    return (a - b + 0.5 * _TICKS) % _TICKS - 0.5 * _TICKS
