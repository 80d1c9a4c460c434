"""The emergency stop: one latch, many hands on it.

:meth:`EmergencyStop.trigger` sends the firmware's emergency stop from the calling thread before
it returns, past every queue, budget and lock of ours, and repeats it from a thread of its own.
The watchdog sees the latch and stops feeding the vehicles' own watchdogs, so that a vehicle the
packets do not reach stops by itself within a second.
"""

from __future__ import annotations

import contextlib
import math
import queue
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat.commands import Command, Emergency
from crazyarena.errors import InputError

_REPEATS = 15  # as Crazyswarm2 does; the command is not acknowledged
_MOST_ERRORS = 100  # that are kept
_INTERVAL = 0.02  # s, between repeats: a burst loss of 0.3 s does not swallow them all


class CommandSink(Protocol):
    """What an emergency stop needs of a vehicle link."""

    def send(self, command: Command, vehicle: int | None = None) -> None: ...


@dataclass(frozen=True, slots=True)
class Stop:
    """Who stopped, why and when (s, session clock)."""

    source: str
    reason: str
    time: float


class StopButton(Protocol):
    """What sources pull: an :class:`EmergencyStop`, or what passes it on to one elsewhere."""

    def trigger(self, source: str, reason: str = "") -> None: ...

    def tested(self) -> None: ...

    def outcome(self, final: bool) -> str | None:
        """What became of a stop, for whoever pulled it: begins with ``stopped`` if a vehicle's
        link has confirmed. None: not known yet, ask again; never if ``final``."""
        ...


def say_loudly(text: str) -> None:
    """Tell the operator, whose terminal may be gone."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        print(f"\ncrazyarena: EMERGENCY STOP: {text}", file=sys.stderr, flush=True)


class Hold(Protocol):
    """What says whether the operator holds on: a :class:`DeadMan`, or what asks one elsewhere."""

    def age(self) -> float: ...


class EmergencyStop:
    """Latch that stops every vehicle of the given links; there is no way back.

    Parameters
    ----------
    links: backends themselves, not anything that checks or queues.
    clock: session clock.
    """

    def __init__(self, links: list[CommandSink], clock: Clock) -> None:
        self._links = list(links)
        self._clock = clock
        self._stop: Stop | None = None
        self._listeners: list[Callable[[Stop], None]] = []
        self._thread: threading.Thread | None = None
        self._wake = threading.Event()
        self._taken: list[bool] = [False] * len(self._links)
        self.errors: list[str] = []
        self.last_test: float | None = None

    @property
    def stopped(self) -> Stop | None:
        """The first stop, or None."""
        return self._stop

    def on_stop(self, listener: Callable[[Stop], None]) -> None:
        """Call ``listener`` at the first stop, in the triggering thread, after the sending."""
        self._listeners.append(listener)

    def trigger(self, source: str, reason: str = "") -> None:
        """Stop. Never raises, never waits for another thread of ours."""
        stop = Stop(source, reason, self._clock.now())
        first = self._stop is None
        if first:
            self._stop = stop
        self._send()
        if not first:
            return
        for listener in self._listeners:
            try:
                listener(stop)
            except Exception as error:  # a recorder that fails must not keep the motors on
                self._fault(error)
        self._thread = threading.Thread(target=self._repeat, name="estop", daemon=True)
        # Without another thread the first packet has to be enough; the vehicle's own watchdog
        # follows within a second.
        with contextlib.suppress(RuntimeError):
            self._thread.start()

    def tested(self, ago: float = 0.0) -> None:
        """Note that an operator tried a source in rehearsal mode, ``ago`` s ago."""
        before = -math.inf if self.last_test is None else self.last_test
        self.last_test = max(self._clock.now() - ago, before)

    def outcome(self, final: bool) -> str | None:
        """See :class:`StopButton`.

        A link confirms by its ``stopped_since(time)``: how many of its vehicles have said that
        their motors are locked, or, if they never say, that they still hear; the time is that of
        the stop. One without that method carries out what it is sent.
        """
        stop = self._stop
        if stop is None:
            return "no stop was pulled" if final else None
        confirmed = vehicles = 0
        for taken, link in zip(self._taken, self._links, strict=True):
            number = len(getattr(link, "vehicles", (0,)))
            ask = getattr(link, "stopped_since", None)
            vehicles += number
            if taken:
                confirmed += number if ask is None else ask(stop.time)
        if confirmed == vehicles and confirmed:
            return "stopped"
        if not final:
            return None
        if confirmed:
            return f"stopped, but only {confirmed} of {vehicles} vehicles confirm"
        why = self.errors[-1] if self.errors else "no vehicle confirms"
        return f"sent, not confirmed: {why if self._links else 'no vehicle is connected'}"

    def _send(self) -> None:
        for index, link in enumerate(self._links):
            try:
                link.send(Emergency(), None)
                self._taken[index] = True
            except Exception as error:
                self._fault(error)
                # One that cannot be reached must not keep it from the others of its link.
                for vehicle in getattr(link, "vehicles", ()):
                    try:
                        link.send(Emergency(), vehicle)
                        self._taken[index] = True
                    except Exception as another:
                        self._fault(another)

    def _fault(self, error: Exception) -> None:
        if len(self.errors) < _MOST_ERRORS:
            self.errors.append(f"{type(error).__name__}: {error}")

    def _repeat(self) -> None:
        for _ in range(_REPEATS):
            if self._wake.wait(_INTERVAL):
                return
            self._send()

    def close(self) -> None:
        """Stop repeating; the latch stays."""
        self._wake.set()
        if self._thread is not None and self._thread.is_alive():
            self._thread.join(timeout=0.5)


class DeadMan:
    """The operator must keep a key or button held; silence is letting go.

    Sources call :meth:`held` at least every ``limits.dead_man`` s while it is down.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._last = -math.inf

    def held(self) -> None:
        """The key is down now."""
        self._last = self._clock.now()

    def released(self) -> None:
        """The key was let go; no need to wait for the silence."""
        self._last = -math.inf

    def age(self) -> float:
        """s since it was last held; inf if never."""
        return self._clock.now() - self._last


class Rehearsal:
    """Stands in for an emergency stop before a flight: a pulled source counts as tried.

    Parameters
    ----------
    on_test: told of each source that was tried, in its thread.
    """

    def __init__(self, stop: EmergencyStop, on_test: Callable[[str], None] | None = None) -> None:
        self._stop = stop
        self._on_test = on_test

    def trigger(self, source: str, reason: str = "") -> None:
        """Stops nothing."""
        self._stop.tested()
        if self._on_test is not None:
            self._on_test(source)

    def tested(self) -> None:
        """As :meth:`EmergencyStop.tested`."""
        self.trigger("shell")

    def outcome(self, final: bool) -> str:
        """It was tried, and nothing was to be stopped."""
        return "tested"


@contextlib.contextmanager
def interrupt_policy(
    land: Callable[[str], None], stop: Callable[[str, str], None]
) -> Iterator[None]:
    """Ctrl-C (or SIGTERM) lands; once more stops; from the third on it also interrupts.

    Only in the main thread, where Python delivers signals; the handlers of before come back.

    Parameters
    ----------
    land: called with a reason at the first signal; must not block.
    stop: called with (source, reason) at every further one, in a thread of its own: the main
        thread may have been interrupted holding a lock that the link needs.
    """
    if threading.current_thread() is not threading.main_thread():
        raise InputError("the policy for Ctrl-C can only be installed by the main thread")
    count = 0
    # The one queue that may be filled from a signal handler.
    wishes: queue.SimpleQueue[str | None] = queue.SimpleQueue()

    def pull() -> None:
        while (name := wishes.get()) is not None:
            stop("signal", name)

    def handle(number: int, frame: Any) -> None:
        nonlocal count
        count += 1
        name = signal.Signals(number).name
        if count == 1:
            land(name)
        else:
            wishes.put(name)
        if count > 2:
            raise KeyboardInterrupt

    thread = threading.Thread(target=pull, name="estop-signal", daemon=True)
    thread.start()
    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        wishes.put(None)
        thread.join(timeout=1.0)
