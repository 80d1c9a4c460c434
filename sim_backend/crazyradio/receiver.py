"""The radio chip of a vehicle: it acknowledges, keeps the safe link, and holds what waits.

With the safe link (request ``ff 05 01``) two header bits count packets: bit 3 those to the
vehicle, which ignores one whose bit it has had; bit 2 those from it, of which the next is sent
only when the ground station has moved on. Without it a lost acknowledgement doubles a packet on
its way up and loses one on its way down.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

# Places of the radio chip's own queue and of the flight controller's behind it.
_QUEUE = 15 + 120
_NULL = 0xF3
_SAFE_LINK, _POWER = 0x05, 0xFE
_UP, _DOWN = 0x08, 0x04


@dataclass(slots=True)
class ReceiverCounters:
    """Frames of one vehicle since it was switched on.

    heard: frames with its address, repeats included; broadcast: those for everybody; delivered:
    handed to the flight controller; doubles: recognised by the safe link; refused: for want of
    room; overflowed: packets from the flight controller that found the queue full.
    """

    heard: int = 0
    broadcast: int = 0
    delivered: int = 0
    doubles: int = 0
    refused: int = 0
    overflowed: int = 0


class Receiver:
    """One radio chip. Safe to share between threads.

    Parameters
    ----------
    deliver: takes a packet to the flight controller, and whether it was for everybody; False if
        there is no room, which leaves the frame without acknowledgement.
    power: takes a request to the power management (first byte of ``ff fe ...``).
    rssi: strength of what is heard, as -dBm.
    """

    def __init__(
        self,
        deliver: Callable[[bytes, bool], bool],
        power: Callable[[int], None] | None = None,
        rssi: int = 45,
    ) -> None:
        self.counters = ReceiverCounters()
        self.rssi = rssi
        self._deliver = deliver
        self._power = power
        self._lock = threading.RLock()  # who takes a packet may answer at once
        self._waiting: deque[bytes] = deque()
        self.reset()

    def reset(self) -> None:
        """Switched off and on: nothing waits, no safe link."""
        with self._lock:
            self._waiting.clear()
            self._safe = False
            self._up = self._down = 1
            self._last = b""
            self._service = b""

    @property
    def safe_link(self) -> bool:
        """Whether a ground station has asked for the safe link."""
        return self._safe

    @property
    def waiting(self) -> int:
        """Packets that wait for an acknowledgement to ride on."""
        return len(self._waiting)

    def say(self, packet: bytes) -> bool:
        """Queue a packet of the flight controller; False if there is no room."""
        with self._lock:
            if len(self._waiting) >= _QUEUE:
                self.counters.overflowed += 1
                return False
            self._waiting.append(packet)
            return True

    def overhear(self, frame: bytes) -> None:
        """A frame with the address for everybody; never acknowledged."""
        with self._lock:
            self.counters.broadcast += 1
            if not _is_null(frame) and self._deliver(frame, True):
                self.counters.delivered += 1

    def hear(self, frame: bytes) -> bytes | None:
        """A frame with the vehicle's own address.

        Returns
        -------
        Payload of the acknowledgement, None if there is none.
        """
        with self._lock:
            self.counters.heard += 1
            if len(frame) >= 2 and _is_null(frame):
                if frame[1] == _SAFE_LINK and len(frame) == 3:
                    return self._switch_safe_link(frame)
                if frame[1] == _POWER:
                    if len(frame) >= 3 and self._power is not None:
                        self._power(frame[2])
                    return self._next()
            fresh = not self._safe or bool(frame[0] & _UP) != bool(self._up)
            if fresh and not _is_null(frame):
                if not self._deliver(frame, False):
                    self.counters.refused += 1
                    return None
                self.counters.delivered += 1
            if fresh:
                self._up = 1 - self._up
            else:
                self.counters.doubles += 1
            if not self._safe or bool(frame[0] & _DOWN) != bool(self._down):
                self._down = 1 - self._down
                return self._next()
            return self._last

    def _switch_safe_link(self, frame: bytes) -> bytes:
        self._safe = bool(frame[2])
        self._up = self._down = 1
        self._service = frame
        return self._next()

    def _next(self) -> bytes:
        """What rides on the next acknowledgement, numbered."""
        if self._service:
            # It answers with the same bytes, whatever the counters are.
            self._last, self._service = self._service, b""
            return self._last
        packet = self._waiting.popleft() if self._waiting else bytes((_NULL, 0x01, self.rssi))
        if self._safe:
            packet = bytes((packet[0] & ~(_UP | _DOWN) & 0xFF | (self._down * _DOWN),)) + packet[1:]
        self._last = packet
        return packet


def _is_null(frame: bytes) -> bool:
    return frame[0] & _NULL == _NULL
