"""What can go wrong between a ground station and a vehicle, and a battery that is low.

A :class:`Channel` carries the datagrams of one direction. It loses, delays and cuts; it never
reorders, as a radio does not.

Loss is that of a Crazyradio with its safe link: a streamed packet (setpoint, pose, log data,
console) that is lost stays lost, a request or its answer is sent again until it gets through
and arrives later. Without the safe link everything can be lost, which stock clients do not
survive while they connect.
"""

from __future__ import annotations

import math
import random
import re
from collections import deque
from dataclasses import dataclass
from typing import Any

from crazyarena.errors import InputError
from crazyarena.sim_backend.crtp.packets import Port

_RETRY = 0.01  # s, until a lost request is sent again
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}
_DURATION = re.compile(r"([0-9]*\.?[0-9]+)\s*(s|ms|us|µs)")


def parse_share(text: str) -> float:
    """``5%`` or ``0.05`` as a share of 1; InputError otherwise."""
    match = re.fullmatch(r"([0-9]*\.?[0-9]+)\s*(%?)", text.strip())
    share = math.nan if match is None else float(match[1]) * (0.01 if match[2] else 1.0)
    if not 0.0 <= share <= 1.0:
        raise InputError(f"loss: found {text!r}; write a share like 5% or 0.05")
    return share


def parse_latency(text: str) -> tuple[float, float]:
    """``8ms±3ms`` (or ``8ms+-3ms``, ``8ms``) as latency and jitter in s; InputError otherwise."""
    parts = [_DURATION.fullmatch(part.strip()) for part in re.split(r"±|\+-|\+/-", text.strip())]
    if not 1 <= len(parts) <= 2 or None in parts:
        raise InputError(f"latency: found {text!r}; write it like 8ms or 8ms±3ms")
    values = [float(part[1]) * _SECONDS[part[2]] for part in parts if part is not None]
    latency, jitter = values if len(values) == 2 else (values[0], 0.0)
    if jitter > latency:
        raise InputError(f"latency: found {text!r}; the jitter cannot exceed the latency")
    return latency, jitter


def parse_volts(text: str) -> float:
    """``3.2V`` or ``3.2`` in V, 3.0 to 4.2; InputError otherwise."""
    match = re.fullmatch(r"([0-9]*\.?[0-9]+)\s*[vV]?", text.strip())
    if match is None or not 3.0 <= float(match[1]) <= 4.2:
        raise InputError(f"battery: found {text!r}; write a voltage from 3.0V to 4.2V")
    return float(match[1])


@dataclass(slots=True)
class Faults:
    """Faults in force; may be changed at any time.

    Attributes
    ----------
    loss: probability that a datagram is lost, per direction.
    latency, jitter: s, per direction; the delay is uniform within latency ± jitter.
    cut_until: s, on the clock of whoever owns the channels; until then nothing gets through.
    safe_link: requests and answers are repeated until they arrive.
    """

    loss: float = 0.0
    latency: float = 0.0
    jitter: float = 0.0
    cut_until: float = -math.inf
    safe_link: bool = True


@dataclass(slots=True)
class ChannelCounters:
    """Datagrams of one direction: handed in, lost for good, repeated, lost to a cut link."""

    carried: int = 0
    lost: int = 0
    repeated: int = 0
    cut: int = 0


_STREAMED = frozenset((Port.SETPOINT, Port.GENERIC_SETPOINT, Port.LOCALIZATION, Port.CONSOLE))
_LOG_DATA = 2


def is_streamed(datagram: bytes) -> bool:
    """Whether nobody waits for an answer to this datagram, so that it is not repeated."""
    port, channel = datagram[0] >> 4, datagram[0] & 3
    return port in _STREAMED or (port == Port.LOG and channel == _LOG_DATA)


class Channel:
    """One direction between one vehicle and the ground.

    Parameters
    ----------
    faults: shared with the other direction; read at every datagram.
    rng: its own generator.
    """

    def __init__(self, faults: Faults, rng: random.Random) -> None:
        self._faults = faults
        self._rng = rng
        self._waiting: deque[tuple[float, bytes, object]] = deque()
        self.counters = ChannelCounters()

    def send(self, datagram: bytes, peer: object, now: float) -> None:
        """Hand in a datagram with the address it comes from or goes to."""
        faults, counters = self._faults, self.counters
        counters.carried += 1
        if now < faults.cut_until:
            counters.cut += 1
            return
        delay = faults.latency
        if faults.jitter > 0.0:
            delay += self._rng.uniform(-faults.jitter, faults.jitter)
        if faults.loss > 0.0:
            repeats = faults.safe_link and bool(datagram) and not is_streamed(datagram)
            while self._rng.random() < faults.loss:
                if not repeats or faults.loss >= 1.0:
                    counters.lost += 1
                    return
                counters.repeated += 1
                delay += _RETRY
        arrival = now + delay
        if self._waiting:
            arrival = max(arrival, self._waiting[-1][0])
        self._waiting.append((arrival, datagram, peer))

    def due(self) -> float:
        """When the next datagram arrives, s; inf if none is under way."""
        return self._waiting[0][0] if self._waiting else math.inf

    def take(self, now: float) -> list[tuple[bytes, Any]]:
        """Datagrams that have arrived by ``now``; a cut link delivers none, and loses them."""
        arrived = []
        while self._waiting and self._waiting[0][0] <= now:
            _, datagram, peer = self._waiting.popleft()
            if now < self._faults.cut_until:
                self.counters.cut += 1
            else:
                arrived.append((datagram, peer))
        return arrived
