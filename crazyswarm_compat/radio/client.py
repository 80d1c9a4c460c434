"""The cflib client, made safe for a thread that sends at a set rate and for lossy links."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from typing import Any

import cflib.crtp
from cflib.crazyflie import Crazyflie
from cflib.crtp.crtpstack import CRTPPacket, CRTPPort
from cflib.crtp.udpdriver import UdpDriver

from crazyarena.crazyswarm_compat.radio.radio_driver import scheduled

_DRIVERS = threading.Lock()
_UDP_RETRY = 0.08  # s; networks answer sooner than radios
# What cflib has to say of broken links reaches the user as events and errors; its log only where
# the program has set one up.
logging.getLogger("cflib").addHandler(logging.NullHandler())


def init_drivers() -> None:
    """Register cflib's link drivers, once per process."""
    with _DRIVERS:
        if not cflib.crtp.CLASSES:
            cflib.crtp.init_drivers()


class _NoLatency:
    """Stands in for cflib's latency thread.

    cflib joins that thread from within ``send_packet`` when a link breaks, while the thread may
    wait for the very lock that ``send_packet`` holds: both would hang for good.
    """

    latency = 0.0

    def start(self) -> None:
        return

    def stop(self) -> None:
        return


class Client(Crazyflie):
    """A :class:`cflib.crazyflie.Crazyflie` with four differences.

    Requests are repeated on UDP links too (cflib takes them for lossless), a failing driver
    cannot leave the send lock behind, there is no latency thread, and a radio link is served by
    urgency unless ``scheduled`` is False.
    """

    def __init__(self, cache: str | os.PathLike[str] | None, scheduled: bool = True) -> None:
        self._driver: Any = None
        self._scheduled = scheduled
        super().__init__(rw_cache=None if cache is None else os.fspath(cache))
        latency = self.link_statistics.latency
        self.remove_header_callback(latency._ping_response, CRTPPort.LINKCTRL, 0)
        self.link_statistics.latency = _NoLatency()

    @property
    def link(self) -> Any:
        """Link driver, None while disconnected."""
        return self._driver

    @link.setter
    def link(self, driver: Any) -> None:
        if isinstance(driver, UdpDriver):
            driver.needs_resending = True
        self._driver = driver

    def open_link(self, link_uri: str) -> None:
        with scheduled() if self._scheduled else contextlib.nullcontext():
            super().open_link(link_uri)

    def send_packet(
        self,
        pk: CRTPPacket,
        expected_reply: tuple[int, ...] = (),
        resend: bool = False,
        timeout: float = 0.2,
    ) -> None:
        if not pk.is_data_size_valid():
            raise ValueError(f"packet of {pk.get_data_size()} bytes; CRTP allows 30")
        if isinstance(self._driver, UdpDriver):
            timeout = min(timeout, _UDP_RETRY)
        try:
            super().send_packet(pk, expected_reply, resend, timeout)
        except BaseException:
            self._send_lock.release()
            raise

    def ask_identity(self) -> None:
        """Repeat the first request of a connection, which cflib sends only once."""
        packet = CRTPPacket()
        packet.set_header(CRTPPort.LINKCTRL, 1)
        packet.data = (0,)
        self.send_packet(packet)

    def drop_link(self) -> None:
        """Close without the zero setpoint that cflib sends, which would stop the motors of a
        vehicle in flight and take it from its high-level commander."""
        driver, self.link = self.link, None
        if driver is not None:
            driver.close()
        self.close_link()
