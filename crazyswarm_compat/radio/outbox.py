"""What waits to be sent to one vehicle, and what goes next.

No thread, no socket: :meth:`Outbox.poll` is asked with the time and answers with the next
:class:`.lanes.Job`, or with the time to wait. The rules of the firmware for passing control between
streamed setpoints and the high-level commander live here:

- a high-level command that follows a stream (or a new connection, whose predecessor may have
  streamed) has no effect until setpoints are declared over. An idle high-level commander stops
  the motors, so the command goes first, its answer is awaited, and only then is the stream
  declared over;
- a stream that falls silent is levelled after 0.5 s and locked for good after 2 s: before
  that the vehicle is handed to the high-level commander.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from crazyarena.crazyswarm_compat.radio.budget import Budget
from crazyarena.crazyswarm_compat.radio.emergency import EmergencyLane
from crazyarena.crazyswarm_compat.radio.lanes import (
    RESERVE,
    HighLevelItem,
    Job,
    Lane,
    LaneCounters,
    OutboxOptions,
)
from crazyarena.crazyswarm_compat.radio.packets import Packet, notify_setpoints_stop


@dataclass(slots=True)
class _Awaiting:
    item: HighLevelItem
    due: float
    tries: int
    hand_over: bool


@dataclass(slots=True)
class _Setpoint:
    packets: tuple[Packet, ...]
    first: tuple[Packet, ...]
    born: float
    order: int


_NOTIFY_REPEATS = 3
_NOTIFY_INTERVAL = 0.02


class Outbox:
    """Mailboxes of one vehicle. Safe to share between threads.

    Parameters
    ----------
    options: limits.
    budget: air time, possibly shared with other vehicles.
    release: called when a stream is over and no command followed, with whether it fell silent
        and the kind of its last setpoint; returns the command that takes the vehicle over, or
        None to let the idle high-level commander stop the motors. It is called with the lock
        held, as are the ``done`` of commands: they must not call back.
    patience: makes of ``ack_timeout`` the time to wait for an answer on this link, s; a relative
        command that is repeated only because its answer is late would be flown twice.
    """

    def __init__(
        self,
        options: OutboxOptions,
        budget: Budget,
        release: Callable[[bool, object], HighLevelItem | None],
        patience: Callable[[float], float] = float,
    ) -> None:
        self.wake = threading.Condition(threading.RLock())
        self.counters = {lane: LaneCounters() for lane in Lane}
        self._options = options
        self._budget = budget
        self._release = release
        self._patience = patience
        self._order = 0
        self._emergency = EmergencyLane(
            options.emergency_repeats, options.emergency_interval, options.emergency_patience
        )
        self._watchdog: tuple[Packet, float] | None = None
        self._commands: deque[HighLevelItem] = deque()
        self._awaiting: _Awaiting | None = None
        self._uploads: set[int] = set()
        self._setpoint: _Setpoint | None = None
        self._setpoint_due = 0.0
        self._extpose: tuple[tuple[Packet, ...], float] | None = None
        self._extpose_due = 0.0
        self._rest: deque[Job] = deque()
        self._rest_due = 0.0
        self._kind: object = None
        self.reset()

    def reset(self) -> None:
        """Forget what waits, as after a new connection; an emergency stop stays."""
        with self.wake:
            # Whoever was connected before may have streamed.
            self._low_level = True
            self._streaming = False
            self._undeclared = False
            self._release_at = math.inf
            self._remain_ms = 0
            self._notify_left = 0
            self._notify_due = math.inf
            self._awaiting = None
            self._setpoint = None
            self._extpose = None
            self._kind = None
            self._fail_commands("the link was renewed")
            self._drop_rest()
            self.wake.notify_all()

    # Hand in

    def emergency(self, packet: Packet, now: float) -> None:
        """Send before everything else, repeatedly; nothing that flies is sent afterwards."""
        with self.wake:
            self.counters[Lane.EMERGENCY].offered += 1
            self._emergency.request(packet, now)
            self._stop_flying("emergency stop")
            self.wake.notify_all()

    def emergency_confirmed(self) -> None:
        """The vehicle says that it is locked: stop repeating, once the first burst is over."""
        with self.wake:
            self._emergency.confirmed()

    @property
    def streaming(self) -> bool:
        """Whether setpoints are in charge, and nobody has said that they are over."""
        return self._undeclared

    @property
    def locked(self) -> bool:
        """Whether an emergency stop was sent; flight commands are dropped since."""
        return self._emergency.locked

    def unlock(self) -> None:
        """Forget an emergency stop: the vehicle was rebooted."""
        with self.wake:
            self._emergency.forget()

    def feed_watchdog(self, packet: Packet, now: float) -> None:
        """Send with priority; newest wins."""
        with self.wake:
            counters = self.counters[Lane.WATCHDOG]
            counters.offered += 1
            counters.overwritten += self._watchdog is not None
            self._watchdog = (packet, now)
            self.wake.notify_all()

    def setpoint(self, packets: tuple[Packet, ...], kind: object, now: float) -> None:
        """Stream a setpoint; newest wins. All but the last packet are only sent when the kind
        of setpoint changes."""
        with self.wake:
            counters = self.counters[Lane.SETPOINT]
            counters.offered += 1
            if self._emergency.locked:
                counters.dropped += 1
                return
            counters.overwritten += self._setpoint is not None
            self._undeclared = True
            first = packets[:-1] if kind != self._kind else ()
            self._kind = kind
            self._setpoint = _Setpoint(packets[-1:], first, now, self._next_order())
            self.wake.notify_all()

    def command(self, item: HighLevelItem, now: float) -> None:
        """Queue a command to the high-level commander; in order, also with the setpoints."""
        with self.wake:
            counters = self.counters[Lane.COMMAND]
            counters.offered += 1
            if self._emergency.locked or len(self._commands) >= self._options.capacity:
                counters.dropped += 1
                reason = "emergency stop" if self._emergency.locked else "too many commands wait"
                item.done(None, reason)
                return
            item.born, item.order = now, self._next_order()
            if item.takes_over:
                self._undeclared = False
                item.remain_ms, self._remain_ms = self._remain_ms, 0
                self._release_at = math.inf
                self._drop_waiting_starts()
            self._commands.append(item)
            self.wake.notify_all()

    def setpoints_over(self, remain_ms: int, now: float) -> None:
        """The script says that its stream is over. A command is expected to follow; without
        one the vehicle is released when ``remain_ms`` have passed (at least 0.1 s)."""
        with self.wake:
            self._undeclared = False
            if not self._low_level and self._setpoint is None:
                return  # the high-level commander is in charge already
            self._remain_ms = remain_ms
            self._streaming = False
            self._release_at = now + min(max(0.1, 1e-3 * remain_ms), self._options.stream_timeout)
            self.wake.notify_all()

    def extpose(self, packets: tuple[Packet, ...], now: float) -> None:
        """Send measured poses; newest wins."""
        with self.wake:
            counters = self.counters[Lane.EXTPOSE]
            counters.offered += 1
            counters.overwritten += self._extpose is not None
            self._extpose = (packets, now)
            self.wake.notify_all()

    def rest(
        self, now: float, packets: tuple[Packet, ...] = (), action: Callable[[], None] | None = None
    ) -> bool:
        """Queue something that is not urgent; False if the queue is full."""
        with self.wake:
            counters = self.counters[Lane.REST]
            counters.offered += 1
            if len(self._rest) >= self._options.capacity:
                counters.dropped += 1
                return False
            self._rest.append(Job(Lane.REST, now, packets, action))
            self.wake.notify_all()
            return True

    def upload_begins(self, trajectory: int) -> None:
        """A trajectory is being uploaded: starts of it wait."""
        with self.wake:
            self._uploads.add(trajectory)

    def upload_ends(self, trajectory: int, now: float) -> None:
        """The upload is done, or has failed: starts of it no longer wait."""
        with self.wake:
            self._uploads.discard(trajectory)
            for item in self._commands:
                if item.needs_upload == trajectory:
                    item.born = now
            self.wake.notify_all()

    def answer(self, command: int, code: int, now: float) -> None:
        """The vehicle answered the high-level command whose first byte is ``command``."""
        with self.wake:
            awaiting = self._awaiting
            if awaiting is None or awaiting.item.packet.data[0] != command:
                return
            self._awaiting = None
            # A setpoint that waits is newer: it takes the vehicle back anyway.
            if awaiting.hand_over and code == 0 and self._setpoint is None:
                self._notify(now, awaiting.item.remain_ms)
            awaiting.item.done(code, "")
            self.wake.notify_all()

    # Take out

    def sent(self, job: Job, ok: bool) -> None:
        """Account for a job: its packets left, or there was no link."""
        with self.wake:
            counters = self.counters[job.lane]
            if ok:
                counters.sent += len(job.packets) or 1
                counters.repeated += job.repeated
                return
            counters.dropped += not job.repeated
            if job.lane is Lane.EMERGENCY:
                self._emergency.failed()

    def poll(self, now: float) -> Job | float:
        """Next job, or seconds to wait for one (until somebody hands something in)."""
        with self.wake:
            for take in (
                self._emergency.poll,
                self._poll_watchdog,
                self._poll_notify,
                self._poll_commands,
                self._poll_setpoint,
                self._poll_extpose,
                self._poll_rest,
            ):
                job = take(now)
                if job is not None:
                    if not job.repeated:
                        self.counters[job.lane].aged(now - job.born)
                    return job
            return self._wait(now)

    def _poll_watchdog(self, now: float) -> Job | None:
        if self._watchdog is None:
            return None
        (packet, born), self._watchdog = self._watchdog, None
        return Job(Lane.WATCHDOG, born, (packet,))

    def _poll_notify(self, now: float) -> Job | None:
        if not self._notify_left or now < self._notify_due:
            return None
        # Unanswered, so it is repeated; a vehicle that is released already takes no notice.
        self._notify_left -= 1
        self._notify_due = now + _NOTIFY_INTERVAL if self._notify_left else math.inf
        first = self._notify_left == _NOTIFY_REPEATS - 1
        packet = notify_setpoints_stop(self._notify_ms)
        return Job(Lane.COMMAND, self._notify_born, (packet,), repeated=not first)

    def _poll_commands(self, now: float) -> Job | None:
        counters = self.counters[Lane.COMMAND]
        awaiting = self._awaiting
        if awaiting is not None:
            if now < awaiting.due:
                return None
            if awaiting.tries < self._options.ack_tries:
                awaiting.tries += 1
                awaiting.due = now + self._patience(self._options.ack_timeout)
                return Job(Lane.COMMAND, awaiting.item.born, (awaiting.item.packet,), repeated=True)
            self._awaiting = None
            counters.dropped += 1
            awaiting.item.done(None, f"not answered after {awaiting.tries} tries")
        while self._commands and self._commands[0].expires:
            item = self._commands[0]
            waits = item.needs_upload is not None and item.needs_upload in self._uploads
            if waits or now - item.born <= self._options.command_expiry:
                break
            self._commands.popleft()
            counters.dropped += 1
            item.done(None, f"could not be sent within {self._options.command_expiry:g} s")
        if not self._commands and now >= self._release_at:
            self._end_stream(now)
        if not self._commands:
            return None
        item = self._commands[0]
        if item.needs_upload is not None and item.needs_upload in self._uploads:
            return None
        setpoint = self._setpoint
        if setpoint is not None and setpoint.order < item.order:
            if not item.takes_over:
                return None
            # The command ends the stream, so the setpoint before it would change nothing.
            self._setpoint = None
            self.counters[Lane.SETPOINT].overwritten += 1
        self._commands.popleft()
        if item.takes_over:
            self._streaming = False
            self._release_at = math.inf
        hand_over = item.takes_over and self._low_level
        self._awaiting = _Awaiting(
            item, now + self._patience(self._options.ack_timeout), 1, hand_over
        )
        return Job(Lane.COMMAND, item.born, (item.packet,))

    def _poll_setpoint(self, now: float) -> Job | None:
        setpoint = self._setpoint
        if setpoint is None or now < self._setpoint_due:
            return None
        if now - setpoint.born > self._options.setpoint_expiry:
            self._setpoint = None
            self.counters[Lane.SETPOINT].dropped += 1
            return None
        if self._budget.wait(now, RESERVE[Lane.SETPOINT]) > 0:
            return None
        self._setpoint = None
        self._setpoint_due = now + 1.0 / self._options.setpoint_rate
        self._low_level = True
        self._streaming = True
        self._release_at = now + self._options.stream_timeout
        # The stream is on again: whatever wanted to end it has been overtaken.
        self._notify_left, self._notify_due = 0, math.inf
        if self._awaiting is not None and self._awaiting.item.takes_over:
            self._awaiting = None
        self._drop_overtaken(setpoint.order)
        return Job(Lane.SETPOINT, setpoint.born, setpoint.first + setpoint.packets)

    def _poll_extpose(self, now: float) -> Job | None:
        if self._extpose is None or now < self._extpose_due:
            return None
        packets, born = self._extpose
        if now - born > self._options.extpose_expiry:
            self._extpose = None
            self.counters[Lane.EXTPOSE].dropped += 1
            return None
        if self._budget.wait(now, RESERVE[Lane.EXTPOSE]) > 0:
            return None
        self._extpose = None
        period = 1.0 / self._options.extpose_rate
        # Due times keep their raster, so that a source at just this rate is not halved.
        self._extpose_due = max(self._extpose_due + period, now + 0.5 * period)
        return Job(Lane.EXTPOSE, born, packets)

    def _poll_rest(self, now: float) -> Job | None:
        if not self._rest or now < self._rest_due:
            return None
        if self._budget.wait(now, RESERVE[Lane.REST]) > 0:
            return None
        self._rest_due = now + 1.0 / self._options.rest_rate
        return self._rest.popleft()

    def _wait(self, now: float) -> float:
        due = min(self._emergency.due, self._release_at)
        if self._notify_left:
            due = min(due, self._notify_due)
        if self._awaiting is not None:
            due = min(due, self._awaiting.due)
        elif self._commands:
            due = min(due, self._commands[0].born + self._options.command_expiry)
        for waiting, at, lane in (
            (self._setpoint, self._setpoint_due, Lane.SETPOINT),
            (self._extpose, self._extpose_due, Lane.EXTPOSE),
            (self._rest, self._rest_due, Lane.REST),
        ):
            if waiting:
                due = min(due, max(at, now + self._budget.wait(now, RESERVE[lane])))
        # Never zero: a wait that is due but held back by another lane must not spin.
        return max(due - now, 1e-3)

    # Ends of streams

    def _end_stream(self, now: float) -> None:
        self._release_at = math.inf
        silent, self._streaming = self._streaming, False
        item = None if self._emergency.locked else self._release(silent, self._kind)
        if item is None:
            if self._low_level and not self._emergency.locked:
                self._notify(now, self._remain_ms)
            return
        item.born, item.order = now, self._next_order()
        self._commands.append(item)

    def _notify(self, now: float, remain_ms: int) -> None:
        self._low_level = False
        self._streaming = False
        self._notify_left = _NOTIFY_REPEATS
        self._notify_born = self._notify_due = now
        self._notify_ms = remain_ms

    # Housekeeping

    def _next_order(self) -> int:
        self._order += 1
        return self._order

    def _drop_waiting_starts(self) -> None:
        kept: deque[HighLevelItem] = deque()
        for item in self._commands:
            if item.needs_upload is not None and item.needs_upload in self._uploads:
                self.counters[Lane.COMMAND].dropped += 1
                item.done(None, "a later command came before its upload was done")
            else:
                kept.append(item)
        self._commands = kept

    def _drop_overtaken(self, order: int) -> None:
        kept: deque[HighLevelItem] = deque()
        for item in self._commands:
            if item.takes_over and item.order < order:
                self.counters[Lane.COMMAND].dropped += 1
                item.done(None, "a streamed setpoint came after it")
            else:
                kept.append(item)
        self._commands = kept

    def _fail_commands(self, reason: str) -> None:
        items = list(self._commands)
        self._commands.clear()
        if self._awaiting is not None:
            items.insert(0, self._awaiting.item)
            self._awaiting = None
        for item in items:
            self.counters[Lane.COMMAND].dropped += 1
            item.done(None, reason)

    def _drop_rest(self) -> None:
        self.counters[Lane.REST].dropped += len(self._rest)
        self._rest.clear()

    def _stop_flying(self, reason: str) -> None:
        if self._setpoint is not None:
            self._setpoint = None
            self.counters[Lane.SETPOINT].dropped += 1
        self._release_at = math.inf
        self._streaming = False
        self._notify_left, self._notify_due = 0, math.inf
        self._fail_commands(reason)
