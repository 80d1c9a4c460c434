"""One Crazyradio for all its vehicles: a thread that always sends what is most urgent.

cflib's own driver gives every link of a dongle a turn, whether it has something to say or not;
with eight vehicles a stop waits for up to two rounds. Here a dongle has one queue, ordered by
:class:`.air_queue.Share`.
"""

from __future__ import annotations

import logging
import threading

from cflib.drivers.crazyradio import Crazyradio

from crazyarena.clock import Clock, WallClock
from crazyarena.crazyswarm_compat.radio.air_schedule import AirSchedule, DongleStatistics
from crazyarena.crazyswarm_compat.radio.ground_link import GroundLink
from crazyarena.errors import BackendError

_LOG = logging.getLogger(__name__)
_DEAF = 5  # transfers in a row that fail before the dongle counts as unplugged


class Dongle:
    """Opens a Crazyradio when the first link joins and lets go of it with the last.

    Parameters
    ----------
    number: as in the link, from 0.
    clock: wall clock.
    """

    def __init__(self, number: int, clock: Clock | None = None) -> None:
        self.number = number
        self.statistics = DongleStatistics()
        self._clock = clock or WallClock()
        self._schedule = AirSchedule(self._clock, self.statistics)
        self._links: list[GroundLink] = []
        self._wake = threading.Condition()
        self._thread: threading.Thread | None = None
        self._radio: Crazyradio | None = None

    def join(self, link: GroundLink) -> None:
        """Serve a link from now on.

        Raises
        ------
        BackendError: the dongle is not there, or another program has it.
        """
        with self._wake:
            if self._thread is None:
                self._radio = self._open()
                self._thread = threading.Thread(
                    target=self._run, name=f"crazyradio-{self.number}", daemon=True
                )
                self._links.append(link)
                self._thread.start()
            else:
                self._links.append(link)
            self._wake.notify_all()

    def leave(self, link: GroundLink) -> None:
        """Serve it no more; the last one waits until the dongle is free again."""
        with self._wake:
            if link in self._links:
                self._links.remove(link)
            thread = self._thread if not self._links else None
            self._wake.notify_all()
        if thread is not None and thread is not threading.current_thread():
            thread.join()

    def send(self, link: GroundLink, packet: bytes) -> bool:
        """Queue a packet for one vehicle; False if there is no room."""
        done = link.queue.put(packet, self._clock.now())
        with self._wake:
            self._wake.notify_all()
        return done

    def broadcast(self, channel: int, rate: int, packets: tuple[bytes, ...]) -> None:
        """Send packets to everybody on a channel, without acknowledgement; those that still wait
        there are replaced."""
        with self._wake:
            if self._thread is not None:
                self._schedule.broadcast(channel, rate, packets)
            self._wake.notify_all()

    def _open(self) -> Crazyradio:
        try:
            return Crazyradio(devid=self.number)
        except Exception as error:
            # cflib raises bare exceptions and strings here.
            raise BackendError(
                f"Crazyradio {self.number}: {error}; is it plugged in, and does no other program "
                "hold it?"
            ) from error

    def _run(self) -> None:
        deaf = 0
        while True:
            with self._wake:
                if not self._links:
                    # Closed before anybody else can open it.
                    self._close()
                    return
                turn = self._schedule.choose(self._links, self._clock.now())
                if isinstance(turn, float):
                    self._wake.wait(turn)
                    continue
                radio = self._radio
            try:
                assert radio is not None
                done, lost = self._schedule.carry_out(turn, radio)
            except Exception as error:
                _LOG.debug("crazyradio %d: %s", self.number, error)
                done, lost = False, None
            if lost is not None and turn.link is not None:
                _tell(turn.link, lost)
            deaf = 0 if done else deaf + 1
            if deaf >= _DEAF:
                self._gone()
                return

    def _gone(self) -> None:
        with self._wake:
            links = list(self._links)
            self._links.clear()
            self._close()
        for link in links:
            _tell(link, f"Crazyradio {self.number} does not answer any more: was it unplugged?")

    def _close(self) -> None:
        self._thread = None
        self._schedule.clear()
        radio, self._radio = self._radio, None
        if radio is not None:
            try:
                radio.close()
            except Exception as error:
                _LOG.debug("crazyradio %d: closing: %s", self.number, error)


def _tell(link: GroundLink, why: str) -> None:
    """In a thread of its own: cflib closes the link in it, which waits for the dongle's."""
    threading.Thread(target=link.fail, args=(why,), daemon=True).start()
