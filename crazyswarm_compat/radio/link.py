"""One vehicle: its connection, its sender thread, and what a command becomes on the way."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
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
from crazyarena.crazyswarm_compat.radio.lanes import HighLevelItem
from crazyarena.crazyswarm_compat.radio.options import RadioOptions
from crazyarena.crazyswarm_compat.radio.outbox import Outbox
from crazyarena.crazyswarm_compat.radio.parameters import Parameters
from crazyarena.crazyswarm_compat.radio.quality import LinkStatistics, Pings
from crazyarena.crazyswarm_compat.radio.sender import Sender
from crazyarena.crazyswarm_compat.radio.telemetry import FLYING, LOCKED, TelemetryReader
from crazyarena.crazyswarm_compat.radio.trajectory_memory import TrajectoryMemory
from crazyarena.errors import BackendError

_MASK_PARAM = "hlCommander.groupmask"
_RETRY_IDENTITY = 0.5
# Taking over a vehicle whose stream fell silent: below this height it lands.
_LOW = 0.15
_BRAKING = 2.0  # m/s2


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
            clock,
            options.state_rate,
            options.health_rate,
            lambda: self._packets_sent,
            options.plant_rate,
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
        self._seen_locked = False
        self._parameters = Parameters(
            self.name,
            options.param_timeout,
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
        cache = self._options.cache
        client = Client(cache)
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
        self._parameters.attach(client)
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
        self._sender.close()
        self.drop()

    def _heard(self, _: Any) -> None:
        self.last_heard = self._clock.now()

    def _went_out(self, _: Any) -> None:
        # Whoever sent it, cflib included.
        self._packets_sent += 1
        self._budget.spend(self._clock.now())

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

    def _write_later(self, name: str, value: float) -> float:
        stored = self._parameters.write_later(name, value)
        if name == _MASK_PARAM:
            self.group_mask = int(stored)
        return stored

    def cached_param(self, name: str) -> float | None:
        """Last value that the vehicle told, None if it has no such parameter."""
        return self._parameters.cached(name)

    def get_param(self, name: str) -> float:
        """See :meth:`.parameters.Parameters.get`."""
        return self._parameters.get(name)

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
        self._parameters.wait_written(name)
        self._parameters.compare(name, stored)

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
                self._lost_command("uploadTrajectory", str(error))
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
        self._memory.upload(ident, piece_offset, pieces)
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
