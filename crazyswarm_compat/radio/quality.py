"""How good a link is: echoes under way, and what is told of the traffic."""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass

import numpy as np

from crazyarena.crazyswarm_compat.radio import packets as pk
from crazyarena.crazyswarm_compat.radio.lanes import Lane, LaneStatistics

_PINGS = 50  # echoes in the window of the statistics
_PING_LOST = 0.5  # s
_LONGEST_WAIT = 3.0  # s


@dataclass(frozen=True, slots=True)
class LinkStatistics:
    """Traffic and quality of one link.

    lanes: by class. pings, pings_lost: echoes that had time to come back, and those that did
    not; round_trip_loss their ratio over the last 50, None before the first; latency_p50,
    latency_p95: round trip, s, over those. log_packets, log_missed: packets of the log blocks
    that came, and those that their time stamps show missing. uplink_sent, uplink_arrived:
    packets to the vehicle since it first told its own count, and how many it got; 0 where its
    firmware does not count. A Crazyradio repeats what is not acknowledged, so that loss shows
    as latency there.
    """

    lanes: dict[Lane, LaneStatistics]
    pings: int
    pings_lost: int
    round_trip_loss: float | None
    latency_p50: float | None
    latency_p95: float | None
    log_packets: int
    log_missed: int
    uplink_sent: int
    uplink_arrived: int

    @property
    def downlink_loss(self) -> float | None:
        """Share of the log packets that were lost."""
        total = self.log_packets + self.log_missed
        return self.log_missed / total if total else None

    @property
    def uplink_loss(self) -> float | None:
        """Share of the packets to the vehicle that did not arrive."""
        if not self.uplink_sent:
            return None
        return max(0.0, 1.0 - self.uplink_arrived / self.uplink_sent)


class RoundTrip:
    """How long to wait for an answer, from the answers so far (Jacobson, SIGCOMM 1988)."""

    def __init__(self) -> None:
        self._mean: float | None = None
        self._spread = 0.0
        self._backoff = 1.0
        self._backed_off = -math.inf

    def observe(self, seconds: float) -> None:
        """An answer to a request that was sent once took ``seconds``."""
        mean = self._mean
        self._backoff = 1.0
        if mean is None:
            self._mean, self._spread = seconds, 0.5 * seconds
            return
        self._spread += 0.25 * (abs(seconds - mean) - self._spread)
        self._mean = mean + 0.125 * (seconds - mean)

    def timed_out(self, now: float) -> None:
        """An answer did not come in time: wait longer until one does."""
        if now - self._backed_off >= self._expected() * self._backoff:
            self._backed_off = now
            self._backoff = min(16.0, 2.0 * self._backoff)

    def patience(self, least: float) -> float:
        """Time-out for the next answer, s; at least ``least``."""
        return min(_LONGEST_WAIT, self._backoff * max(least, self._expected()))

    def _expected(self) -> float:
        return 0.0 if self._mean is None else self._mean + 4.0 * self._spread


class Pings:
    """Echoes under way and their results."""

    def __init__(self, round_trip: RoundTrip) -> None:
        self._round_trip = round_trip
        self._lock = threading.Lock()
        self._number = 0
        self._under_way: dict[int, float] = {}
        self._window: deque[float | None] = deque(maxlen=_PINGS)
        self.total = 0
        self.lost = 0

    def send(self, now: float) -> pk.Packet:
        """Next echo request; those without an answer by now count as lost."""
        with self._lock:
            for number, sent in list(self._under_way.items()):
                if now - sent > self._round_trip.patience(_PING_LOST):
                    del self._under_way[number]
                    self._count(None)
            self._number += 1
            self._under_way[self._number] = now
            return pk.ping(self._number)

    def received(self, data: bytes, now: float) -> None:
        """An echo came back."""
        number = pk.ping_number(data)
        with self._lock:
            sent = None if number is None else self._under_way.pop(number, None)
            if sent is not None:
                self._round_trip.observe(now - sent)
                self._count(now - sent)

    def forget(self) -> None:
        """The link is new: what is under way is nobody's."""
        with self._lock:
            self._under_way.clear()
            self._window.clear()

    def _count(self, latency: float | None) -> None:
        self.total += 1
        self.lost += latency is None
        self._window.append(latency)

    def summary(self) -> tuple[float | None, float | None, float | None]:
        """Loss, median and 95th percentile of the round trip over the window."""
        with self._lock:
            window = list(self._window)
        if not window:
            return None, None, None
        times = [latency for latency in window if latency is not None]
        loss = 1.0 - len(times) / len(window)
        if not times:
            return loss, None, None
        middle, high = np.percentile(times, (50, 95))
        return loss, float(middle), float(high)
