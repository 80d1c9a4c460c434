"""What happens on a link by itself, told to whoever listens."""

from __future__ import annotations

import logging
import queue
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

_KEPT = 1000
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class LinkEvent:
    """Base of all events: time s on the session clock, id of the vehicle."""

    time: float
    vehicle: int


@dataclass(frozen=True, slots=True)
class LinkUp(LinkEvent):
    """Connected, or connected again; ``outage`` s since the last packet before."""

    outage: float = 0.0


@dataclass(frozen=True, slots=True)
class LinkLost(LinkEvent):
    """Nothing was heard for too long, or the driver gave up; ``reason`` in words."""

    reason: str


@dataclass(frozen=True, slots=True)
class VehicleRestarted(LinkEvent):
    """The vehicle has been switched off and on, or has restarted by itself: what was written or
    uploaded to it is gone."""


@dataclass(frozen=True, slots=True)
class CommandRefused(LinkEvent):
    """The vehicle answered a high-level command with the error number ``code``."""

    verb: str
    code: int


@dataclass(frozen=True, slots=True)
class CommandLost(LinkEvent):
    """A command never reached the vehicle; ``reason`` says why."""

    verb: str
    reason: str


@dataclass(frozen=True, slots=True)
class CommandDoubtful(LinkEvent):
    """A command went out that the vehicle will ignore or take otherwise than it reads;
    ``reason`` says why."""

    verb: str
    reason: str


@dataclass(frozen=True, slots=True)
class StreamEnded(LinkEvent):
    """Streamed setpoints fell silent and the vehicle was handed to its high-level commander;
    ``action`` is hold, land or idle."""

    action: str


@dataclass(frozen=True, slots=True)
class TrajectoryUploaded(LinkEvent):
    """An upload was acknowledged, all of it."""

    trajectory_id: int


@dataclass(frozen=True, slots=True)
class AirShort(LinkEvent):
    """The dongle of this vehicle carries less than is asked of it, or all of it again.

    what: ``logs``, whose rates are divided by ``divisor`` from now on (1: as asked for), or
    ``poses``, of which the share ``fallen`` is not sent, the newest being what is (0: all are).
    Setpoints, commands and stops do not fall.
    """

    what: str
    divisor: int = 1
    fallen: float = 0.0


class EventLog:
    """Keeps the latest events and passes them on. Safe to share between threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._events: deque[LinkEvent] = deque(maxlen=_KEPT)
        self._listeners: list[Callable[[LinkEvent], None]] = []
        self._outgoing: queue.SimpleQueue[LinkEvent | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def subscribe(self, listener: Callable[[LinkEvent], None]) -> Callable[[], None]:
        """Call ``listener(event)`` for every event from now on, in a thread of its own.

        Returns
        -------
        A function that unsubscribes.
        """
        with self._lock:
            self._listeners.append(listener)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="events", daemon=True)
                self._thread.start()
        return lambda: self._listeners.remove(listener)

    def emit(self, event: LinkEvent) -> None:
        """Keep an event and tell the listeners; returns at once."""
        with self._lock:
            self._events.append(event)
            if self._thread is not None:
                self._outgoing.put(event)

    def take(self) -> list[LinkEvent]:
        """Events since the last call, oldest first (the latest 1000)."""
        with self._lock:
            events = list(self._events)
            self._events.clear()
        return events

    def close(self) -> None:
        """End the thread, after what was emitted has been passed on."""
        self._outgoing.put(None)

    def _run(self) -> None:
        while (event := self._outgoing.get()) is not None:
            for listener in tuple(self._listeners):
                try:
                    listener(event)
                except Exception:
                    _LOG.exception("a listener of link events failed")
