"""The cflib client, made safe for a thread that sends at a set rate and for lossy, slow links."""

from __future__ import annotations

import contextlib
import logging
import os
import struct
import threading
from collections.abc import Callable, Sequence
from datetime import datetime
from typing import Any, Literal

import cflib.crtp
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.param import ParamTocElement, _ParamUpdater
from cflib.crazyflie.toc import TocFetcher
from cflib.crtp.crtpstack import CRTPPacket, CRTPPort
from cflib.crtp.udpdriver import UdpDriver

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat.radio.batch import Batch, TocStore, fetch_toc
from crazyarena.crazyswarm_compat.radio.param_answers import ParamAnswers
from crazyarena.crazyswarm_compat.radio.quality import RoundTrip
from crazyarena.crazyswarm_compat.radio.radio_driver import scheduled

_DRIVERS = threading.Lock()
_UDP_RETRY = 0.08  # s; networks answer sooner than radios
_LOCK_PATIENCE = 0.5  # s
_READ_CHANNEL = 1
_ID_16_BIT = 4  # protocol version
# What connecting, and every flight, asks for.
NEEDED = ("hlCommander.groupmask", "stabilizer.controller", "stabilizer.estimator")
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
    """A :class:`cflib.crazyflie.Crazyflie` for links that lose packets or take their time.

    Requests are repeated on UDP links too (cflib takes them for lossless), after a time that
    follows the round trip; tables and values are asked for several at a time, and only the
    values that are wanted; a failing driver cannot leave the send lock behind; there is no
    latency thread; and a radio link is served by urgency unless ``scheduled`` is False.

    Parameters
    ----------
    cache: folder of the tables of contents, or None.
    clock: session clock.
    parameters: ``needed`` reads the values of :data:`NEEDED` when connecting, ``all`` all.
    in_flight: requests under way at once.

    Attributes
    ----------
    round_trip: of requests and their answers. answers: how many came so far.
    param_answered: called with the name of a parameter whose reading or writing has been answered,
        in cflib's thread.
    """

    def __init__(
        self,
        cache: str | os.PathLike[str] | None,
        clock: Clock,
        round_trip: RoundTrip,
        parameters: Literal["needed", "all"] = "needed",
        in_flight: int = 6,
        scheduled: bool = True,
    ) -> None:
        self._driver: Any = None
        self._scheduled = scheduled
        self._clock = clock
        self._wanted = parameters
        self._in_flight = in_flight
        self._asked: dict[tuple[int, ...], float] = {}
        self.round_trip = round_trip
        self.answers = 0
        self.param_answered: Callable[[str], None] = lambda name: None
        self._param_answers = ParamAnswers(self._param_id_answered)
        super().__init__(rw_cache=None if cache is None else os.fspath(cache))
        self._toc_cache: Any = TocStore(self._toc_cache)
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

    def add_port_callback(self, port: int, cb: Any) -> None:
        # Those of cflib's parameter thread, which it makes for every connection.
        if port == CRTPPort.PARAM and isinstance(getattr(cb, "__self__", None), _ParamUpdater):
            cb = self._param_answers.through(cb)
        super().add_port_callback(port, cb)

    def _param_id_answered(self, ident: bytes) -> None:
        element = self.param.toc.get_element_by_id(int.from_bytes(ident, "little"))
        if element is not None:
            self.param_answered(f"{element.group}.{element.name}")

    # Connecting

    def _platform_info_fetched(self) -> None:
        if self.platform.get_protocol_version() < _ID_16_BIT:
            super()._platform_info_fetched()
            return
        cache, window = self._toc_cache, self._in_flight

        def then() -> None:
            fetch_toc(self, CRTPPort.PARAM, cache, window, super_fetched)

        super_fetched = super()._platform_info_fetched
        fetch_toc(self, CRTPPort.LOGGING, cache, window, then)

    def _mems_updated_cb(self) -> None:
        # Without the extended types, which say what is kept in the vehicle's EEPROM.
        wide = self.platform.get_protocol_version() >= _ID_16_BIT
        self.param._useV2 = wide
        if self.param.param_updater is not None:
            # It would learn this from the first value that is asked for through it.
            self.param.param_updater._useV2 = wide
        TocFetcher(
            self,
            ParamTocElement,
            CRTPPort.PARAM,
            self.param.toc,
            self._param_toc_updated_cb,
            self._toc_cache,
        ).start()

    def _param_toc_updated_cb(self) -> None:
        if self.platform.get_protocol_version() < _ID_16_BIT:
            super()._param_toc_updated_cb()
            return
        self.connected_ts = datetime.now()
        self.connected.call(self.link_uri)
        names = self.param_names() if self._wanted == "all" else NEEDED
        self.read_params(names)

    def param_names(self) -> tuple[str, ...]:
        """All parameters of the vehicle, as ``group.name``."""
        toc = self.param.toc.toc
        return tuple(f"{group}.{name}" for group, names in toc.items() for name in names)

    def read_params(self, names: Sequence[str]) -> None:
        """Read values (those that the vehicle has), then call ``fully_connected``. For a
        connection that is being made: cflib would take an answer for that of a write."""
        elements = {}
        for name in names:
            element = self.param.toc.get_element(*name.split("."))
            if element is not None:
                elements[struct.pack("<H", element.ident)] = element

        def answer(data: bytes) -> None:
            element = elements[data[:2]]
            if len(data) == 3 + struct.calcsize(element.pytype):
                (value,) = struct.unpack_from(element.pytype, data, 3)
                self.param.values.setdefault(element.group, {})[element.name] = str(value)

        def done() -> None:
            # For cflib "all values are known", without which it writes none.
            self.param.is_updated = True
            self.param._initialized.set()
            self.fully_connected.call(self.link_uri)

        requests = list(elements)
        Batch(self, CRTPPort.PARAM, _READ_CHANNEL, requests, self._in_flight, answer, done).start()

    # Traffic

    def send_packet(
        self,
        pk: CRTPPacket,
        expected_reply: tuple[int, ...] = (),
        resend: bool = False,
        timeout: float = 0.2,
    ) -> None:
        if not pk.is_data_size_valid():
            raise ValueError(f"packet of {pk.get_data_size()} bytes; CRTP allows 30")
        if pk.port == CRTPPort.PARAM and not resend:
            wide = self.platform.get_protocol_version() >= _ID_16_BIT
            self._param_answers.asks(pk.channel, bytes(pk.data), wide)
        if expected_reply:
            now = self._clock.now()
            if isinstance(self._driver, UdpDriver):
                timeout = min(timeout, _UDP_RETRY)
            timeout = self.round_trip.patience(timeout)
            if resend:
                # Whose answer the next one is, nobody can tell (Karn's rule).
                if self._asked.pop(tuple(expected_reply), None) is not None:
                    self.round_trip.timed_out(now)
            else:
                self._asked[(pk.header, *expected_reply)] = now
        try:
            super().send_packet(pk, expected_reply, resend, timeout)
        except BaseException:
            self._send_lock.release()
            if self._driver is None:
                return  # it broke just now; whoever asked hears of the lost link
            raise

    def _check_for_answers(self, pk: CRTPPacket) -> None:
        super()._check_for_answers(pk)
        data = (pk.header, *pk.data)
        for pattern, sent in tuple(self._asked.items()):
            if data[: len(pattern)] == pattern:
                self._asked.pop(pattern, None)
                self.round_trip.observe(self._clock.now() - sent)
        self.answers += 1

    def ask_identity(self) -> None:
        """Repeat the first request of a connection, which cflib sends only once."""
        packet = CRTPPacket()
        packet.set_header(CRTPPort.LINKCTRL, 1)
        packet.data = (0,)
        self.send_packet(packet)

    def drop_link(self) -> None:
        """Close without the zero setpoint that cflib sends, which would stop the motors of a
        vehicle in flight and take it from its high-level commander."""
        # Not while somebody is about to send, unless the driver hangs.
        held = self._send_lock.acquire(timeout=_LOCK_PATIENCE)
        driver, self.link = self.link, None
        for timer in tuple(self._answer_patterns.values()):
            timer.cancel()
        if held:
            self._send_lock.release()
        if driver is not None:
            driver.close()
        self.close_link()
