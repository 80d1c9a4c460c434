"""The ground station's end of one radio link: the safe link and what has been heard."""

from __future__ import annotations

import queue
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from cflib.crtp.crtpstack import CRTPPacket

from crazyarena.crazyswarm_compat.radio.air_queue import NULL, AirQueue, Share, Waiting, is_request

SAFE_LINK = b"\xff\x05\x01"
_SAFE_LINK_TRIES = 10
_UP, _DOWN = 0x08, 0x04
_RSSI = 0x01
_WINDOW = 100  # exchanges that link quality is about
_EAGER = 0.0005  # s between packets with nothing to say, while the vehicle has, or should have,
_EXPECTING = 0.03  # s after a request
_BUSY_POLL = 0.01  # s between them at other times
_PATIENCE = 10  # packets in a row without answer after which a vehicle gets fewer
_SILENT_POLL = 0.05  # s between packets to a vehicle that does not answer
_LOST_AFTER = 1.0  # s without any answer, and
_LOST_TRIES = 15  # packets
POSE_STARVED = 0.04  # s without a pose, after which it is as urgent as a setpoint


@dataclass(frozen=True, slots=True)
class Tuning:
    """Where a vehicle is to be found: channel, data rate as cflib counts, 5 bytes of address."""

    channel: int
    rate: int
    address: tuple[int, ...]


class GroundLink:
    """One vehicle of a dongle. The dongle's thread calls it, but for :attr:`queue`.

    Attributes
    ----------
    queue: what waits to be sent. safe: None until it is known whether the vehicle keeps the safe
    link. incoming: packets from the vehicle, for cflib.
    """

    def __init__(
        self,
        tuning: Tuning,
        told: Callable[[dict[str, float]], None] | None,
        failed: Callable[[str], None] | None,
    ) -> None:
        self.tuning = tuning
        self.queue = AirQueue()
        self.incoming: queue.Queue[CRTPPacket] = queue.Queue()
        self.safe: bool | None = None
        self.lost = False
        self.backlog = 0.0
        self._told = told
        self._failed = failed
        self._tries = 0
        self._up = self._down = 0
        self._pending: Waiting | None = None
        self._pending_share = Share.POLL
        self._unanswered = 0
        self._heard = -1.0
        self._last = -1.0
        self._more = False
        self._eager_until = -1.0
        self._pose_sent = -1.0
        self._retries: deque[int] = deque(maxlen=_WINDOW)
        self._rssi: int | None = None
        self._sent = self._received = 0
        self._counted = -1.0

    def due(self, now: float) -> tuple[Share, float] | float:
        """Class and age mark of what it wants to send now, or how long it has nothing to, s."""
        lifted = self._lifted(now)
        waiting = self.queue.first(lifted)
        if self.queue.waits(Share.STOP):
            return Share.STOP, now
        if self._unanswered >= _PATIENCE:
            rest = self._last + _SILENT_POLL - now
            return (Share.POLL, self._last) if rest <= 0 else rest
        if self._pending is not None:
            share = self._pending_share
            if waiting is not None:
                share = min(share, waiting[0])
            return share, self._pending.since
        if waiting is not None:
            share, since = waiting
            return Share.FLIGHT if share is lifted else share, since
        rest = (
            self._last
            + (_EAGER if self._more or now < self._eager_until or not self.safe else _BUSY_POLL)
            - now
        )
        return (Share.POLL, self._last) if rest <= 0 else rest

    @property
    def sending(self) -> Share:
        """Class of the packet that was framed last."""
        return self._pending_share

    def _lifted(self, now: float) -> Share | None:
        """Poses are as urgent as setpoints to a vehicle that has had none for too long."""
        return Share.POSE if now - self._pose_sent > POSE_STARVED else None

    def frame(self, now: float) -> bytes:
        """The packet to send now; the same again until it is answered."""
        self._last = now
        if self.safe is None:
            return SAFE_LINK
        if self._pending is None:
            lifted = self._lifted(now)
            first = self.queue.first(lifted)
            share = Share.POLL if first is None else first[0]
            self._pending = self.queue.take(lifted) or Waiting(NULL, now)
            self._pending_share = share
            if share is Share.POSE:
                self._pose_sent = now
        packet = self._pending.packet
        if not self.safe:
            return packet
        head = packet[0] & ~(_UP | _DOWN) & 0xFF | self._up * _UP | self._down * _DOWN
        return bytes((head,)) + packet[1:]

    def answered(self, data: bytes, retries: int, now: float) -> None:
        """The frame was acknowledged, with ``data``."""
        self._unanswered, self._heard = 0, now
        self._retries.append(retries)
        self._sent += 1
        if self.safe is None:
            self._answer_to_safe_link(data)
            return
        asked = self._pending is not None and is_request(self._pending.packet)
        self._pending = None
        fresh = True
        if self.safe:
            self._up = 1 - self._up
            fresh = bool(data) and (data[0] & _DOWN) == self._down * _DOWN
            if fresh:
                self._down = 1 - self._down
        null = not data or data[0] & 0xF3 == 0xF3
        self._more = not null
        if asked:
            self._eager_until = now + _EXPECTING
        self.backlog += 0.02 * ((not null) - self.backlog)
        if null:
            if len(data) >= 3 and data[1] == _RSSI:
                self._rssi = data[2]
        elif fresh:
            self._received += 1
            self.incoming.put(CRTPPacket(data[0], list(data[1:])))
        self._tell(now)

    def _answer_to_safe_link(self, data: bytes) -> None:
        self._tries += 1
        if data == SAFE_LINK:
            self.safe, self._up, self._down = True, 0, 0
        elif self._tries >= _SAFE_LINK_TRIES:
            self.safe = False

    def unanswered(self, retries: int, now: float) -> str | None:
        """The frame was not acknowledged; returns why the link is lost, once."""
        self._unanswered += 1
        self._retries.append(retries + 1)
        if self._heard < 0:
            self._heard = now  # counted from the first try
        if self._unanswered < _LOST_TRIES or now - self._heard < _LOST_AFTER or self.lost:
            return None
        self.lost = True
        return f"no answer for {now - self._heard:.1f} s: too many packets lost"

    def fail(self, why: str) -> None:
        """Tell cflib that the link is lost."""
        self.lost = True
        if self._failed is not None:
            self._failed(why)

    def _tell(self, now: float) -> None:
        """Statistics as cflib's own driver tells them, ten times a second."""
        if self._told is None or now - self._counted < 0.1:
            return
        elapsed, self._counted = now - self._counted, now
        mean = sum(self._retries) / len(self._retries)
        told: dict[str, Any] = {
            "link_quality": max(0.0, 100.0 - 10.0 * mean),
            "uplink_rate": self._sent / elapsed,
            "downlink_rate": self._received / elapsed,
        }
        if self._rssi is not None:
            told["uplink_rssi"] = float(self._rssi)
        self._sent = self._received = 0
        self._told(told)
