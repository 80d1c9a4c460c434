"""A fleet of simulated Crazyflies with today's firmware (profile ``arena``).

:class:`ArenaFleet` is the vehicles themselves: they know nothing of radios or cameras. Whoever
owns it advances it, feeds it external poses and hands it commands at the moment they arrive.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.checks import check
from crazyarena.mocap.rotations import rotate
from crazyarena.sim_backend.arena_commands import execute
from crazyarena.sim_backend.arena_kernel import (
    CONTACT_PAUSE,
    DT,
    NOISE_COLUMNS,
    QUEUE_COLUMNS,
    QUEUE_LENGTH,
    V_SIZE,
    X_SIZE,
    Block,
    Encounters,
    Fleet,
    advance_fleet,
    advance_near,
    enqueue,
    show_truth,
)
from crazyarena.sim_backend.arena_params import (
    PARAM_INDEX,
    PARAMS,
    param_index,
    param_to_store,
    param_value,
)
from crazyarena.sim_backend.arena_rows import VehicleRows
from crazyarena.sim_backend.decks import DeckRack
from crazyarena.sim_backend.firmware import collision_avoidance, high_level, stack_2026
from crazyarena.sim_backend.firmware import commander as setpoints
from crazyarena.sim_backend.firmware import layout as la
from crazyarena.sim_backend.firmware import supervisor as sv
from crazyarena.sim_backend.firmware.kalman import MEAS_POSE, MEAS_POSITION
from crazyarena.sim_backend.firmware.planner import PIECE_BYTES, TRAJECTORY_MEMORY_SIZE
from crazyarena.sim_backend.firmware.power import FULL_SCALE
from crazyarena.sim_backend.physics import competition_step as cs
from crazyarena.sim_backend.physics import fleet as neighbours
from crazyarena.sim_backend.physics import geometry
from crazyarena.sim_backend.physics.arena_plant import (
    AB_ACCELERATION,
    AB_CHARGE,
    AB_CONTACT,
    AB_REST,
    AB_VOLTS,
    AP_CAPACITY,
    ARENA_BODY_SIZE,
    GRAVITY,
    open_circuit_volts,
)
from crazyarena.sim_backend.physics.scene import (
    MARGIN,
    ROW_SIZE,
    ground_code,
)
from crazyarena.sim_backend.physics.sizes import VEHICLE_HALF_LENGTH
from crazyarena.sim_backend.power_state import PowerStates
from crazyarena.sim_backend.trace import NO_CONTACT, TRACE_SIZE
from crazyarena.sim_backend.vehicles import Rows, default_rows
from crazyarena.types import Pose, Telemetry, VehicleContact, VehicleState

Array = NDArray[np.float64]

_REST_HEIGHT = VEHICLE_HALF_LENGTH + MARGIN  # m, of the centre above the ground
_DEG = 180.0 / math.pi
_BLOCK = 10  # ticks for which vehicles far from each other run on their own; < CONTACT_PAUSE


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """Standard deviations per 1 ms sample: gyro deg/s, accelerometer g (both per axis); force N
    is a random force on the vehicle."""

    gyro: float = 0.0
    accelerometer: float = 0.0
    force: float = 0.0


class ArenaFleet:
    """Vehicles standing on the ground, booted at time 0.

    Parameters
    ----------
    positions: (n, 3) m, world; z is the height of the centre, at least that of a vehicle at rest.
    yaws: (n,) rad.
    ids: 1..255, for collision avoidance; 1, 2, ... by default.
    vehicles: rows of one vehicle model for all or of one each, see :mod:`.vehicles`; the default
        vehicle if not given. Sensor noise has to be asked for with ``noise``.
    scene: gates and obstacles of :func:`.physics.scene.build_scene`.
    noise, rng: sensor noise and its generator; drawn per call of :meth:`advance`, one block of
        (n, ticks, 9) standard normals, and not at all without noise.
    auto_arm: False for a firmware that waits for an arming request.
    threads: vehicles are spread over so many threads.
    downwash: True lets vehicles push down on those below them.

    Attributes
    ----------
    contacts: list of :class:`~crazyarena.types.VehicleContact`, the contacts between vehicles
        so far, each at its beginning; touching again within 0.1 s is the same contact.
    decks: positioning decks on the vehicles, none at first.
    """

    def __init__(
        self,
        positions: ArrayLike,
        yaws: ArrayLike | None = None,
        *,
        ids: Sequence[int] | None = None,
        vehicles: Sequence[Rows] | Rows | None = None,
        scene: Array | None = None,
        noise: SensorNoise | None = None,
        rng: np.random.Generator | None = None,
        auto_arm: bool = True,
        threads: int = 1,
        downwash: bool = False,
        pieces: int = TRAJECTORY_MEMORY_SIZE // PIECE_BYTES,
    ) -> None:
        places = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
        n = len(places)
        headings = np.zeros(n) if yaws is None else np.asarray(yaws, dtype=np.float64)
        self.ids = tuple(range(1, n + 1) if ids is None else ids)
        self.tick = 0
        self._noise = noise or SensorNoise()
        self._rng = rng
        if self._noise != SensorNoise() and rng is None:
            raise ValueError("sensor noise needs a generator: pass rng")
        self._auto_arm = auto_arm
        self.bodies = np.zeros((n, ARENA_BODY_SIZE))
        if vehicles is None:
            vehicles = default_rows()
        self.models = [vehicles] * n if isinstance(vehicles, Rows) else list(vehicles)
        if len(self.models) != n:
            raise ValueError(f"{len(self.models)} vehicle models for {n} vehicles")
        self.plants = np.array([model.plant for model in self.models]).reshape(n, -1)
        self.power = PowerStates(n)
        self.memory = np.zeros((n, stack_2026.FIRMWARE_SIZE))
        self.params = np.zeros((n, len(PARAMS)))
        self.trajectories = np.zeros(
            (n, max(TRAJECTORY_MEMORY_SIZE, pieces * PIECE_BYTES)), dtype=np.uint8
        )
        self._peer_tables = np.zeros(
            (n, collision_avoidance.MAX_PEERS, collision_avoidance.PEER_SIZE)
        )
        self._queues = np.zeros((n, QUEUE_LENGTH + 1, QUEUE_COLUMNS))
        self._work = np.array([geometry.make_workspace() for _ in range(n)])
        self._no_noise = np.zeros((n, 0, NOISE_COLUMNS))
        self._no_trace = np.zeros((n, 0, TRACE_SIZE))
        self._id_row = np.array(self.ids, dtype=np.float64)
        self._heard: list[frozenset[int] | None] = [None] * n
        self._hears = np.ones((n, n), dtype=np.uint8)
        self.contacts: list[VehicleContact] = []
        self._wakes = downwash
        self.decks = DeckRack()
        self._near = np.zeros(n, dtype=np.uint8)
        self._members = np.zeros(n, dtype=np.int64)
        self._meetings = np.zeros((n * (n - 1) // 2, V_SIZE))
        self._encounters = tuple(
            Encounters(
                touched=np.full((n, n), -CONTACT_PAUSE - 1, dtype=np.int64),
                meetings=self._meetings,
                scratch=np.zeros((n, X_SIZE)),
                work=geometry.make_workspace(),
            )
        )
        self._rows = tuple(
            Fleet(
                bodies=self.bodies,
                plants=self.plants,
                memories=self.memory,
                params=self.params,
                trajectories=self.trajectories,
                peer_tables=self._peer_tables,
                peers=np.zeros((n, collision_avoidance.MAX_PEERS, 3)),
                faces=np.array([collision_avoidance.new_scratch() for _ in range(n)]),
                queues=self._queues,
                works=self._work,
            )
        )
        self.set_scene(np.zeros((0, ROW_SIZE)) if scene is None else scene)
        for i in range(n):
            self.place(i, places[i], float(headings[i]))
            self.reboot(i)
        self._threads = max(1, min(threads, n))
        self._pool = ThreadPoolExecutor(self._threads) if self._threads > 1 else None

    def __len__(self) -> int:
        return len(self.bodies)

    @property
    def time(self) -> float:
        """Seconds since the fleet was made."""
        return self.tick * DT

    def close(self) -> None:
        """Stop the threads; idempotent."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    # The world

    def set_scene(self, scene: Array) -> None:
        """Change gates and obstacles; vehicles stay where they are."""
        self._scene = np.ascontiguousarray(scene, dtype=np.float64)
        self._ground = ground_code(self._scene)
        for work in self._work:
            geometry.forget(work)
        self.bodies[:, AB_REST] = 0.0  # what it lay on may be gone

    def move_scene(self, scene: Array) -> None:
        """As :meth:`set_scene`, for objects that moved a little; wakes nobody who lies still."""
        self._scene[:] = scene
        self._work[:, geometry.W_CACHE, 3] = -1.0  # the clearance found last

    def place(self, vehicle: int, position: ArrayLike, yaw: float = 0.0) -> None:
        """Put a vehicle somewhere, level, at rest and with a fresh battery."""
        x, y, z = (float(value) for value in np.asarray(position, dtype=np.float64))
        body = self.bodies[vehicle]
        body[:] = 0.0
        cs.set_pose(body, x, y, max(z, _REST_HEIGHT), 0.0, 0.0, yaw)
        body[AB_ACCELERATION + 2] = GRAVITY
        drawn = self.models[vehicle].drawn
        body[AB_CHARGE] = drawn * self.plants[vehicle, AP_CAPACITY]
        body[AB_VOLTS] = open_circuit_volts(self.plants[vehicle], drawn)
        body[AB_CONTACT] = NO_CONTACT
        geometry.forget(self._work[vehicle])

    def reboot(self, vehicle: int) -> None:
        """Restart a vehicle's firmware: parameters at their defaults, time 0."""
        self.memory[vehicle] = stack_2026.firmware_memory(
            self.models[vehicle].platform, self._auto_arm
        )
        self.params[vehicle] = self.models[vehicle].params
        self.trajectories[vehicle] = 0
        self._queues[vehicle] = 0.0
        self.listen(vehicle, None)

    def advance(self, ticks: int, traces: Array | None = None) -> None:
        """Let ``ticks`` milliseconds pass.

        ``traces`` (n, >= ticks, TRACE_SIZE) is filled with one row per vehicle and tick.
        """
        done = 0
        while done < ticks:
            for vehicle, deck in self.decks.due(self.tick):
                velocity = self.bodies[vehicle, cs.B_VEL : cs.B_VEL + 3]
                self._enqueue(vehicle, *deck.sense(self.true_pose(vehicle), velocity), 0.0)
            span = self.decks.span(self.tick, ticks - done)
            self._advance(span, None if traces is None else traces[:, done:])
            done += span

    def _advance(self, ticks: int, traces: Array | None) -> None:
        n = len(self)
        noise = self._no_noise
        if self._rng is not None and self._noise != SensorNoise():
            scale = np.repeat((self._noise.gyro, self._noise.accelerometer, self._noise.force), 3)
            noise = self._rng.standard_normal((n, ticks, NOISE_COLUMNS)) * scale
        rows = self._no_trace if traces is None else traces
        # Nobody is near a single vehicle, however long the call.
        longest = _BLOCK if n > 1 else ticks
        for begin in range(0, ticks, max(longest, 1)):
            self._advance_block(
                tuple(Block(begin, min(begin + longest, ticks), self.tick, noise, rows))
            )
        self.tick += ticks
        self.power.note(self.tick, self.bodies[:, AB_VOLTS])

    def _advance_block(self, block: tuple[Any, ...]) -> None:
        n = len(self)
        count = 0
        if n > 1:
            begin, end, *_ = block
            span = (end - begin + 1) * DT
            count = neighbours.find_near(self.bodies, span, self._wakes, self._near, self._members)
        world: tuple[Any, ...] = (self._rows, block, self._scene, self._ground)
        pending: list[Future[None]] = []
        if count == n:
            pass
        elif self._pool is None:
            advance_fleet(0, n, self._near, *world)
        else:
            edges = [n * k // self._threads for k in range(self._threads + 1)]
            pending = [
                self._pool.submit(advance_fleet, first, last, self._near, *world)
                for first, last in pairwise(edges)
            ]
        if count:
            met = advance_near(self._members, count, self._wakes, *world, self._encounters)
            for tick, first, second, speed in self._meetings[:met].tolist():
                ids = self.ids[int(first)], self.ids[int(second)]
                self.contacts.append(VehicleContact(tick * DT, ids[0], ids[1], max(speed, 0.0)))
        for job in pending:
            job.result()

    # What a vehicle receives

    def rows(self, vehicle: int) -> VehicleRows:
        """Views of one vehicle's memory; they stay valid."""
        return VehicleRows(
            self.bodies[vehicle],
            self.plants[vehicle],
            self.memory[vehicle],
            self.params[vehicle],
            self.trajectories[vehicle],
        )

    def external_pose(self, vehicle: int, pose: Pose, latency: float = 0.0) -> bool:
        """Send a measured pose that arrives ``latency`` s from now; False if it was lost because
        too many are on their way."""
        row = np.empty(7)
        row[:3] = pose.position
        row[3:] = pose.quaternion
        return self._enqueue(vehicle, MEAS_POSE, row, latency)

    def external_position(self, vehicle: int, position: ArrayLike, latency: float = 0.0) -> bool:
        """Send a measured position (3,) m, as :meth:`external_pose`."""
        row = np.zeros(7)
        row[:3] = position
        return self._enqueue(vehicle, MEAS_POSITION, row, latency)

    def _enqueue(self, vehicle: int, kind: int, row: Array, latency: float) -> bool:
        arrival = self.memory[vehicle, stack_2026.F_TICK] + round(latency / DT)
        return bool(enqueue(self._queues[vehicle], arrival, kind, row))

    def external_poses(self, poses: Mapping[int, Pose], latency: float = 0.0) -> None:
        """Broadcast poses by vehicle index: each vehicle takes its own for its estimator, those
        that avoid collisions also note the positions of the others."""
        for vehicle, pose in poses.items():
            self.external_pose(vehicle, pose, latency)
        for avoiding in np.flatnonzero(self.params[:, PARAM_INDEX["colAv.enable"]]):
            for peer, pose in poses.items():
                if peer != avoiding:
                    self.peer_position(int(avoiding), self.ids[peer], pose.position)

    def external_truth(self) -> None:
        """Broadcast everybody's true pose: :meth:`external_poses` of a perfect camera system."""
        show_truth(
            self.bodies,
            self.memory,
            self._queues,
            self._peer_tables,
            self.params[:, PARAM_INDEX["colAv.enable"]],
            self._hears,
            self._id_row,
        )

    def peer_position(self, vehicle: int, peer_id: int, position: ArrayLike) -> None:
        """Let a vehicle hear of a peer's position (3,) m."""
        heard = self._heard[vehicle]
        if heard is not None and peer_id not in heard:
            return
        x, y, z = (float(value) for value in np.asarray(position, dtype=np.float64))
        collision_avoidance.note_peer(
            self._peer_tables[vehicle], peer_id, x, y, z, self.memory[vehicle, stack_2026.F_TICK]
        )

    def listen(self, vehicle: int, peers: frozenset[int] | None) -> None:
        """Forget the peers heard of; from now on hear of ``peers`` only (None: of everybody)."""
        self._peer_tables[vehicle] = 0.0
        self._heard[vehicle] = peers
        self._hears[vehicle] = [peers is None or ident in peers for ident in self.ids]

    def setpoint(self, vehicle: int, row: Array, priority: int = setpoints.PRIORITY_CRTP) -> None:
        """Hand over a low-level setpoint row (see :mod:`.firmware.layout`)."""
        stack_2026.offer_setpoint(self.memory[vehicle], row, priority)

    def send(self, command: c.Command, vehicle: int) -> int:
        """Deliver a command to one vehicle now.

        Returns
        -------
        What a vehicle answers: 0, or an error number (high-level commands: 1 ignored, 8 not
        executable, 16 not allowed to fly; arming: 1 refused).

        Raises
        ------
        CommandError
            if no vehicle could execute it.
        """
        check(command, f"vehicle {self.ids[vehicle]}")
        if not self.is_addressed(command, vehicle):
            return 0
        return execute(self, vehicle, command)

    def is_addressed(self, command: c.Command, vehicle: int) -> bool:
        """False if the command is for a group that the vehicle does not belong to."""
        mask = getattr(command, "group_mask", 0)
        return isinstance(command, c.SetGroupMask) or bool(
            high_level.in_group(self.rows(vehicle).high_level_params, int(mask))
        )

    def emergency_watchdog(self, vehicle: int) -> None:
        """Feed the emergency-stop watchdog, which is active from its first feeding on."""
        sv.supervisor_feed_watchdog(
            self.rows(vehicle).supervisor, self.memory[vehicle, stack_2026.F_TICK]
        )

    def recover(self, vehicle: int) -> bool:
        """Ask for recovery from a crash; True when not crashed afterwards."""
        return bool(sv.supervisor_request_recovery(self.rows(vehicle).supervisor))

    def get_param(self, vehicle: int, name: str) -> float:
        """Value of ``group.name``; raises BackendError if the vehicle has no such parameter."""
        if (fitted := self.decks.fitted(vehicle, name)) is not None:
            return fitted
        index = param_index(name, self.ids[vehicle])
        return param_value(index, float(self.params[vehicle, index]))

    def set_param(self, vehicle: int, name: str, value: float) -> None:
        """Set ``group.name``, at once in effect; raises BackendError if there is none, and
        CommandError for a value beyond its type."""
        index = param_index(name, self.ids[vehicle])
        self.params[vehicle, index] = param_to_store(index, value, self.ids[vehicle])

    @staticmethod
    def param_names() -> tuple[str, ...]:
        """Every parameter a vehicle has."""
        return tuple(PARAM_INDEX)

    # What a vehicle tells

    def telemetry(self, vehicle: int) -> Telemetry:
        """Battery, supervisor and estimate; the radio's share of it is the link's business."""
        rows = self.rows(vehicle)
        state = rows.state
        position_std, velocity_std = rows.stds
        return Telemetry(
            timestamp=self.time,
            battery=float(rows.body[AB_VOLTS]),
            supervisor=int(rows.supervisor[sv.SV_INFO]),
            power_state=self.power.state(vehicle, self.tick),
            position_std=position_std,
            velocity_std=velocity_std,
            state=VehicleState(
                timestamp=self.time,
                position=state[la.ST_POS : la.ST_POS + 3].copy(),
                velocity=state[la.ST_VEL : la.ST_VEL + 3].copy(),
                quaternion=state[la.ST_QUAT : la.ST_QUAT + 4].copy(),
                angular_velocity=state[la.ST_GYRO : la.ST_GYRO + 3] / _DEG,
            ),
            motors=rows.motors / FULL_SCALE,
            acceleration=state[la.ST_GYRO + 3 : la.ST_GYRO + 6].copy(),
        )

    def true_state(self, vehicle: int) -> VehicleState:
        """Where the vehicle really is."""
        body = self.bodies[vehicle]
        return VehicleState(
            timestamp=self.time,
            position=body[cs.B_POS : cs.B_POS + 3].copy(),
            velocity=body[cs.B_VEL : cs.B_VEL + 3].copy(),
            quaternion=body[cs.B_QUAT : cs.B_QUAT + 4].copy(),
            angular_velocity=body[cs.B_OMEGA : cs.B_OMEGA + 3].copy(),
        )

    def true_pose(self, vehicle: int) -> Pose:
        """Position and attitude of :meth:`true_state`."""
        body = self.bodies[vehicle]
        return Pose(body[cs.B_POS : cs.B_POS + 3].copy(), body[cs.B_QUAT : cs.B_QUAT + 4].copy())

    def tracked_pose(self, vehicle: int) -> Pose:
        """Where a perfect camera system has the body that it follows: its origin may lie off the
        centre of mass, see ``markers`` of a vehicle model."""
        pose, offset = self.true_pose(vehicle), self.models[vehicle].offset
        if not offset.any():
            return pose
        return Pose(pose.position + rotate(pose.quaternion, offset), pose.quaternion)

    def fit(self, vehicle: int, model: Rows) -> None:
        """Make a vehicle one of another model; :meth:`place` and :meth:`reboot` it then."""
        self.models[vehicle] = model
        self.plants[vehicle] = model.plant

    def supervisor_info(self, vehicle: int) -> int:
        """Bit field of ``supervisor.info``."""
        return int(self.rows(vehicle).supervisor[sv.SV_INFO])
