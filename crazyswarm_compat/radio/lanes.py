"""Classes of traffic to a vehicle, what travels in them, and how much did."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

from crazyarena.crazyswarm_compat.radio.packets import Packet


class Lane(IntEnum):
    """Classes of traffic, the most urgent first."""

    EMERGENCY = 0
    WATCHDOG = 1
    COMMAND = 2
    SETPOINT = 3
    EXTPOSE = 4
    REST = 5


# Share of a burst of air time that a lane leaves to the more urgent ones.
RESERVE = {Lane.SETPOINT: 0.0, Lane.EXTPOSE: 0.25, Lane.REST: 0.5}


@dataclass(frozen=True, slots=True)
class LaneStatistics:
    """Traffic of one class so far.

    offered: items handed in; sent: packets that left; repeated: packets sent again because no
    answer came; overwritten: replaced by a newer item; dropped: too old, too many, refused or
    no link. mean_age, max_age: from hand-in to sending, s.
    """

    offered: int = 0
    sent: int = 0
    repeated: int = 0
    overwritten: int = 0
    dropped: int = 0
    mean_age: float = 0.0
    max_age: float = 0.0


class LaneCounters:
    """The numbers behind :class:`LaneStatistics`, while they grow."""

    def __init__(self) -> None:
        self.offered = 0
        self.sent = 0
        self.repeated = 0
        self.overwritten = 0
        self.dropped = 0
        self._jobs = 0
        self._age = 0.0
        self._max_age = 0.0

    def aged(self, age: float) -> None:
        """Note the age of an item when it is sent."""
        self._jobs += 1
        self._age += age
        self._max_age = max(self._max_age, age)

    def snapshot(self) -> LaneStatistics:
        """Numbers as of now."""
        mean = self._age / self._jobs if self._jobs else 0.0
        return LaneStatistics(
            self.offered,
            self.sent,
            self.repeated,
            self.overwritten,
            self.dropped,
            mean,
            self._max_age,
        )


@dataclass(frozen=True, slots=True)
class OutboxOptions:
    """Limits of :class:`.outbox.Outbox`; times in s, rates in Hz.

    setpoint_rate, extpose_rate, rest_rate: at most so many per second; command_expiry,
    setpoint_expiry, extpose_expiry: what waited longer is dropped; ack_timeout, ack_tries: a
    high-level command is repeated until it is answered; emergency_repeats and _interval: an
    emergency stop is sent so often at once, and then ten times a second until the vehicle says
    that it is locked, for at most emergency_patience; stream_timeout: silence that ends a
    stream, ``inf`` to leave that to the firmware; capacity of each queue.
    """

    setpoint_rate: float = 200.0
    extpose_rate: float = 100.0
    rest_rate: float = 100.0
    command_expiry: float = 1.0
    setpoint_expiry: float = 0.3
    extpose_expiry: float = 0.2
    ack_timeout: float = 0.08
    ack_tries: int = 12
    emergency_repeats: int = 15
    emergency_interval: float = 0.01
    emergency_patience: float = 5.0
    stream_timeout: float = 0.4
    capacity: int = 256


@dataclass(slots=True)
class Job:
    """Something to do now: packets to send, or an action that sends by itself."""

    lane: Lane
    born: float
    packets: tuple[Packet, ...] = ()
    action: Callable[[], None] | None = None
    repeated: bool = False


@dataclass(slots=True)
class HighLevelItem:
    """A command to the high-level commander.

    takes_over: it is to fly the vehicle, so the stream must end; done: called with the
    vehicle's answer, or None and a reason if there was none; needs_upload: id of a trajectory
    that must have been uploaded before.
    """

    packet: Packet
    verb: str
    takes_over: bool
    done: Callable[[int | None, str], None]
    needs_upload: int | None = None
    expires: bool = True
    born: float = 0.0
    order: int = 0
    remain_ms: int = 0
