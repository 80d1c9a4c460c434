"""One vehicle: its connection, its sender thread, its parameters and trajectory memory."""

from __future__ import annotations

import logging
import math
import struct
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from cflib.crtp.crtpstack import CRTPPacket, CRTPPort

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.checks import verb
from crazyarena.crazyswarm_compat.config import VehicleConfig
from crazyarena.crazyswarm_compat.radio import packets as pk
from crazyarena.crazyswarm_compat.radio.budget import Budget
from crazyarena.crazyswarm_compat.radio.client import Client
from crazyarena.crazyswarm_compat.radio.events import (
    CommandLost,
    CommandRefused,
    EventLog,
    LinkLost,
    LinkUp,
    StreamEnded,
    TrajectoryUploaded,
)
from crazyarena.crazyswarm_compat.radio.options import RadioOptions
from crazyarena.crazyswarm_compat.radio.outbox import (
    HighLevelItem,
    Job,
    Lane,
    LaneStatistics,
    Outbox,
)
from crazyarena.crazyswarm_compat.radio.radio_driver import ScheduledRadioDriver
from crazyarena.crazyswarm_compat.radio.telemetry import FLYING, LOCKED, TelemetryReader
from crazyarena.errors import BackendError, CommandError

_LOG = logging.getLogger(__name__)

_TRAJECTORY_MEMORY = 0x12
_MASK_PARAM = "hlCommander.groupmask"
_RETRY_IDENTITY = 0.5
_IDLE = 1.0  # s, longest sleep of the sender
_PINGS = 50  # echoes in the window of the statistics
_PING_LOST = 0.5  # s
# Taking over a vehicle whose stream fell silent: below this height it lands.
_LOW = 0.15
_BRAKING = 2.0  # m/s2


@dataclass(frozen=True, slots=True)
class LinkStatistics:
    """Traffic and quality of one link.

    lanes: by class. pings, pings_lost: echoes that had time to come back, and those that did
    not; round_trip_loss their ratio over the last 50, None before the first; latency_p50,
    latency_p95: round trip, s, over those. log_packets, log_missed: packets of the log blocks
    that came, and those that their time stamps show missing. uplink_sent, uplink_arrived:
    packets to the vehicle since it first told its own count, and how many it got; 0 where its
    firmware does not count. A Crazyradio repeats what is not acknowledged, so that loss shows
    as latency there.
    """

    lanes: dict[Lane, LaneStatistics]
    pings: int
    pings_lost: int
    round_trip_loss: float | None
    latency_p50: float | None
    latency_p95: float | None
    log_packets: int
    log_missed: int
    uplink_sent: int
    uplink_arrived: int

    @property
    def downlink_loss(self) -> float | None:
        """Share of the log packets that were lost."""
        total = self.log_packets + self.log_missed
        return self.log_missed / total if total else None

    @property
    def uplink_loss(self) -> float | None:
        """Share of the packets to the vehicle that did not arrive."""
        if not self.uplink_sent:
            return None
        return max(0.0, 1.0 - self.uplink_arrived / self.uplink_sent)


class Pings:
    """Echoes under way and their results."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._number = 0
        self._under_way: dict[int, float] = {}
        self._window: deque[float | None] = deque(maxlen=_PINGS)
        self.total = 0
        self.lost = 0

    def send(self, now: float) -> pk.Packet:
        """Next echo request; those without an answer by now count as lost."""
        with self._lock:
            for number, sent in list(self._under_way.items()):
                if now - sent > _PING_LOST:
                    del self._under_way[number]
                    self._count(None)
            self._number += 1
            self._under_way[self._number] = now
            return pk.ping(self._number)

    def received(self, data: bytes, now: float) -> None:
        """An echo came back."""
        number = pk.ping_number(data)
        with self._lock:
            sent = None if number is None else self._under_way.pop(number, None)
            if sent is not None:
                self._count(now - sent)

    def forget(self) -> None:
        """The link is new: what is under way is nobody's."""
        with self._lock:
            self._under_way.clear()
            self._window.clear()

    def _count(self, latency: float | None) -> None:
        self.total += 1
        self.lost += latency is None
        self._window.append(latency)

    def summary(self) -> tuple[float | None, float | None, float | None]:
        """Loss, median and 95th percentile of the round trip over the window."""
        with self._lock:
            window = list(self._window)
        if not window:
            return None, None, None
        times = [latency for latency in window if latency is not None]
        loss = 1.0 - len(times) / len(window)
        if not times:
            return loss, None, None
        middle, high = np.percentile(times, (50, 95))
        return loss, float(middle), float(high)


class VehicleLink:
    """The link to one vehicle.

    Nothing here blocks but the methods that say so; errors of the link become events.

    Parameters
    ----------
    config: the vehicle; ``uri`` is anything that cflib opens.
    clock: a wall clock.
    budget: air time, shared by the vehicles of one radio.
    """

    def __init__(
        self,
        config: VehicleConfig,
        clock: Clock,
        options: RadioOptions,
        budget: Budget,
        events: EventLog,
    ) -> None:
        self.config = config
        self.id = config.id
        self.name = config.name
        self._clock = clock
        self._options = options
        self._budget = budget
        self._events = events
        self.outbox = Outbox(options.outbox, budget, self._take_over)
        self._packets_sent = 0
        self.telemetry = TelemetryReader(
            clock, options.state_rate, options.health_rate, self._packets_out
        )
        self.pings = Pings()
        self.client: Client | None = None
        self.connected = False
        self.protocol = -1
        self.group_mask = 0
        self.last_heard = -math.inf
        self.last_pose: tuple[float, Any] | None = None
        self.hears_peers = False
        self._fully_connected = threading.Event()
        self._failure: str | None = None
        self._answered = threading.Condition()
        self._writes: dict[str, int] = {}
        self._closing = False
        self._seen_locked = False
        self._next_ping = 0.0
        self._upload_lock = threading.Lock()
        self._sender = threading.Thread(target=self._send_loop, name=f"send-{self.name}")
        self._sender.daemon = True
        self._sender.start()

    # Connection

    def connect(self, timeout: float) -> None:
        """Open the link and wait until table of contents and parameters are here.

        Raises
        ------
        BackendError
            naming the vehicle, its link and what to look at.
        """
        assert self.config.uri is not None
        self._fully_connected.clear()
        self._failure = None
        cache = self._options.cache
        client = Client(cache, self._options.driver == "scheduled")
        client.fully_connected.add_callback(lambda _: self._fully_connected.set())
        client.connection_failed.add_callback(lambda _, why: self._fail(client, why))
        client.connection_lost.add_callback(lambda _, why: self._fail(client, why))
        client.disconnected_link_error.add_callback(lambda _, why: self._fail(client, why))
        client.packet_received.add_callback(self._heard)
        client.packet_sent.add_callback(self._went_out)
        client.add_port_callback(CRTPPort.SETPOINT_HL, self._high_level_answer)
        client.add_header_callback(self._echo, CRTPPort.LINKCTRL, 0)
        client.link_statistics.link_quality_updated.add_callback(
            lambda percent: self.telemetry.quality(0.01 * float(percent))
        )
        client.param.add_update_callback(cb=self._param_answer)
        deadline = self._clock.now() + timeout
        self.client = client
        try:
            client.open_link(self.config.uri)
            while not self._fully_connected.wait(_RETRY_IDENTITY):
                if self._failure is not None or self._clock.now() > deadline:
                    raise BackendError(self._no_connection(client, timeout))
                if client.platform.get_protocol_version() < 0 and client.link is not None:
                    client.ask_identity()
        except BaseException:
            self.client = None
            client.drop_link()
            raise
        self.protocol = int(client.platform.get_protocol_version())
        self.group_mask = int(self.cached_param(_MASK_PARAM) or 0)
        self.pings.forget()
        self.outbox.reset()
        self.telemetry.start(client)
        outage = self._clock.now() - self.last_heard if math.isfinite(self.last_heard) else 0.0
        self.last_heard = self._clock.now()
        self.connected = True
        self._events.emit(LinkUp(self._clock.now(), self.id, max(0.0, outage)))

    def _no_connection(self, client: Client, timeout: float) -> str:
        where = f"{self.name} ({self.config.uri})"
        if self._failure is not None:
            # A driver's message may end in a traceback, whose last line says what it was.
            lines = self._failure.strip().splitlines() or ["unknown reason"]
            return (
                f"{where}: cannot connect: {lines[-1].strip()}; is the vehicle switched on, and "
                "the radio plugged in?"
            )
        if client.platform.get_protocol_version() < 0:
            return (
                f"{where}: no answer within {timeout:g} s; is the vehicle switched on, and are "
                "radio, channel, data rate and address right?"
            )
        return (
            f"{where}: answers, but its parameters did not arrive within {timeout:g} s; the link "
            "is bad, move closer or change the channel"
        )

    def _fail(self, client: Client, why: str) -> None:
        if client is not self.client:
            return
        self._failure = why
        self.lost(why.strip().splitlines()[0] if why.strip() else "link error")

    def lost(self, reason: str) -> None:
        """Note that the link is gone; emits an event the first time."""
        if self.connected:
            self.connected = False
            self._events.emit(LinkLost(self._clock.now(), self.id, reason))

    def check_silence(self, now: float) -> None:
        """Detect that the vehicle has fallen silent, or speaks again."""
        client = self.client
        if client is None or client.link is None:
            if self.connected:
                self.lost("the link driver gave up")
            return
        age = now - self.last_heard
        if self.connected and age > self._options.link_timeout:
            self.lost(f"nothing heard for {age:.2f} s")
        elif not self.connected and self._fully_connected.is_set() and age < 0.1:
            self.connected = True
            self._events.emit(LinkUp(now, self.id))

    @property
    def driver_gone(self) -> bool:
        """Whether only a new connection can help."""
        return self.client is None or self.client.link is None

    def drop(self) -> None:
        """Close the connection silently: the vehicle goes on with what it does."""
        client, self.client = self.client, None
        self.connected = False
        self._fully_connected.clear()
        if client is not None:
            client.drop_link()

    def close(self) -> None:
        """Stop the sender and close the connection."""
        self._closing = True
        with self.outbox.wake:
            self.outbox.wake.notify_all()
        self._sender.join(timeout=3.0)
        self.drop()

    def _heard(self, _: Any) -> None:
        self.last_heard = self._clock.now()

    def _went_out(self, _: Any) -> None:
        # Whoever sent it, cflib included.
        self._packets_sent += 1
        self._budget.spend(self._clock.now())

    def _packets_out(self) -> int:
        """Packets that have gone to the vehicle, without those that newer ones replaced."""
        client = self.client
        driver = None if client is None else client.link
        if isinstance(driver, ScheduledRadioDriver):
            return self._packets_sent - driver.replaced()
        return self._packets_sent

    def _echo(self, packet: Any) -> None:
        self.pings.received(bytes(packet.data), self._clock.now())

    # Sending

    def transmit(self, packet: pk.Packet) -> None:
        """Hand a packet to cflib; called by the sender thread alone.

        Raises
        ------
        ConnectionError
            if there is no link.
        """
        client = self.client
        if client is None or client.link is None:
            raise ConnectionError(f"{self.name}: not connected")
        crtp = CRTPPacket()
        crtp.set_header(packet.port, packet.channel)
        crtp.data = packet.data
        client.send_packet(crtp)

    def _send_loop(self) -> None:
        outbox = self.outbox
        while not self._closing:
            with outbox.wake:
                now = self._clock.now()
                job = outbox.poll(now)
                if not isinstance(job, Job):
                    ping_in = self._next_ping - now if self.client is not None else _IDLE
                    if ping_in > 0:
                        outbox.wake.wait(min(job, ping_in, _IDLE))
                        continue
            if isinstance(job, Job):
                self._run(job)
            self._ping(self._clock.now())

    def _run(self, job: Job) -> None:
        try:
            for packet in job.packets:
                self.transmit(packet)
            if job.action is not None:
                job.action()
        except Exception as error:
            # Whatever the driver throws, the other traffic goes on.
            if not isinstance(error, ConnectionError):
                _LOG.warning("%s: sending failed: %s", self.name, error)
            self.outbox.sent(job, False)
            if job.lane is Lane.EMERGENCY or job.lane is Lane.COMMAND:
                self._clock.sleep_until(self._clock.now() + 0.01)
            return
        self.outbox.sent(job, True)

    def _ping(self, now: float) -> None:
        if now < self._next_ping or self.client is None:
            return
        self._next_ping = now + 1.0 / self._options.ping_rate
        if not self._fully_connected.is_set():
            return
        try:
            self.transmit(self.pings.send(now))
        except Exception as error:
            _LOG.debug("%s: ping failed: %s", self.name, error)

    # Commands

    def send(self, command: c.Command) -> None:
        """Put a checked command on its way; returns at once.

        Raises
        ------
        CommandError, BackendError
            for a command that this vehicle can never execute.
        """
        now = self._clock.now()
        protocol = self.protocol
        setpoint = pk.setpoint(command, protocol, self.name)
        if setpoint is not None:
            self.outbox.setpoint(setpoint, type(command), now)
        elif isinstance(command, c.Emergency):
            self.emergency()
        elif isinstance(command, c.NotifySetpointsStop):
            if self._addressed(command.group_mask):
                self.outbox.setpoints_over(int(command.remain_valid_ms), now)
        elif isinstance(command, c.UploadTrajectory):
            self._upload_in_background(command)
        elif isinstance(command, c.SetParam):
            self._write_later(command.name, command.value)
        elif isinstance(command, c.SetLed):
            levels = (command.red, command.green, command.blue)
            for colour, level in zip(("Red", "Green", "Blue"), levels, strict=True):
                self._write_later(f"ring.solid{colour}", int(255 * float(level)))
        elif isinstance(command, c.CollisionAvoidance):
            self._collision_avoidance(command)
        elif isinstance(command, c.Arm):
            self._later("arm", (pk.arm(bool(command.arm), protocol),))
        else:
            self._high_level(command)

    def emergency(self) -> None:
        """Stop the motors now and for good."""
        self.outbox.emergency(pk.emergency_stop(self.protocol), self._clock.now())

    def feed_watchdog(self) -> None:
        """Keep the onboard emergency-stop watchdog from firing for another second."""
        self.outbox.feed_watchdog(pk.emergency_watchdog(self.protocol), self._clock.now())

    def recover(self) -> None:
        """Ask for recovery from a crash."""
        self._later("recover", (pk.recover(self.protocol),))

    def _addressed(self, group_mask: int) -> bool:
        return group_mask == 0 or bool(int(group_mask) & self.group_mask)

    def _high_level(self, command: c.Command) -> None:
        packet = pk.high_level(command, self.protocol, self.name)
        assert packet is not None
        name = verb(command)
        takes_over = not isinstance(command, c.SetGroupMask)
        # The vehicle would ignore it, but must not lose its stream for it.
        if takes_over and not self._addressed(getattr(command, "group_mask", 0)):
            return
        if isinstance(command, c.SetGroupMask):
            self.group_mask = int(command.group_mask)
        upload = command.trajectory_id if isinstance(command, c.StartTrajectory) else None
        item = HighLevelItem(packet, name, takes_over, self._done(name), upload)
        self.outbox.command(item, self._clock.now())

    def _done(self, name: str) -> Callable[[int | None, str], None]:
        def done(code: int | None, reason: str) -> None:
            now = self._clock.now()
            if code is None:
                self._events.emit(CommandLost(now, self.id, name, reason))
            elif code != 0:
                self._events.emit(CommandRefused(now, self.id, name, code))

        return done

    def _high_level_answer(self, packet: Any) -> None:
        data = packet.data
        if packet.channel == 0 and len(data) >= 4:
            self.outbox.answer(data[0], data[3], self._clock.now())

    def _later(
        self,
        name: str,
        packets: tuple[pk.Packet, ...] = (),
        action: Callable[[], None] | None = None,
    ) -> None:
        now = self._clock.now()
        if not self.outbox.rest(now, packets, action):
            self._events.emit(CommandLost(now, self.id, name, "too many commands wait"))

    def _take_over(self, silent: bool, kind: object) -> HighLevelItem | None:
        """What the high-level commander is to do when a stream is over and nothing follows."""
        telemetry = self.telemetry.latest
        flags = telemetry.supervisor
        now = self._clock.now()
        if kind is c.CutMotors or (flags is not None and not flags & FLYING):
            self._events.emit(StreamEnded(now, self.id, "idle"))
            return None
        state = telemetry.state
        command: c.Command
        if state is not None and state.position[2] < _LOW:
            action, command = "land", c.Land(0.0, 1.0)
        else:
            velocity = np.zeros(3) if state is None else state.velocity
            speed = float(np.linalg.norm(velocity))
            duration = min(3.0, max(0.5, 2.0 * speed / _BRAKING))
            # Half of the way at the present speed is the way of constant braking.
            action, command = "hold", c.GoTo(0.5 * duration * velocity, 0.0, duration, True)
        packet = pk.high_level(command, self.protocol, self.name)
        assert packet is not None
        self._events.emit(StreamEnded(now, self.id, action))
        return HighLevelItem(packet, action, True, self._done(action))

    # Parameters

    def _element(self, name: str) -> Any:
        client = self.client
        toc = None if client is None else client.param.toc
        group, _, variable = name.partition(".")
        element = None if toc is None else toc.get_element(group, variable)
        if element is None:
            raise BackendError(
                f"{self.name}: no parameter {name!r} in this firmware"
                if self.connected
                else f"{self.name}: not connected, so parameter {name!r} is unknown"
            )
        return element

    def _checked(self, name: str, value: float) -> float:
        """The value as the vehicle will store it."""
        element = self._element(name)
        if element.access == element.RO_ACCESS:
            raise CommandError(f"{self.name}: parameter {name} is read-only")
        number = float(value)
        kind = element.pytype
        try:
            if kind not in ("<f", "<d", "<e"):
                number = int(number)
            stored = struct.unpack(kind, struct.pack(kind, number))[0]
        except (struct.error, OverflowError):
            raise CommandError(
                f"{self.name}: {name} is {value!r}; that does not fit into its type {element.ctype}"
            ) from None
        return float(stored)

    def _write_later(self, name: str, value: float) -> None:
        stored = self._checked(name, value)
        if name == _MASK_PARAM:
            self.group_mask = int(stored)
        with self._answered:
            self._writes[name] = self._writes.get(name, 0) + 1
        self._later(f"setParam {name}", action=lambda: self._write(name, stored))

    def _write(self, name: str, value: float) -> None:
        client = self.client
        if client is None or client.link is None:
            with self._answered:
                self._writes.pop(name, None)
            self._events.emit(
                CommandLost(self._clock.now(), self.id, f"setParam {name}", "not connected")
            )
            return
        client.param.set_value(name, value)

    def _param_answer(self, name: str, _: str) -> None:
        with self._answered:
            left = self._writes.get(name, 0) - 1
            if left > 0:
                self._writes[name] = left
            else:
                self._writes.pop(name, None)
            self._answered.notify_all()

    def cached_param(self, name: str) -> float | None:
        """Last value that the vehicle told, None if it has no such parameter."""
        client = self.client
        group, _, variable = name.partition(".")
        text = None if client is None else client.param.values.get(group, {}).get(variable)
        return None if text is None else float(text)

    def get_param(self, name: str) -> float:
        """Value of a parameter, after writes under way are answered (blocks for those).

        Raises
        ------
        BackendError
            if the vehicle has none of this name, or does not answer in time.
        """
        self._element(name)
        self._wait_written(name)
        value = self.cached_param(name)
        if value is None:
            raise BackendError(f"{self.name}: the value of {name} has not arrived yet")
        return value

    def _wait_written(self, name: str) -> None:
        timeout = self._options.param_timeout
        with self._answered:
            if not self._answered.wait_for(lambda: name not in self._writes, timeout):
                raise BackendError(
                    f"{self.name}: writing {name} was not acknowledged within {timeout:g} s"
                )

    def set_param(self, name: str, value: float) -> None:
        """Write a parameter and compare what the vehicle answers (blocks).

        Raises
        ------
        BackendError
            if it is not acknowledged in time or reads back differently.
        CommandError
            if the value does not fit.
        """
        stored = self._checked(name, value)
        self._write_later(name, stored)
        self._wait_written(name)
        read = self.cached_param(name)
        if read is None or not math.isclose(read, stored, rel_tol=1e-6, abs_tol=1e-9):
            raise BackendError(f"{self.name}: wrote {stored} to {name}, but it reads {read}")

    def _collision_avoidance(self, m: c.CollisionAvoidance) -> None:
        if self.cached_param("colAv.enable") is None:
            if m.enable:
                raise BackendError(
                    f"{self.name}: its firmware was built without collision avoidance (colAv.*)"
                )
            return
        if m.enable:
            for axis, name in enumerate("XYZ"):
                self._write_later(f"colAv.ellipsoid{name}", float(m.radii[axis]))
                self._write_later(f"colAv.bboxMin{name}", float(m.bbox_min[axis]))
                self._write_later(f"colAv.bboxMax{name}", float(m.bbox_max[axis]))
            self._write_later("colAv.horizon", m.horizon)
            self._write_later("colAv.maxSpeed", m.max_speed)
        self._write_later("colAv.enable", int(m.enable))
        self.hears_peers = m.enable

    # Trajectories

    def _upload_in_background(self, command: c.UploadTrajectory) -> None:
        pk.trajectory_bytes(command.pieces)
        ident = int(command.trajectory_id)
        self.outbox.upload_begins(ident)

        def work() -> None:
            try:
                self.upload(ident, int(command.piece_offset), command.pieces)
            except BackendError as error:
                self._events.emit(
                    CommandLost(self._clock.now(), self.id, "uploadTrajectory", str(error))
                )
            finally:
                self.outbox.upload_ends(ident, self._clock.now())

        threading.Thread(target=work, name=f"upload-{self.name}", daemon=True).start()

    def upload(self, ident: int, piece_offset: int, pieces: Any) -> None:
        """Write pieces (n, 33) to trajectory memory and declare them a trajectory (blocks).

        Raises
        ------
        BackendError
            if the vehicle has no such memory, refuses, or does not answer in time.
        """
        timeout = self._options.upload_timeout
        where = f"{self.name}: uploadTrajectory {ident}"
        data = pk.trajectory_bytes(pieces)
        deadline = self._clock.now() + timeout
        with self._upload_lock:
            client = self.client
            if client is None or client.link is None:
                raise BackendError(f"{where}: not connected")
            memories = client.mem.get_mems(_TRAJECTORY_MEMORY)
            if not memories:
                raise BackendError(f"{where}: this firmware has no trajectory memory")
            self._write_memory(client, memories[0], pk.PIECE_BYTES * piece_offset, data, where)
            answer: list[tuple[int | None, str]] = []
            answered = threading.Event()

            def done(code: int | None, reason: str) -> None:
                answer.append((code, reason))
                answered.set()

            packet = pk.define_trajectory(ident, piece_offset, len(np.asarray(pieces)))
            self.outbox.command(
                HighLevelItem(packet, "uploadTrajectory", False, done, expires=False),
                self._clock.now(),
            )
            if not answered.wait(max(0.5, deadline - self._clock.now())):
                raise BackendError(f"{where}: not acknowledged within {timeout:g} s")
            code, reason = answer[0]
            if code != 0:
                raise BackendError(f"{where}: {reason or f'refused with error {code}'}")
        self._events.emit(TrajectoryUploaded(self._clock.now(), self.id, ident))

    def _write_memory(
        self, client: Client, memory: Any, address: int, data: bytes, where: str
    ) -> None:
        finished = threading.Event()
        failed: list[bool] = []
        timeout = self._options.upload_timeout

        def good(written: Any, at: int) -> None:
            if written.id == memory.id and at == address:
                finished.set()

        def bad(written: Any, at: int) -> None:
            if written.id == memory.id and at == address:
                failed.append(True)
                finished.set()

        client.mem.mem_write_cb.add_callback(good)
        client.mem.mem_write_failed_cb.add_callback(bad)
        try:
            client.mem.write(memory, address, data)
            if not finished.wait(timeout):
                raise BackendError(f"{where}: {len(data)} bytes not written within {timeout:g} s")
            if failed:
                raise BackendError(f"{where}: the vehicle refused {len(data)} bytes at {address}")
        finally:
            client.mem.mem_write_cb.remove_callback(good)
            client.mem.mem_write_failed_cb.remove_callback(bad)

    # What is known

    def note_supervisor(self) -> None:
        """Let the outbox know when the vehicle has locked itself, or was rebooted since."""
        flags = self.telemetry.latest.supervisor
        if flags is None or not self.outbox.locked:
            return
        if flags & LOCKED:
            self._seen_locked = True
            self.outbox.emergency_confirmed()
        elif self._seen_locked:
            self._seen_locked = False
            self.outbox.unlock()

    def statistics(self) -> LinkStatistics:
        """Traffic so far and the quality of the link lately."""
        loss, middle, high = self.pings.summary()
        received, missed = self.telemetry.packets()
        return LinkStatistics(
            {lane: counters.snapshot() for lane, counters in self.outbox.counters.items()},
            self.pings.total,
            self.pings.lost,
            loss,
            middle,
            high,
            received,
            missed,
            *self.telemetry.uplink(),
        )
