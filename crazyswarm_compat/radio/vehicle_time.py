"""When the vehicle made what it tells: its stamps on the session clock.

What has come late was not made late. Of the ways that packets took the shortest is taken for the
usual one, so that a computer or a link that is busy moves nothing in time.
"""

from __future__ import annotations

import math

_TICKS = 1 << 24  # ms, after which stamps begin anew (CRTP log packets)
_DRIFT = 1e-4  # by which a vehicle's clock may be faster or slower than ours
_PATIENCE = 2.0  # s of delay that no packet has; more is another count


class VehicleTime:
    """Of one vehicle."""

    def __init__(self) -> None:
        self._stamp = 0
        self._made = 0.0  # s, of the last stamp, counted on
        self._offset = math.inf

    def made_at(self, stamp: int, now: float) -> float:
        """When something was made, s, session clock; never after ``now``.

        Parameters
        ----------
        stamp: ms, 24 bits, of the vehicle. now: s, when it came.
        """
        ahead = (stamp - self._stamp) % _TICKS
        if ahead > _TICKS // 2:  # overtaken by a later one
            ahead -= _TICKS
        made = self._made + 1e-3 * ahead
        late = now - made - self._offset
        if not -_PATIENCE < late < _PATIENCE:  # the first, or a vehicle that began anew
            self._offset = now - made
        else:
            gone = max(0.0, made - self._made)
            self._offset = min(self._offset + _DRIFT * gone, now - made)
        self._stamp, self._made = stamp, made
        return min(made + self._offset, now)
