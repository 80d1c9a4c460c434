"""One vehicle: its connection, its sender thread, and what a command becomes on the way."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Any

from cflib.crtp.crtpstack import CRTPPacket, CRTPPort

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat import pitfalls
from crazyarena.crazyswarm_compat.checks import beyond_memory, verb
from crazyarena.crazyswarm_compat.config import VehicleConfig
from crazyarena.crazyswarm_compat.radio import packets as pk
from crazyarena.crazyswarm_compat.radio.avoidance import AVOIDANCE_SWITCH, avoidance_params
from crazyarena.crazyswarm_compat.radio.budget import Budget
from crazyarena.crazyswarm_compat.radio.client import Client
from crazyarena.crazyswarm_compat.radio.connecting import open_connection
from crazyarena.crazyswarm_compat.radio.events import (
    CommandDoubtful,
    CommandLost,
    CommandRefused,
    EventLog,
    LinkLost,
    LinkUp,
    StreamEnded,
    TrajectoryUploaded,
    VehicleRestarted,
)
from crazyarena.crazyswarm_compat.radio.hand_over import until_told
from crazyarena.crazyswarm_compat.radio.lanes import HighLevelItem
from crazyarena.crazyswarm_compat.radio.options import RadioOptions
from crazyarena.crazyswarm_compat.radio.outbox import Outbox
from crazyarena.crazyswarm_compat.radio.parameters import Parameters
from crazyarena.crazyswarm_compat.radio.quality import LinkStatistics, Pings, RoundTrip
from crazyarena.crazyswarm_compat.radio.radio_driver import ScheduledRadioDriver
from crazyarena.crazyswarm_compat.radio.sender import Sender
from crazyarena.crazyswarm_compat.radio.telemetry import FLYING, LOCKED, TelemetryReader
from crazyarena.crazyswarm_compat.radio.trajectory_memory import TrajectoryMemory
from crazyarena.errors import BackendError, CommandError

_CONTROLLER = "stabilizer.controller"
_MASK_PARAM = "hlCommander.groupmask"


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
        self._round_trip = RoundTrip()
        self.outbox = Outbox(options.outbox, budget, self._take_over, self._round_trip.patience)
        self._packets_sent = 0
        self.telemetry = TelemetryReader(
            clock, options.state_rate, options.health_rate, self._packets_out
        )
        self.telemetry.plant_rate = options.plant_rate
        self.telemetry.certainty_rate = options.certainty_rate
        self.telemetry.on_restart = self._restarted
        self.pings = Pings(self._round_trip)
        self.client: Client | None = None
        self.connected = False
        self.protocol = -1
        self.group_mask = 0
        self.last_heard = -math.inf
        self.last_pose: tuple[float, Any] | None = None
        self.hears_peers = False
        self._fully_connected = threading.Event()
        self._failure: str | None = None
        self._seen_locked = False
        self._silent_since: float | None = None
        self._uploaded: set[int] = set()
        self._doubted: type | None = None
        self._life = threading.Lock()
        self._closing = False
        self.parameters = Parameters(
            self.name,
            options.param_timeout,
            self._round_trip.patience,
            lambda: self.client,
            lambda verb, action: self._later(verb, action=action),
            self._lost_command,
        )
        self._memory = TrajectoryMemory(
            self.name,
            options.upload_timeout,
            clock,
            lambda: self.client,
            lambda item: self.outbox.command(item, clock.now()),
        )
        self._sender = Sender(
            self.name,
            clock,
            self.outbox,
            self.pings,
            options.ping_rate,
            self.transmit,
            has_link=lambda: self.client is not None,
            answering=self._fully_connected.is_set,
        )
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
        options = self._options
        client = Client(
            options.cache,
            self._clock,
            self._round_trip,
            options.parameters,
            options.in_flight,
            options.driver == "scheduled",
        )
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
        self.parameters.attach(client)
        with self._life:
            if self._closing:
                raise BackendError(f"{self.name}: closed")
            self.client = client
        try:
            open_connection(
                client,
                self.config.uri,
                self.name,
                timeout,
                self._clock,
                self._fully_connected,
                failure=lambda: self._failure,
                abandoned=lambda: self._closing,
            )
        except BaseException:
            self.client = None
            client.drop_link()
            raise
        self.protocol = int(client.platform.get_protocol_version())
        self.group_mask = int(self.parameters.cached(_MASK_PARAM) or 0)
        self.pings.forget()
        self.outbox.reset()
        self.telemetry.start(client)
        self.last_heard = self._clock.now()
        with self._life:
            abandoned = self._closing
            if not abandoned:
                self._up(self.last_heard)
        if abandoned:
            self.drop()
            raise BackendError(f"{self.name}: closed")

    def _fail(self, client: Client, why: str) -> None:
        if client is not self.client:
            return
        self._failure = why
        self.lost(why.strip().splitlines()[0] if why.strip() else "link error")

    def _up(self, now: float) -> None:
        since, self._silent_since = self._silent_since, None
        self.connected = True
        self._events.emit(LinkUp(now, self.id, 0.0 if since is None else now - since))

    def lost(self, reason: str) -> None:
        """Note that the link is gone; emits an event the first time."""
        if self.connected:
            self.connected = False
            self._silent_since = self.last_heard
            self._events.emit(LinkLost(self._clock.now(), self.id, reason))

    def _restarted(self) -> None:
        self._uploaded.clear()
        self._events.emit(VehicleRestarted(self._clock.now(), self.id))

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
            self._up(now)

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
        """Stop the sender and close the connection, also one that is just being made."""
        with self._life:
            self._closing = True
        self._sender.close()
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
            self._doubt_setpoint(command)
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
            for name, value in avoidance_params(command, self.parameters.has, self.name):
                self._write_later(name, value)
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
        if takes_over and self.outbox.streaming and not isinstance(command, c.Stop):
            self._doubt(name, pitfalls.NOT_NOTIFIED)
        if upload is not None and upload not in self._uploaded:
            self._doubt(
                name, f"trajectory {upload} was not uploaded by this program; {pitfalls.IGNORED}"
            )
        item = HighLevelItem(packet, name, takes_over, self._done(name), upload)
        self.outbox.command(item, self._clock.now())

    def _doubt(self, name: str, reason: str) -> None:
        self._events.emit(CommandDoubtful(self._clock.now(), self.id, name, reason))

    def _doubt_setpoint(self, command: c.Command) -> None:
        """Say so when a stream begins that the vehicle's controller does not follow."""
        kind = type(command)
        begins, self._doubted = kind is not self._doubted, kind
        if (
            begins
            and isinstance(command, (c.VelocityWorld, c.Hover))
            and self.parameters.cached(_CONTROLLER) == pitfalls.MELLINGER
        ):
            self._doubt(verb(command), pitfalls.VELOCITY_WITH_MELLINGER)

    def _done(self, name: str) -> Callable[[int | None, str], None]:
        def done(code: int | None, reason: str) -> None:
            if code is None:
                self._lost_command(name, reason)
            elif code != 0:
                self._events.emit(CommandRefused(self._clock.now(), self.id, name, code))

        return done

    def _high_level_answer(self, packet: Any) -> None:
        data = packet.data
        if packet.channel == 0 and len(data) >= 4:
            self.outbox.answer(data[0], data[3], self._clock.now())

    def _lost_command(self, verb: str, reason: str) -> None:
        self._events.emit(CommandLost(self._clock.now(), self.id, verb, reason))

    def _later(
        self,
        name: str,
        packets: tuple[pk.Packet, ...] = (),
        action: Callable[[], None] | None = None,
    ) -> None:
        now = self._clock.now()
        if not self.outbox.rest(now, packets, action):
            self._lost_command(name, "too many commands wait")

    def _take_over(self, silent: bool, kind: object) -> HighLevelItem | None:
        """What the high-level commander is to do when a stream is over and nothing follows."""
        telemetry = self.telemetry.latest
        flags = telemetry.supervisor
        now = self._clock.now()
        if kind is c.CutMotors or (flags is not None and not flags & FLYING):
            self._events.emit(StreamEnded(now, self.id, "idle"))
            return None
        action, command = until_told(telemetry.state)
        packet = pk.high_level(command, self.protocol, self.name)
        assert packet is not None
        self._events.emit(StreamEnded(now, self.id, action))
        return HighLevelItem(packet, action, True, self._done(action))

    # Parameters

    def _write_later(self, name: str, value: float) -> float:
        stored = self.parameters.write_later(name, value)
        if name == _MASK_PARAM:
            self.group_mask = int(stored)
        elif name == AVOIDANCE_SWITCH:
            self.hears_peers = bool(stored)
        return stored

    def set_param(self, name: str, value: float) -> None:
        """Write a parameter and compare what the vehicle answers (blocks).

        Raises
        ------
        BackendError
            if it is not acknowledged in time or reads back differently.
        CommandError
            if the value does not fit.
        """
        stored = self._write_later(name, value)
        self.parameters.wait_written(name)
        self.parameters.compare(name, stored)

    # Trajectories

    def _upload_in_background(self, command: c.UploadTrajectory) -> None:
        too_much = beyond_memory(command)
        if too_much is not None:
            raise CommandError(f"{self.name}: uploadTrajectory: {too_much}")
        pk.trajectory_bytes(command.pieces)
        ident = int(command.trajectory_id)
        self.outbox.upload_begins(ident)
        self._uploaded.add(ident)

        def work() -> None:
            try:
                self.upload(ident, int(command.piece_offset), command.pieces)
            except BackendError as error:
                self._uploaded.discard(ident)
                self._lost_command("uploadTrajectory", str(error))
            finally:
                self.outbox.upload_ends(ident, self._clock.now())

        threading.Thread(target=work, name=f"upload-{self.name}", daemon=True).start()

    def upload(self, ident: int, piece_offset: int, pieces: Any) -> None:
        """See :meth:`.trajectory_memory.TrajectoryMemory.upload`."""
        self._memory.upload(ident, piece_offset, pieces)
        self._uploaded.add(ident)
        self._events.emit(TrajectoryUploaded(self._clock.now(), self.id, ident))

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
