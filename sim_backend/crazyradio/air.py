"""The air between dongles and vehicles: who hears whom, what is lost, how long it takes."""

from __future__ import annotations

import math
import random
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from crazyarena.sim_backend.crazyradio.air_time import Rate, acknowledged, sent
from crazyarena.sim_backend.crazyradio.receiver import Receiver

# The second pipe of every vehicle; addresses are in the order of the link, id last.
BROADCAST = bytes.fromhex("ffe7e7e7e7")
_STRONG = 64  # -dBm; the power detector of the dongle speaks below
Loss = float | Callable[[float], float]


@dataclass(frozen=True, slots=True)
class Frame:
    """What a dongle is asked to send, and how.

    channel: 0..125; address: 5 bytes; ack_wait: s between attempts; retries: after the first;
    acked: whether to wait for an acknowledgement at all.
    """

    channel: int
    rate: Rate
    address: bytes
    payload: bytes
    retries: int = 3
    ack_wait: float = 500e-6
    acked: bool = True


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a frame: acknowledged or not, retries, seconds on the air, payload of the
    acknowledgement, and whether the power detector spoke."""

    acked: bool
    retries: int
    duration: float
    payload: bytes = b""
    strong: bool = False


class Unplugged(Exception):
    """The dongle is not there (any more)."""


class InUse(Exception):
    """Another program holds the dongle."""


@dataclass(slots=True)
class Station:
    """A vehicle on the air.

    loss, ack_loss: share of the frames to it, and of its acknowledgements, that are lost at each
    attempt; a function of time (s, of the caller's clock) for what changes. silent_until: switched
    off or booting until then, s; in_range: whether anything passes at all.
    """

    channel: int
    rate: Rate
    address: bytes
    receiver: Receiver
    loss: Loss = 0.0
    ack_loss: Loss = 0.0
    silent_until: float = -math.inf
    in_range: bool = True

    def hears(self, frame: Frame, now: float) -> bool:
        """Whether the chip is on and tuned to the frame's channel and rate."""
        return (
            self.in_range
            and now >= self.silent_until
            and frame.channel == self.channel
            and frame.rate == self.rate
        )


class Medium(Protocol):
    """The air as a dongle needs it; :class:`Air`, or the one of another process."""

    def dongles(self) -> Sequence[str]:
        """Serial numbers of the dongles that are plugged in."""
        ...

    def claim(self, serial: str) -> None:
        """Hold a dongle; raises :class:`InUse` or :class:`Unplugged`."""
        ...

    def release(self, serial: str) -> None:
        """Let go of a dongle."""
        ...

    def exchange(self, serial: str, frame: Frame, now: float) -> Outcome:
        """Send a frame; raises :class:`Unplugged`."""
        ...


@dataclass(slots=True)
class _Sender:
    """A dongle as the air sees it: when and where it was last heard."""

    plugged: bool = True
    holder: object = None
    held_until: float = -math.inf
    channel: int = -1
    until: float = -math.inf


@dataclass(slots=True)
class AirCounters:
    """Attempts on the air, and what was lost of them: frames, acknowledgements, collisions."""

    attempts: int = 0
    lost: int = 0
    acks_lost: int = 0
    collisions: int = 0
    busy: float = field(default=0.0)


class Air:
    """Vehicles and dongles of one room. Safe to share between threads.

    Two dongles that send at the same time on channels less than 2 MHz apart collide: the later
    frame is lost. ``noise(channel, now)`` is a share that is lost on a channel, of every frame
    and acknowledgement, such as by Wi-Fi.

    Parameters
    ----------
    stations: the vehicles.
    serials: of the dongles that are plugged in.
    seed: of what is lost.
    """

    def __init__(
        self, stations: Sequence[Station], serials: Sequence[str] = ("E7E7000001",), seed: int = 0
    ) -> None:
        self.stations = list(stations)
        self.noise: Callable[[int, float], float] | None = None
        self.counters = AirCounters()
        self._senders = {serial: _Sender() for serial in serials}
        self._rng = random.Random(seed)
        self._lock = threading.RLock()

    # Dongles

    @property
    def serials(self) -> Sequence[str]:
        """Serial numbers of all dongles, plugged in or not."""
        return tuple(self._senders)

    def dongles(self) -> Sequence[str]:
        return tuple(serial for serial, sender in self._senders.items() if sender.plugged)

    def plug(self, serial: str, plugged: bool) -> None:
        """Plug a dongle in or out."""
        with self._lock:
            sender = self._senders[serial]
            sender.plugged = plugged
            sender.holder = None

    def claim(
        self, serial: str, holder: object = "here", now: float = 0.0, lease: float = math.inf
    ) -> None:
        """As :meth:`Medium.claim`, for ``lease`` s from the last word of the holder."""
        with self._lock:
            sender = self._sender(serial)
            if sender.holder not in (None, holder) and now < sender.held_until:
                raise InUse(serial)
            sender.holder, sender.held_until = holder, now + lease

    def release(self, serial: str, holder: object = "here") -> None:
        """As :meth:`Medium.release`."""
        with self._lock:
            sender = self._senders.get(serial)
            if sender is not None and sender.holder == holder:
                sender.holder = None

    def _sender(self, serial: str) -> _Sender:
        sender = self._senders.get(serial)
        if sender is None or not sender.plugged:
            raise Unplugged(serial)
        return sender

    # Frames

    def exchange(self, serial: str, frame: Frame, now: float) -> Outcome:
        """As :meth:`Medium.exchange`; every attempt goes through loss, both ways."""
        with self._lock:
            sender = self._sender(serial)
            outcome = self._attempts(sender, frame, now)
            sender.channel, sender.until = frame.channel, now + outcome.duration
            self.counters.busy += outcome.duration
            return outcome

    def _attempts(self, sender: _Sender, frame: Frame, now: float) -> Outcome:
        if frame.address == BROADCAST or not frame.acked:
            return self._unanswered(sender, frame, now)
        station = self._addressed(frame, now)
        elapsed = 0.0
        for retry in range(frame.retries + 1):
            elapsed += sent(len(frame.payload), frame.rate)
            answer = self._once(sender, station, frame, now + elapsed)
            if answer is not None:
                assert station is not None
                elapsed += acknowledged(len(answer), frame.rate)
                strong = station.receiver.rssi < _STRONG
                return Outcome(True, retry, elapsed, answer, strong)
            elapsed += frame.ack_wait
        return Outcome(False, frame.retries, elapsed)

    def _unanswered(self, sender: _Sender, frame: Frame, now: float) -> Outcome:
        """A frame for everybody, or one that asks for no acknowledgement."""
        elapsed = 0.0
        for _ in range(frame.retries + 1 if frame.acked else 1):
            elapsed += sent(len(frame.payload), frame.rate)
            self.counters.attempts += 1
            if self._collides(sender, frame, now + elapsed):
                continue
            for station in self.stations:
                if not station.hears(frame, now) or self._lost(station.loss, frame, now + elapsed):
                    continue
                if frame.address == BROADCAST:
                    station.receiver.overhear(frame.payload)
                elif frame.address == station.address:
                    station.receiver.hear(frame.payload)
            elapsed += frame.ack_wait if frame.acked else 0.0
        return Outcome(False, frame.retries if frame.acked else 0, elapsed)

    def _addressed(self, frame: Frame, now: float) -> Station | None:
        for station in self.stations:
            if station.address == frame.address and station.hears(frame, now):
                return station
        return None

    def _once(
        self, sender: _Sender, station: Station | None, frame: Frame, now: float
    ) -> bytes | None:
        self.counters.attempts += 1
        if station is None:
            return None
        if self._collides(sender, frame, now) or self._lost(station.loss, frame, now):
            self.counters.lost += 1
            return None
        answer = station.receiver.hear(frame.payload)
        if answer is not None and self._lost(station.ack_loss, frame, now):
            self.counters.acks_lost += 1
            return None
        return answer

    def _lost(self, loss: Loss, frame: Frame, now: float) -> bool:
        share = loss(now) if callable(loss) else loss
        if self.noise is not None:
            share = 1.0 - (1.0 - share) * (1.0 - self.noise(frame.channel, now))
        return share > 0.0 and self._rng.random() < share

    def _collides(self, sender: _Sender, frame: Frame, now: float) -> bool:
        for other in self._senders.values():
            near = abs(other.channel - frame.channel) < 2
            if other is not sender and near and now < other.until:
                self.counters.collisions += 1
                return True
        return False
