"""What one Crazyradio sends next, and the sending. No thread: :mod:`.dongle` has one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat.radio.air_queue import Share
from crazyarena.crazyswarm_compat.radio.ground_link import POSE_STARVED, GroundLink

BROADCAST = (0xFF, 0xE7, 0xE7, 0xE7, 0xE7)
_IDLE = 0.5  # s, longest rest
_STARVED = 0.1  # s after which a packet with nothing to say counts as urgent
_OLD = 0.1  # s after which a broadcast is not worth sending


class Radio(Protocol):
    """What is used of :class:`cflib.drivers.crazyradio.Crazyradio`."""

    dev: Any

    def set_channel(self, channel: int) -> None: ...

    def set_address(self, address: Sequence[int]) -> None: ...

    def set_data_rate(self, datarate: int) -> None: ...

    def set_ack_enable(self, enable: bool) -> None: ...

    def send_packet(self, dataOut: bytes) -> Any: ...


@dataclass(slots=True)
class DongleStatistics:
    """What a dongle has carried so far.

    exchanges by class; unanswered; busy: s in transfers; broadcasts: frames for everybody;
    overtaken: broadcasts that a newer one replaced before they were sent.
    """

    exchanges: dict[Share, int] = field(default_factory=lambda: dict.fromkeys(Share, 0))
    unanswered: int = 0
    busy: float = 0.0
    broadcasts: int = 0
    overtaken: int = 0


@dataclass(frozen=True, slots=True)
class Cast:
    """Packets for everybody on a channel, and since when they wait, s."""

    channel: int
    rate: int
    packets: tuple[bytes, ...]
    since: float


@dataclass(frozen=True, slots=True)
class Turn:
    """What goes now: one packet of a link, or a broadcast."""

    link: GroundLink | None
    share: Share
    cast: Cast | None = None


class AirSchedule:
    """The order of the traffic of one dongle.

    The most urgent class of :class:`.air_queue.Share` goes first, and within it what has waited
    longest. So that nothing starves, a vehicle that has had no pose for 40 ms, or has not been
    heard for 100 ms, counts as urgent as setpoints.
    """

    def __init__(self, clock: Clock, statistics: DongleStatistics) -> None:
        self.statistics = statistics
        self._clock = clock
        self._casts: dict[int, Cast] = {}
        self._cast_sent = -1.0

    def broadcast(self, channel: int, rate: int, packets: tuple[bytes, ...]) -> None:
        """Hand in packets for everybody on a channel; those that still wait are replaced."""
        before = self._casts.get(channel)
        self.statistics.overtaken += before is not None
        since = self._clock.now() if before is None else before.since
        self._casts[channel] = Cast(channel, rate, packets, since)

    def clear(self) -> None:
        """Forget what waits for everybody."""
        self._casts.clear()

    def choose(self, links: Sequence[GroundLink], now: float) -> Turn | float:
        """What goes now, or how long nothing does, s."""
        best: tuple[Share, float] | None = None
        chosen: GroundLink | None = None
        rest = _IDLE
        for link in links:
            due = link.due(now)
            if isinstance(due, float):
                rest = min(rest, due)
                continue
            share, since = due
            if share is Share.POLL and now - since > _STARVED:
                share = Share.FLIGHT
            if best is None or (share, since) < best:
                best, chosen = (share, since), link
        cast = self._take_cast(None if best is None else best[0], now)
        if cast is not None:
            return Turn(None, Share.POSE, cast)
        if chosen is None or best is None:
            return rest
        return Turn(chosen, best[0])

    def _take_cast(self, share: Share | None, now: float) -> Cast | None:
        """A broadcast, if it goes before a packet of this class."""
        for cast in list(self._casts.values()):
            if now - cast.since > _OLD and len(self._casts) > 1:
                del self._casts[cast.channel]
                self.statistics.overtaken += 1
        if not self._casts:
            return None
        starved = now - self._cast_sent > POSE_STARVED
        if share is not None and share < (Share.FLIGHT if starved else Share.POSE):
            return None
        oldest = min(self._casts.values(), key=lambda cast: cast.since)
        del self._casts[oldest.channel]
        self._cast_sent = now
        return oldest

    def carry_out(self, turn: Turn, radio: Radio) -> tuple[bool, str | None]:
        """Send; returns whether the dongle did it, and why the link is lost if it just was."""
        begin = self._clock.now()
        try:
            if turn.cast is not None:
                self._cast(turn.cast, radio)
                return True, None
            assert turn.link is not None
            return self._exchange(turn.link, radio)
        finally:
            self.statistics.busy += self._clock.now() - begin

    def _exchange(self, link: GroundLink, radio: Radio) -> tuple[bool, str | None]:
        radio.set_channel(link.tuning.channel)
        radio.set_address(link.tuning.address)
        radio.set_data_rate(link.tuning.rate)
        frame = link.frame(self._clock.now())
        self.statistics.exchanges[link.sending] += 1
        status = radio.send_packet(frame)
        if status is None:
            return False, None
        now = self._clock.now()
        if status.ack:
            link.answered(bytes(status.data), status.retry, now)
            return True, None
        self.statistics.unanswered += 1
        return True, link.unanswered(status.retry, now)

    def _cast(self, cast: Cast, radio: Radio) -> None:
        radio.set_channel(cast.channel)
        radio.set_address(BROADCAST)
        radio.set_data_rate(cast.rate)
        radio.set_ack_enable(False)
        try:
            for data in in_pairs(cast.packets):
                radio.dev.write(endpoint=1, data=data, timeout=1000)
                self.statistics.broadcasts += 1
        finally:
            radio.set_ack_enable(True)


def in_pairs(packets: Sequence[bytes]) -> list[bytes]:
    """Transfers without acknowledgement: two packets of one length share one, which the dongle
    splits in the middle if it is longer than a packet can be."""
    transfers: list[bytes] = []
    waiting = list(packets)
    while waiting:
        first = waiting.pop(0)
        if waiting and len(waiting[0]) == len(first) and 2 * len(first) > 32:
            first += waiting.pop(0)
        transfers.append(first)
    return transfers
