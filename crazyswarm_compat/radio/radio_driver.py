"""``radio://`` links of our own clients, on dongles that send what is most urgent.

Other cflib programs in the process keep cflib's own driver: :func:`scheduled` says whose links
these are.
"""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable, Iterator
from typing import Any

import cflib.crtp
from cflib.crtp.crtpdriver import CRTPDriver
from cflib.crtp.crtpstack import CRTPPacket
from cflib.crtp.exceptions import WrongUriType
from cflib.crtp.radiodriver import RadioDriver

from crazyarena.clock import WallClock
from crazyarena.crazyswarm_compat.radio.air_queue import Share
from crazyarena.crazyswarm_compat.radio.dongle import Dongle
from crazyarena.crazyswarm_compat.radio.ground_link import GroundLink, Tuning

_SCHEME = "radio://"
_FULL = 2.0  # s to wait for room, as in cflib's driver
_CLOCK = WallClock()
_LOCAL = threading.local()
_DONGLES: dict[int, Dongle] = {}
_LOCK = threading.Lock()


def dongle(number: int) -> Dongle:
    """The dongle of a number, one for the whole process."""
    with _LOCK:
        if number not in _DONGLES:
            _DONGLES[number] = Dongle(number, _CLOCK)
        return _DONGLES[number]


def tuning_of(uri: str) -> tuple[int, Tuning]:
    """Dongle and tuning of a ``radio://`` link, as cflib reads it."""
    number, channel, rate, address, _ = RadioDriver.parse_uri(uri)
    return number, Tuning(channel, rate, tuple(address))


@contextlib.contextmanager
def scheduled() -> Iterator[None]:
    """Links that this thread opens in the block are ours."""
    with _LOCK:
        if ScheduledRadioDriver not in cflib.crtp.CLASSES:
            cflib.crtp.CLASSES.insert(0, ScheduledRadioDriver)
    _LOCAL.on = True
    try:
        yield
    finally:
        _LOCAL.on = False


class ScheduledRadioDriver(CRTPDriver):
    """One link, as cflib wants its drivers."""

    def __init__(self) -> None:
        super().__init__()
        self.uri = ""
        self._link: GroundLink | None = None
        self._dongle: Dongle | None = None
        self._failed: Callable[[str], None] | None = None

    @property
    def needs_resending(self) -> bool:
        """Whether a request may get lost: not on a safe link."""
        return self._link is not None and self._link.safe is False

    @needs_resending.setter
    def needs_resending(self, value: bool) -> None:
        return  # the base class sets it

    @property
    def dongle(self) -> Dongle | None:
        """What carries this link."""
        return self._dongle

    def replaced(self, share: Share | None = None) -> int:
        """Packets that newer ones replaced before they were sent, of one class or all."""
        link = self._link
        if link is None:
            return 0
        counts = link.queue.replaced
        return sum(counts.values()) if share is None else counts[share]

    def connect(
        self,
        uri: str,
        radio_link_statistics_callback: Callable[[dict[str, float]], None] | None,
        link_error_callback: Callable[[str], None] | None,
    ) -> None:
        """Open a link; raises WrongUriType for those that are not ours."""
        if not getattr(_LOCAL, "on", False) or not uri.startswith(_SCHEME):
            raise WrongUriType("not a scheduled radio link")
        number, tuning = tuning_of(uri)
        self.uri = uri
        self._failed = link_error_callback
        self._dongle = dongle(number)
        self._link = GroundLink(tuning, radio_link_statistics_callback, link_error_callback)
        self._dongle.join(self._link)

    def send_packet(self, pk: CRTPPacket) -> bool:
        """Queue a packet; waits while there is no room."""
        link, carrier = self._link, self._dongle
        if link is None or carrier is None:
            return False
        packet = bytes((pk.header,)) + bytes(pk.data)
        deadline = _CLOCK.now() + _FULL
        while not carrier.send(link, packet):
            if _CLOCK.now() > deadline:
                if self._failed is not None:
                    self._failed("no room: packets to the vehicle do not get through")
                return False
            _CLOCK.sleep_until(_CLOCK.now() + 0.005)
        return True

    def receive_packet(self, wait: float = 0) -> CRTPPacket | None:
        """The next packet from the vehicle; waits ``wait`` s for it, or for ever if negative."""
        link = self._link
        if link is None:
            return None
        with contextlib.suppress(queue.Empty):
            if wait == 0:
                return link.incoming.get(False)
            return link.incoming.get(True, None if wait < 0 else wait)
        return None

    def close(self) -> None:
        """Let go of the link, and with the last one of the dongle."""
        link, self._link = self._link, None
        if link is not None and self._dongle is not None:
            self._dongle.leave(link)

    def get_status(self) -> str:
        return "scheduled Crazyradio"

    def get_name(self) -> str:
        return "radio"

    def scan_interface(self, address: Any = None) -> list[Any]:
        return []  # cflib's own driver scans

    def get_help(self) -> str:
        return ""
