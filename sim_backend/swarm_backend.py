"""Crazyswarm fleets with firmware and dynamics: the ``arena`` vehicles behind a radio's interface.

The link is perfect and the room has a motion-capture system: every vehicle hears poses at a
fixed rate, its own and, for collision avoidance, those of the others. A script begins when the
estimators have settled, as it would in the lab.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from crazyarena.clock import Clock, VirtualClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.checks import MEMORY_PIECES, SIMULATED_PIECES, check, verb
from crazyarena.crazyswarm_compat.config import FleetConfig
from crazyarena.crazyswarm_compat.options import warn
from crazyarena.crazyswarm_compat.pitfalls import (
    MELLINGER,
    NOT_NOTIFIED,
    VELOCITY_WITH_MELLINGER,
)
from crazyarena.crazyswarm_compat.registry import SimOptions
from crazyarena.errors import BackendError, CommandError
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.arena_kernel import DT
from crazyarena.sim_backend.firmware.supervisor import INFO_LOCKED, SV_STOP
from crazyarena.sim_backend.physics.arena_plant import (
    AB_FORCE,
    note_acceleration,
)
from crazyarena.sim_backend.physics.competition_step import (
    B_OMEGA,
    B_POS,
    B_QUAT,
    B_VEL,
)
from crazyarena.sim_backend.physics.rigid_body import FULL_PLANT_SIZE
from crazyarena.sim_backend.stored_trajectories import StoredTrajectories
from crazyarena.sim_backend.vehicles import (
    DEFAULT_VEHICLE,
    Rows,
    load_vehicle,
    vehicle_rows,
)
from crazyarena.types import Pose, Telemetry, VehicleContact

_POSE_TICKS = 10  # ms between motion-capture frames
_SETTLE_TICKS = 2000  # ms before a script begins
# What a locked vehicle still does.
_GROUND_COMMANDS = (c.Emergency, c.SetParam, c.SetLed, c.SetGroupMask, c.UploadTrajectory)
# What the high-level commander is to fly, once it is in charge.
_PLANNED = (c.Takeoff, c.Land, c.GoTo, c.StartTrajectory)
# Answers of a vehicle that a script should hear of. Taking off in flight is not among them.
_REFUSALS = {
    8: "the firmware cannot execute it (trajectory ids go from 0 to 30)",
    16: "the vehicle may not fly now: it is not armed, has tumbled or crashed",
}
_VEHICLES_PER_THREAD = 8  # below that a thread costs more than it brings


class ArenaBackend:
    """A fleet of ``arena`` vehicles on a virtual clock.

    Parameters
    ----------
    make_fleet: builds the vehicles; called like :class:`.arena.ArenaFleet`.
    options: downwash, and the vehicle model instead of those of the fleet.
    """

    def __init__(
        self,
        fleet: FleetConfig,
        clock: VirtualClock,
        make_fleet: Callable[..., ArenaFleet] = ArenaFleet,
        options: SimOptions | None = None,
    ) -> None:
        options = options or SimOptions()
        self._names = {config.id: config.name for config in fleet.vehicles}
        self._index = {config.id: index for index, config in enumerate(fleet.vehicles)}
        self._fleet = make_fleet(
            np.array([config.initial_position for config in fleet.vehicles]),
            ids=[config.id for config in fleet.vehicles],
            threads=min(os.cpu_count() or 1, len(fleet.vehicles) // _VEHICLES_PER_THREAD),
            downwash=options.downwash,
            vehicles=_models(fleet, options),
            pieces=SIMULATED_PIECES,
        )
        self._stored = [StoredTrajectories(config.name) for config in fleet.vehicles]
        self._streams: list[type | None] = [None] * len(fleet.vehicles)
        self._told = 0
        for index, config in enumerate(fleet.vehicles):
            for name, value in config.firmware_params.items():
                try:
                    self._fleet.set_param(index, name, value)
                except BackendError as error:
                    warn(f"{config.name}: firmware_params: {error}")
        self._start = clock.now() - _SETTLE_TICKS * DT
        self._run(_SETTLE_TICKS)
        self._unregister: Callable[[], None] | None = clock.on_advance(self._advance)

    @property
    def vehicles(self) -> Sequence[int]:
        return tuple(self._index)

    @property
    def contacts(self) -> Sequence[VehicleContact]:
        """Contacts between vehicles so far, in the clock's time; 0 for those before the script
        began."""
        return [
            replace(told, time=max(0.0, told.time + self._start)) for told in self._fleet.contacts
        ]

    def send(self, command: c.Command, vehicle: int | None = None) -> None:
        for index in range(len(self._fleet)) if vehicle is None else (self._at(vehicle),):
            self._deliver(command, index)

    def _deliver(self, command: c.Command, index: int) -> None:
        name = self._names[self._fleet.ids[index]]
        check(command, name)
        if not isinstance(command, _GROUND_COMMANDS) and (reason := self._lock(index)):
            warn(f"{name}: {verb(command)}: ignored; {reason}", stacklevel=5)
            return
        if isinstance(command, c.SetParam) and command.name not in self._fleet.param_names():
            warn(f"{name}: setParam: ignored; no parameter {command.name!r}", stacklevel=5)
            return
        if isinstance(command, c.StartTrajectory) and self._fleet.is_addressed(command, index):
            self._stored[index].require(command.trajectory_id)
        self._doubt(command, index, name)
        answer = self._fleet.send(command, index)
        if answer and isinstance(command, c.Arm):
            warn(f"{name}: arm: refused in the vehicle's present state", stacklevel=5)
        elif answer in _REFUSALS:
            warn(f"{name}: {verb(command)}: refused; {_REFUSALS[answer]}", stacklevel=5)
        elif isinstance(command, c.UploadTrajectory):
            self._stored[index].note(command)

    def _doubt(self, command: c.Command, index: int, name: str) -> None:
        """Warn of what the firmware silently takes otherwise than it reads."""
        kind = type(command)
        if isinstance(command, c.STREAMED):
            if (
                isinstance(command, (c.VelocityWorld, c.Hover))
                and self._streams[index] is not kind
                and self._fleet.get_param(index, "stabilizer.controller") == MELLINGER
            ):
                warn(f"{name}: {verb(command)}: {VELOCITY_WITH_MELLINGER}", stacklevel=6)
            self._streams[index] = kind
        elif isinstance(command, (c.NotifySetpointsStop, c.CutMotors, c.Emergency)):
            self._streams[index] = None
        elif (
            isinstance(command, _PLANNED)
            and self._streams[index] is not None
            and self._fleet.is_addressed(command, index)
        ):
            warn(f"{name}: {verb(command)}: {NOT_NOTIFIED}", stacklevel=6)

    def _lock(self, index: int) -> str | None:
        if self._fleet.rows(index).supervisor[SV_STOP]:
            return "the emergency stop locks the vehicle until it is rebooted"
        if self._fleet.supervisor_info(index) & INFO_LOCKED:
            return "the vehicle has locked itself, after a crash or silence of its setpoints"
        return None

    def send_external_poses(self, poses: Mapping[int, Pose]) -> None:
        """Deliver further poses, besides those of the room's motion-capture system."""
        self._fleet.external_poses({self._at(vehicle): pose for vehicle, pose in poses.items()})

    def arm_watchdog(self, vehicle: int) -> None:
        """Start, and from then on feed, the emergency-stop watchdog of a vehicle."""
        self._fleet.emergency_watchdog(self._at(vehicle))

    def telemetry(self, vehicle: int) -> Telemetry:
        """Health, and the true state: what Crazyswarm shows in simulation."""
        index = self._at(vehicle)
        state = self._fleet.true_state(index)
        now = state.timestamp + self._start
        return replace(
            self._fleet.telemetry(index),
            timestamp=now,
            link_quality=1.0,
            state=replace(state, timestamp=now),
        )

    def get_param(self, vehicle: int, name: str) -> float:
        index = self._at(vehicle)
        if name not in self._fleet.param_names():
            raise BackendError(f"{self._names[vehicle]}: no parameter {name!r}")
        return self._fleet.get_param(index, name)

    def param_names(self, vehicle: int) -> Sequence[str]:
        """Names of all parameters that :meth:`get_param` knows."""
        return self._fleet.param_names()

    def close(self) -> None:
        if self._unregister is not None:
            self._unregister()
            self._unregister = None
            self._fleet.close()

    def _at(self, vehicle: int) -> int:
        try:
            return self._index[vehicle]
        except (KeyError, TypeError):
            known = ", ".join(map(str, self._index))
            raise CommandError(f"no vehicle with id {vehicle!r}; the fleet has {known}") from None

    def _advance(self, now: float) -> None:
        self._run(round((now - self._start) / DT) - self._fleet.tick)

    def _run(self, ticks: int) -> None:
        fleet = self._fleet
        end = fleet.tick + ticks
        while fleet.tick < end:
            if fleet.tick % _POSE_TICKS == 0:
                fleet.external_truth()
            until_frame = _POSE_TICKS - fleet.tick % _POSE_TICKS
            fleet.advance(min(until_frame, end - fleet.tick))
        for told in fleet.contacts[self._told :]:
            warn(
                f"{self._names[told.first]} and {self._names[told.second]} touched "
                + _when(told.time + self._start)
                + f" ({told.speed:.1f} m/s)"
            )
        self._told = len(fleet.contacts)


def _when(time: float) -> str:
    if time < 0.0:
        return "before the script began: they stand too close in the vehicle list"
    return f"at {time:.2f} s"


class PyBulletFleet(ArenaFleet):
    """``arena`` vehicles whose bodies PyBullet moves; rotors and battery stay compiled."""

    def __init__(
        self,
        positions: np.ndarray,
        *,
        ids: Sequence[int],
        threads: int = 1,
        downwash: bool = False,
        vehicles: Sequence[Rows] | None = None,
        pieces: int = MEMORY_PIECES,
    ) -> None:
        from crazyarena.sim_backend.physics.pybullet_engine import PyBulletEngine

        super().__init__(positions, ids=ids, threads=threads, vehicles=vehicles, pieces=pieces)
        self._engine = PyBulletEngine(self.plants[:, :FULL_PLANT_SIZE], dt=DT, wakes=downwash)
        self._engine.reset(self.bodies[:, B_POS : B_POS + 3])

    def advance(self, ticks: int, traces: np.ndarray | None = None) -> None:
        """Let ``ticks`` milliseconds pass, one by one; no traces."""
        for _ in range(ticks):
            before = self.bodies[:, B_VEL : B_VEL + 3].copy()
            super().advance(1)
            # Rotors 1..4 are front right, back right, back left, front left; the engine counts
            # from the front left.
            self._engine.step(self.bodies[:, AB_FORCE : AB_FORCE + 4][:, ::-1])
            for body, moved, (vx, vy, vz) in zip(
                self.bodies, self._engine.bodies, before, strict=True
            ):
                for at, count in ((B_POS, 3), (B_VEL, 3), (B_QUAT, 4), (B_OMEGA, 3)):
                    body[at : at + count] = moved[at : at + count]
                note_acceleration(body, vx, vy, vz, DT)

    def close(self) -> None:
        super().close()
        self._engine.close()


def _models(fleet: FleetConfig, options: SimOptions) -> list[Rows]:
    """Rows of every vehicle; equal models are read once."""
    read: dict[str, Rows] = {}
    models = []
    for config in fleet.vehicles:
        name = options.vehicle or config.vehicle or DEFAULT_VEHICLE
        if name not in read:
            read[name] = vehicle_rows(load_vehicle(name, options.vehicle_set))
        models.append(read[name])
    return models


def open_arena(fleet: FleetConfig, clock: Clock, options: SimOptions) -> ArenaBackend:
    """Factory of backend ``sim``, named in the registry of backends."""
    return ArenaBackend(fleet, _virtual(clock, "sim"), options=options)


def open_pybullet(fleet: FleetConfig, clock: Clock, options: SimOptions) -> ArenaBackend:
    """Factory of backend ``pybullet``, named in the registry of backends."""
    return ArenaBackend(fleet, _virtual(clock, "pybullet"), PyBulletFleet, options)


def _virtual(clock: Clock, name: str) -> VirtualClock:
    if not isinstance(clock, VirtualClock):
        raise BackendError(f"backend {name!r}: a simulation needs a virtual clock")
    return clock
