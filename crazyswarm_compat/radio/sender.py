"""The thread that sends to one vehicle: what the outbox says, and echoes between."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat.radio.lanes import Job, Lane
from crazyarena.crazyswarm_compat.radio.outbox import Outbox
from crazyarena.crazyswarm_compat.radio.packets import Packet
from crazyarena.crazyswarm_compat.radio.quality import Pings

_LOG = logging.getLogger(__name__)
_IDLE = 1.0  # s, longest sleep
_PAUSE = 0.01  # s, before what must not be given up is tried again


class Sender:
    """Runs until closed.

    Parameters
    ----------
    who: name of the vehicle, for messages and the thread.
    transmit: hands a packet to the link; raises ConnectionError if there is none.
    pings, ping_rate: echoes, sent while ``answering()``.
    has_link: whether there is a connection, complete or not.
    """

    def __init__(
        self,
        who: str,
        clock: Clock,
        outbox: Outbox,
        pings: Pings,
        ping_rate: float,
        transmit: Callable[[Packet], None],
        has_link: Callable[[], bool],
        answering: Callable[[], bool],
    ) -> None:
        self._who = who
        self._clock = clock
        self._outbox = outbox
        self._pings = pings
        self._period = 1.0 / ping_rate
        self._transmit = transmit
        self._has_link = has_link
        self._answering = answering
        self._next_ping = 0.0
        self._closing = False
        self._thread = threading.Thread(target=self._loop, name=f"send-{who}", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def close(self) -> None:
        """Stop after what is being sent."""
        self._closing = True
        with self._outbox.wake:
            self._outbox.wake.notify_all()
        self._thread.join(timeout=3.0)

    def _loop(self) -> None:
        outbox = self._outbox
        while not self._closing:
            with outbox.wake:
                now = self._clock.now()
                job = outbox.poll(now)
                if not isinstance(job, Job):
                    ping_in = self._next_ping - now if self._has_link() else _IDLE
                    if ping_in > 0:
                        outbox.wake.wait(min(job, ping_in, _IDLE))
                        continue
            if isinstance(job, Job):
                self._run(job)
            self._ping(self._clock.now())

    def _run(self, job: Job) -> None:
        try:
            for packet in job.packets:
                self._transmit(packet)
            if job.action is not None:
                job.action()
        except Exception as error:
            # Whatever the driver throws, the other traffic goes on.
            if not isinstance(error, ConnectionError):
                _LOG.warning("%s: sending failed: %s", self._who, error)
            self._outbox.sent(job, False)
            if job.lane is Lane.EMERGENCY or job.lane is Lane.COMMAND:
                self._clock.sleep_until(self._clock.now() + _PAUSE)
            return
        self._outbox.sent(job, True)

    def _ping(self, now: float) -> None:
        if now < self._next_ping or not self._has_link():
            return
        self._next_ping = now + self._period
        if not self._answering():
            return
        try:
            self._transmit(self._pings.send(now))
        except Exception as error:
            _LOG.debug("%s: ping failed: %s", self._who, error)
