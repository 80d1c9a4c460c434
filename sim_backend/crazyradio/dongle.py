"""A Crazyradio PA in software: its requests, its endpoints, and the time that they take."""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass

from crazyarena.clock import Clock
from crazyarena.sim_backend.crazyradio.air import Frame, Medium, Unplugged
from crazyarena.sim_backend.crazyradio.air_time import MAX_PAYLOAD, Rate, UsbTiming, ack_wait

CHANNELS = 126
(
    SET_CHANNEL,
    SET_ADDRESS,
    SET_RATE,
    SET_POWER,
    SET_ARD,
    SET_ARC,
) = range(1, 7)
ACK_ENABLE, CARRIER, SCAN, BOOTLOADER = 0x10, 0x20, 0x21, 0xFF
_MOST_FOUND = 63
# What a busy machine adds to a transfer may be made up for by the next one, as transfers do not
# wait for the program that ordered them.
_CREDIT = 0.3e-3


class Stalled(Exception):
    """The device refuses a request."""


class TimedOut(Exception):
    """Nothing to read within the time given."""


@dataclass(slots=True)
class Settings:
    """What the control requests have set; as after a reset of the device."""

    channel: int = 2
    address: bytes = b"\xe7" * 5
    rate: Rate = Rate.M2
    power: int = 3
    ard: int = 0xA0
    arc: int = 3
    ack_enabled: bool = True
    carrier: bool = False


class Dongle:
    """One device. Safe to share between threads, which then wait for each other.

    Parameters
    ----------
    serial: number by which links may name it.
    air: what it sends on.
    clock: transfers take their time on it.
    usb: their durations.
    """

    def __init__(
        self, serial: str, air: Medium, clock: Clock, usb: UsbTiming | None = None
    ) -> None:
        self.serial = serial
        self.settings = Settings()
        self._air = air
        self._clock = clock
        self._usb = usb or UsbTiming()
        self._lock = threading.RLock()
        self._answers: deque[bytes] = deque()
        self._found: bytes = b""
        self._free = -math.inf
        self._gone = False

    @property
    def gone(self) -> bool:
        """Whether it was unplugged; plugged in again, it is another device."""
        return self._gone

    def open(self) -> None:
        """Hold the device; raises what :meth:`.air.Medium.claim` raises."""
        self._alive()
        self._air.claim(self.serial)

    def close(self) -> None:
        """Let go of it."""
        self._air.release(self.serial)

    def reset(self) -> None:
        """As at power-on."""
        with self._lock:
            self._alive()
            self.settings = Settings()
            self._answers.clear()

    # Endpoint 0

    def control_out(self, request: int, value: int, index: int, data: bytes) -> None:
        """A vendor request to the device; raises :class:`Stalled` for an unknown one."""
        with self._lock:
            self._alive()
            self._pass(self._usb.control)
            settings = self.settings
            if request == SET_CHANNEL:
                if value < CHANNELS:
                    settings.channel = value
            elif request == SET_ADDRESS and len(data) == 5:
                settings.address = bytes(data)
            elif request == SET_RATE and value <= max(Rate):
                settings.rate = Rate(value)
            elif request == SET_POWER:
                settings.power = min(value, 3)
            elif request == SET_ARD:
                settings.ard = value & 0xFF
            elif request == SET_ARC:
                settings.arc = value & 0x0F
            elif request == ACK_ENABLE:
                settings.ack_enabled = value != 0
            elif request == CARRIER:
                settings.carrier = value != 0
            elif request == SCAN and data:
                self._scan(value, index, bytes(data))
            elif request == BOOTLOADER:
                self._gone = True  # it comes back as another device
            else:
                raise Stalled(f"request {request:#04x} with {len(data)} bytes")

    def control_in(self, request: int, length: int) -> bytes:
        """A vendor request from the device."""
        with self._lock:
            self._alive()
            self._pass(self._usb.control)
            if request != SCAN:
                raise Stalled(f"request {request:#04x}")
            return self._found[:length]

    def _scan(self, start: int, stop: int, packet: bytes) -> None:
        # At 2 Mbit/s a channel is two wide.
        step = 2 if self.settings.rate is Rate.M2 else 1
        found = bytearray()
        for channel in range(start, min(stop, CHANNELS - 1) + 1, step):
            self.settings.channel = channel
            outcome = self._send(packet[:MAX_PAYLOAD])
            if outcome is not None and outcome[0] & 1 and len(found) < _MOST_FOUND:
                found.append(channel)
            self._pass(0.0)
        self._found = bytes(found)

    # Endpoint 1

    def write(self, data: bytes) -> int:
        """Send a packet; what becomes of it is read."""
        with self._lock:
            self._alive()
            self._pass(self._usb.write)
            if not self.settings.ack_enabled and len(data) > MAX_PAYLOAD:
                # Two packets in one transfer, which nobody has to answer.
                half = len(data) // 2
                self._send(bytes(data[:half]))
                self._send(bytes(data[half : 2 * half]))
            elif data:
                answer = self._send(bytes(data[:MAX_PAYLOAD]))
                if answer is not None:
                    self._answers.append(answer)
            return len(data)

    def read(self, length: int, timeout: float) -> bytes:
        """Status byte and payload of the oldest answer; raises :class:`TimedOut` after
        ``timeout`` s without one."""
        with self._lock:
            self._alive()
            if self._answers:
                self._pass(self._usb.read)
                return self._answers.popleft()[:length]
        self._clock.sleep_until(self._clock.now() + timeout)
        raise TimedOut(f"nothing to read from dongle {self.serial}")

    def _send(self, packet: bytes) -> bytes | None:
        settings = self.settings
        if settings.carrier:
            return b"\0"
        frame = Frame(
            settings.channel,
            settings.rate,
            settings.address,
            packet,
            settings.arc,
            ack_wait(settings.ard, settings.rate),
            settings.ack_enabled,
        )
        try:
            outcome = self._air.exchange(self.serial, frame, self._clock.now())
        except Unplugged:
            self._gone = True
            raise
        self._free = max(self._free, self._clock.now() - _CREDIT) + outcome.duration
        if not settings.ack_enabled:
            return None
        if not outcome.acked:
            return b"\0"
        status = 0x01 | outcome.strong << 1 | outcome.retries << 4
        return bytes((status,)) + outcome.payload

    def _pass(self, duration: float) -> None:
        """Wait until what was ordered before is done, and then for this."""
        self._free = max(self._free, self._clock.now() - _CREDIT) + duration
        self._clock.sleep_until(self._free)

    def _alive(self) -> None:
        if self._gone:
            # Whoever asks again and again must not have a whole processor for it.
            self._clock.sleep_until(self._clock.now() + self._usb.control)
            raise Unplugged(self.serial)
