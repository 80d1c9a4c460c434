"""An arena in virtual time: one ``arena`` vehicle, its radio link and the cameras around it.

What stands behind the three interfaces of a trial in a dry run: the clock is an
:class:`~crazyarena.clock.VirtualClock`, the vehicle link is :class:`SimulatedLink`, the pose
source is the simulated camera system. Everything that flies a trial lies on this side of those
interfaces.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from crazyarena.clock import VirtualClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.checks import check
from crazyarena.crazyswarm_compat.positioning import positioning
from crazyarena.errors import CommandError, InputError
from crazyarena.levels.draw import Draw
from crazyarena.levels.schema import GateMotion, Level
from crazyarena.levels.schema import Vehicle as NominalVehicle
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.mocap.onboard import Certainty
from crazyarena.mocap.sim_source import SimSource
from crazyarena.sim_backend.arena import ArenaFleet, SensorNoise
from crazyarena.sim_backend.arena_kernel import DT
from crazyarena.sim_backend.crtp.setpoints import compress_quaternion, decompress_quaternion
from crazyarena.sim_backend.decks import make_deck
from crazyarena.sim_backend.physics.competition_step import PLANT_SIZE
from crazyarena.sim_backend.physics.scene import build_scene, fill_scene
from crazyarena.sim_backend.vehicles import (
    Rows,
    VehicleSupply,
    load_vehicle,
    vehicle_rows,
)
from crazyarena.types import Pose, Telemetry, VehicleState

Array = NDArray[np.float64]

_STREAMED = (
    c.FullState, c.Position, c.VelocityWorld, c.Hover, c.Attitude, c.CutMotors,
    c.RollPitchYawThrust,
)  # fmt: skip
_RETRY = 0.01  # s, until a lost request is sent again
ESTIMATE_RATE = 100.0  # Hz, of a vehicle's own estimate by log data
_SWITCHED_ON = 0.04  # s, period of the firmware's slowest part, the supervisor


@dataclass(frozen=True, slots=True)
class LinkModel:
    """Radio link of a simulated vehicle.

    latency: one way, s; jitter: mean of what comes on top (exponential), s; loss: share of
    packets lost. Streamed setpoints and poses that are lost stay lost; anything else is
    repeated until it gets through. Nothing overtakes.
    """

    latency: float = 0.003
    jitter: float = 0.0005
    loss: float = 0.0

    def __post_init__(self) -> None:
        for name in ("latency", "jitter"):
            value = getattr(self, name)
            if not (0.0 <= value <= 1.0):
                raise InputError(f"link {name}: found {value}; need 0 to 1 s")
        if not 0.0 <= self.loss < 1.0:
            raise InputError(f"link loss: found {self.loss}; need a share from 0 to below 1")


class SimulatedLink:
    """:class:`~crazyarena.crazyswarm_compat.backend.Backend` over a fleet in virtual time."""

    def __init__(
        self, fleet: ArenaFleet, clock: VirtualClock, model: LinkModel, rng: np.random.Generator
    ) -> None:
        self._fleet = fleet
        self._clock = clock
        self._model = model
        self._rng = rng
        self._index = {ident: i for i, ident in enumerate(fleet.ids)}
        self._queue: list[tuple[float, int, int, c.Command]] = []
        self._order = itertools.count()
        self._last = [0.0] * len(fleet)
        self.refused = 0

    @property
    def vehicles(self) -> Sequence[int]:
        return tuple(self._index)

    def send(self, command: c.Command, vehicle: int | None = None) -> None:
        for index in self._chosen(vehicle):
            check(command, f"vehicle {self._fleet.ids[index]}")
            delay = self._delay(isinstance(command, _STREAMED))
            if delay is None:
                continue
            arrival = max(self._clock.now() + delay, self._last[index])
            self._last[index] = arrival
            heapq.heappush(self._queue, (arrival, next(self._order), index, command))

    def send_external_poses(self, poses: Mapping[int, Pose]) -> None:
        for vehicle, pose in poses.items():
            delay = self._delay(streamed=True)
            if delay is not None:
                self._fleet.external_pose(self._chosen(vehicle)[0], pose, delay)

    def telemetry(self, vehicle: int) -> Telemetry:
        told = self._fleet.telemetry(self._chosen(vehicle)[0])
        now = self._clock.now()
        state = None if told.state is None else replace(told.state, timestamp=now)
        return replace(told, timestamp=now, link_quality=1.0 - self._model.loss, state=state)

    def get_param(self, vehicle: int, name: str) -> float:
        return self._fleet.get_param(self._chosen(vehicle)[0], name)

    def feed_watchdog(self, vehicle: int) -> None:
        """Feed the vehicle's emergency-stop watchdog."""
        self._fleet.emergency_watchdog(self._chosen(vehicle)[0])

    def close(self) -> None:
        self._queue.clear()

    @property
    def next_event(self) -> float:
        """When the next command arrives, s; inf when none is on its way."""
        return self._queue[0][0] if self._queue else math.inf

    def deliver(self, now: float) -> None:
        """Hand over what has arrived."""
        while self._queue and self._queue[0][0] <= now:
            _, _, index, command = heapq.heappop(self._queue)
            if self._fleet.send(command, index):
                self.refused += 1

    def reset(self) -> None:
        """Forget what is on its way: the vehicle was switched off."""
        self._queue.clear()
        self._last = [0.0] * len(self._fleet)

    def _delay(self, streamed: bool) -> float | None:
        model = self._model
        delay = model.latency
        if model.jitter:
            delay += float(self._rng.exponential(model.jitter))
        if model.loss:
            while self._rng.random() < model.loss:
                if streamed:
                    return None
                delay += _RETRY
        return delay

    def _chosen(self, vehicle: int | None) -> Sequence[int]:
        if vehicle is None:
            return range(len(self._fleet))
        try:
            return (self._index[vehicle],)
        except KeyError:
            known = ", ".join(map(str, self._index))
            raise CommandError(f"vehicle {vehicle}: unknown; this link has {known}") from None


def track_truth(gates: Array, obstacles: Array) -> dict[str, Pose]:
    """Poses of the bodies ``gate1``, ... and ``obstacle1``, ...; the origin is at the foot.

    gates: (n, >= 6), obstacles: (m, 6): x, y, z, roll, pitch, yaw of the foot.
    """
    bodies = {f"gate{i + 1}": _pose(row) for i, row in enumerate(gates)}
    return bodies | {f"obstacle{i + 1}": _pose(row) for i, row in enumerate(obstacles)}


def feet(draw: Draw) -> Array:
    """Gates (n, 7) of a draw with the z of the foot instead of the opening's centre."""
    rows = draw.gates.copy()
    rows[:, 2] = draw.nominal_gates[:, 2]
    return rows


def _pose(row: Array) -> Pose:
    sr, sp, sy = (math.sin(0.5 * float(angle)) for angle in row[3:6])
    cr, cp, cy = (math.cos(0.5 * float(angle)) for angle in row[3:6])
    quaternion = np.array(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ]
    )
    return Pose(np.array(row[:3], dtype=np.float64), quaternion)


class AnyTrack(Protocol):
    """What an arena is told of a track."""

    @property
    def moves(self) -> bool: ...

    def scene(self, time: float) -> Array:
        """Rows for the collision geometry; they may be used again by the next call."""
        ...

    def bodies(self, time: float) -> dict[str, Pose]:
        """True poses by the names of the bodies."""
        ...


class Track:
    """Gates and obstacles of a draw, some of the gates perhaps on the move.

    motions: of each gate (:func:`motions`); times are in s since the track was built.
    """

    def __init__(self, draw: Draw, motions: Sequence[GateMotion | None] = ()) -> None:
        self._draw = draw
        self._motions = [(i, motion) for i, motion in enumerate(motions) if motion is not None]
        self._bodies = track_truth(feet(draw), draw.obstacles)
        self._scene = build_scene(draw.gates, draw.obstacles)

    @property
    def moves(self) -> bool:
        return bool(self._motions)

    def gates(self, time: float) -> Array:
        """(n, 7) as :attr:`Draw.gates`."""
        rows = self._draw.gates.copy()
        for i, motion in self._motions:
            rows[i, [0, 1, 5]] += motion.offset(time)
        return rows

    def scene(self, time: float) -> Array:
        """Rows for the collision geometry; they are used again by the next call."""
        fill_scene(self.gates(time), self._draw.obstacles, self._scene)
        return self._scene

    def bodies(self, time: float) -> dict[str, Pose]:
        """True poses by the names of the bodies."""
        if self._motions:
            gates = self.gates(time)
            gates[:, 2] = self._draw.nominal_gates[:, 2]
            for i, _ in self._motions:
                self._bodies[f"gate{i + 1}"] = _pose(gates[i])
        return self._bodies


def sensor_noise(rows: Rows) -> SensorNoise:
    """Noise of a vehicle's inertial sensors."""
    gyro, accelerometer = rows.noise
    return SensorNoise(gyro=gyro, accelerometer=accelerometer)


def estimates_by_log(link: LinkModel) -> CameraModel:
    """What becomes of log data on a link, as if a camera system had sent them."""
    return CameraModel(
        rate=ESTIMATE_RATE,
        latency=link.latency,
        latency_jitter=link.jitter,
        position_noise=0.0,
        attitude_noise=0.0,
        dropout=0.0,
        frame_loss=link.loss,
    )


def as_logged(state: VehicleState) -> Pose:
    """A pose as ``stateEstimateZ`` carries it: whole millimetres, a quaternion of 32 bits."""
    position = np.trunc(1e3 * state.position) * 1e-3
    return Pose(position, decompress_quaternion(compress_quaternion(state.quaternion.tolist())))


def motions(level: Level) -> tuple[GateMotion | None, ...]:
    """How the gates of a level move."""
    return tuple(gate.motion for gate in level.track.gates)


class SimulatedArena:
    """The vehicle, its track and the cameras; whoever moves :attr:`clock` lets time pass.

    Parameters
    ----------
    rng: everything random in here is drawn from its children, in the order link, cameras,
        sensors, moment at which the vehicle is switched on.
    vehicle: id of the vehicle; its body is called ``cf<id>``.
    motions: of the gates, where they move.
    supply: the vehicles that fly, one a :meth:`stage`; the default vehicle if not given.
    track: builds the track of a draw; gates and obstacles of 2022 by default, with ``motions``.
    params: firmware parameters by name, written whenever the vehicle was switched on.
    nominal: what a draw's mass (kg) and inertia (kg m2) are offsets from: the numbers of the
        level that is drawn from.
    noise: instead of the vehicle's own.
    deck: a positioning deck (:mod:`.decks`) instead of the cameras: :attr:`source` then has the
        vehicle's own estimate, as it would come by log data; what has no radio is not seen.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        *,
        vehicle: int = 1,
        cameras: CameraModel | None = None,
        link: LinkModel | None = None,
        noise: SensorNoise | None = None,
        motions: Sequence[GateMotion | None] = (),
        supply: VehicleSupply | None = None,
        nominal: NominalVehicle | None = None,
        deck: str | None = None,
        track: Callable[[Draw], AnyTrack] | None = None,
        params: Mapping[str, float] | None = None,
    ) -> None:
        for_link, for_cameras, for_sensors, self._for_moments = rng.spawn(4)
        self.clock = VirtualClock()
        self.vehicle = vehicle
        self.body = f"cf{vehicle}"
        self._supply = supply or VehicleSupply(load_vehicle())
        first = vehicle_rows(self._supply.vehicle)
        self.fleet = ArenaFleet(
            np.zeros((1, 3)),
            ids=(vehicle,),
            vehicles=first,
            noise=noise or sensor_noise(first),
            rng=for_sensors,
        )
        nominal = nominal or NominalVehicle()
        self._nominal = np.array((nominal.mass, nominal.ixx, nominal.iyy, nominal.izz))
        link = link or LinkModel()
        self.link = SimulatedLink(self.fleet, self.clock, link, for_link)
        self._certainty: Certainty | None = None
        if deck is not None:
            (for_deck,) = rng.spawn(1)
            self.fleet.decks.fit(0, make_deck(deck, for_deck))
            relative = positioning(lambda name: self.fleet.get_param(0, name)).relative
            self._certainty = Certainty(relative)
            cameras = estimates_by_log(link)
        self.source = SimSource(self.clock, None, cameras, for_cameras)
        self._build = track or (lambda draw: Track(draw, motions))
        self._params = dict(params or {})
        self._track: AnyTrack | None = None
        self._staged = 0.0
        self._start = -self.fleet.time
        self.clock.stop_at(lambda: self.source.next_event)
        self.clock.stop_at(lambda: self.link.next_event)
        self.clock.on_advance(self._advance)

    def stage(self, draw: Draw) -> None:
        """Build the track and put the freshly switched-on vehicle at its start, as people do."""
        x, _, y, _, _, _, _, _, yaw, _, _, _ = draw.start
        # Vehicle, cameras and trial keep time each for itself: nobody makes them start in step,
        # and a frame that just misses a control tick is a whole period old at the next.
        self.clock.sleep_until(self.clock.now() + self._for_moments.uniform(0.0, _SWITCHED_ON))
        self._track = self._build(draw)
        self._staged = self.fleet.time
        self.fleet.set_scene(self._track.scene(0.0))
        model = vehicle_rows(self._supply.next())
        model.plant[:PLANT_SIZE] += np.array((draw.mass, *draw.inertia)) - self._nominal
        self.fleet.fit(0, model)
        self.fleet.place(0, (x, y, 0.0), float(yaw))
        self.fleet.reboot(0)
        for name, value in self._params.items():
            self.fleet.set_param(0, name, value)
        self.link.reset()

    def _advance(self, now: float) -> None:
        fleet, track = self.fleet, self._track
        ticks = round((now - self._start) / DT) - fleet.tick
        if ticks > 0:
            if track is not None and track.moves:
                # Time never runs further than to the next exposure: gates move in small steps.
                fleet.move_scene(track.scene(fleet.time + ticks * DT - self._staged))
            fleet.advance(ticks)
        self.link.deliver(now)
        while self.source.next_exposure <= now:
            self.source.expose(self.source.next_exposure, self._seen(track))

    def _seen(self, track: AnyTrack | None) -> dict[str, Pose]:
        fleet = self.fleet
        if self._certainty is not None:
            told = fleet.telemetry(0)
            assert told.state is not None
            if self._certainty.doubt(told) is not None:
                return {}
            return {self.body: as_logged(told.state)}
        truth = {self.body: fleet.tracked_pose(0)}
        if track is not None:
            truth |= track.bodies(fleet.time - self._staged)
        return truth

    def track_poses(self) -> dict[str, Pose]:
        """True poses of gates and obstacles, as :func:`track_truth`; none before a stage."""
        track = self._track
        return {} if track is None else dict(track.bodies(self.fleet.time - self._staged))

    def close(self) -> None:
        self.link.close()
        self.source.close()
        self.fleet.close()
