"""Vehicles that track perfectly, behind the same interface as a radio.

What ``--sim`` flies. It behaves like Crazyswarm 1's simulator, with its slips mended: a landed
vehicle stays where it is and may take off again, a stopped one stands still, yaw rates turn the
vehicle, parameters and the emergency stop work, and a stretched trajectory is held where it
ended.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from crazyarena.clock import Clock, VirtualClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.checks import check, verb
from crazyarena.crazyswarm_compat.config import FleetConfig, VehicleConfig
from crazyarena.crazyswarm_compat.registry import IdealState, SimOptions
from crazyarena.errors import BackendError, CommandError
from crazyarena.sim_backend.bindings import planner
from crazyarena.sim_backend.firmware import collision_avoidance, high_level
from crazyarena.sim_backend.firmware.layout import SETPOINT_SIZE
from crazyarena.sim_backend.firmware.parameters import Param
from crazyarena.sim_backend.firmware.planner import (
    IDLE,
    LANDING,
    PIECE_BYTES,
    PL_STATE,
    PLANNER_SIZE,
    TRAJECTORY_MEMORY_SIZE,
)
from crazyarena.sim_backend.physics.ideal import (
    MO_ACC,
    MO_OMEGA,
    MO_POS,
    MO_VEL,
    MO_YAW,
    MODE_FULL_STATE,
    MODE_HIGH_LEVEL,
    MODE_HOVER,
    MODE_IDLE,
    MODE_POSITION,
    MODE_VELOCITY,
    MOTION_SIZE,
    Avoidance,
    Motion,
    advance_fleet,
    freeze,
    plan_go_to,
    plan_trajectory,
    plan_vertical,
)
from crazyarena.sim_backend.stored_trajectories import StoredTrajectories
from crazyarena.types import Pose, Telemetry, Vector, VehicleState

# Beside those of the firmware modules in use, parameters that scripts like to set.
_OTHER_PARAMS = (
    Param("commander.enHighLevel", 1, 1, "uint8"),
    Param("kalman.resetEstimation", 0, 0, "uint8"),
    Param("led.bitmask", 0, 0, "uint8"),
    Param("locSrv.extPosStdDev", 1e-3, 1e-3),
    Param("locSrv.extQuatStdDev", 4.5e-3, 4.5e-3),
    Param("ring.effect", 6, 6, "uint8"),
    Param("ring.headlightEnable", 0, 0, "uint8"),
    Param("ring.solidRed", 20, 20, "uint8"),
    Param("ring.solidGreen", 20, 20, "uint8"),
    Param("ring.solidBlue", 20, 20, "uint8"),
    Param("stabilizer.controller", 1, 1, "uint8"),
    Param("stabilizer.estimator", 2, 2, "uint8"),
)


def _default(param: Param) -> float:
    value = param.default_2026 or 0
    return float(value) if param.ctype == "float" else int(value)


_DEFAULTS: dict[str, float] = {
    param.name: _default(param)
    for param in (*collision_avoidance.PARAMS, *high_level.PARAMS, *_OTHER_PARAMS)
}
_GROUP_MASK = "hlCommander.groupmask"

# Bits of the firmware's supervisor.info.
_READY = 1 | 2 | 4 | 8  # can be armed, armed, arms by itself, can fly
_FLYING = 16
_LOCKED = 64
_FULL_BATTERY = 4.2  # V


class IdealBackend:
    """A fleet with perfect tracking; advances with its virtual clock.

    Noise is drawn from NumPy's global generator, three normals per flying vehicle and tick in
    the order of the fleet (also without noise), because scripts seed that generator.
    """

    def __init__(
        self, fleet: FleetConfig, clock: VirtualClock, options: SimOptions | None = None
    ) -> None:
        self._clock = clock
        self._options = options or SimOptions()
        self._configs: tuple[VehicleConfig, ...] = fleet.vehicles
        self._ids = [config.id for config in fleet.vehicles]
        self._index = {number: index for index, number in enumerate(self._ids)}
        n = len(self._ids)
        self._modes = np.full(n, MODE_IDLE, dtype=np.int64)
        self._planner = np.zeros((n, PLANNER_SIZE))
        self._memory = np.zeros((n, TRAJECTORY_MEMORY_SIZE), dtype=np.uint8)
        self._state = np.zeros((n, MOTION_SIZE))
        self._stream = np.zeros((n, MOTION_SIZE))
        self._setpoint = np.zeros((n, MOTION_SIZE))
        self._avoidance = np.zeros((n, len(collision_avoidance.PARAMS)))
        self._last_feasible = np.tile(collision_avoidance.new_memory(), (n, 1))
        self._peers = ~np.eye(n, dtype=np.bool_)
        self._motion = tuple(
            Motion(
                modes=self._modes,
                planner=self._planner,
                memory=self._memory,
                state=self._state,
                stream=self._stream,
                setpoint=self._setpoint,
            )
        )
        self._avoiding = tuple(
            Avoidance(
                params=self._avoidance,
                last_feasible=self._last_feasible,
                peers=self._peers,
                positions=np.zeros((n, 3)),
                work=(
                    np.zeros((n, 3)),
                    collision_avoidance.new_scratch(n),
                    np.zeros(SETPOINT_SIZE),
                ),
            )
        )
        self._trajectories: list[dict[int, np.ndarray]] = [{} for _ in range(n)]
        self._stored = [StoredTrajectories(config.name) for config in self._configs]
        self._params = [dict(_DEFAULTS) for _ in fleet.vehicles]
        self._locked = [False] * n
        for index, config in enumerate(fleet.vehicles):
            self._state[index, :3] = config.initial_position
            self._setpoint[index, :3] = config.initial_position
            for name, value in config.firmware_params.items():
                self._set_param(index, c.SetParam(name, value))
            self._load_avoidance(index)
        self._now = clock.now()
        self._unregister: Callable[[], None] | None = clock.on_advance(self._advance)

    # Backend protocol

    @property
    def vehicles(self) -> Sequence[int]:
        return tuple(self._ids)

    def send(self, command: c.Command, vehicle: int | None = None) -> None:
        if vehicle is None:
            check(command, "all vehicles")
            for index in range(len(self._ids)):
                self._execute(index, command)
        else:
            index = self._at(vehicle)
            check(command, self._configs[index].name)
            self._execute(index, command)

    def send_external_poses(self, poses: Mapping[int, Pose]) -> None:
        """Perfect tracking knows where it is; poses are not needed."""

    def telemetry(self, vehicle: int) -> Telemetry:
        index = self._at(vehicle)
        row = self._state[index]
        supervisor = _LOCKED if self._locked[index] else _READY
        if self._modes[index] != MODE_IDLE:
            supervisor |= _FLYING
        return Telemetry(
            timestamp=self._now,
            battery=_FULL_BATTERY,
            link_quality=1.0,
            rssi=-40.0,
            supervisor=supervisor,
            state=VehicleState(
                timestamp=self._now,
                position=row[MO_POS : MO_POS + 3].copy(),
                velocity=row[MO_VEL : MO_VEL + 3].copy(),
                quaternion=flat_attitude(row[MO_ACC : MO_ACC + 3], row[MO_YAW]),
                angular_velocity=row[MO_OMEGA : MO_OMEGA + 3].copy(),
            ),
        )

    def get_param(self, vehicle: int, name: str) -> float:
        index = self._at(vehicle)
        try:
            return self._params[index][name]
        except KeyError:
            raise BackendError(
                f"{self._configs[index].name}: no parameter {name!r} has been set, nor does "
                "perfect tracking have one of that name"
            ) from None

    def close(self) -> None:
        if self._unregister is not None:
            self._unregister()
            self._unregister = None

    # What only a simulation can show

    def state(self, vehicle: int) -> IdealState:
        """True motion of one vehicle."""
        return _motion(self._state[self._at(vehicle)])

    def setpoint(self, vehicle: int) -> IdealState:
        """Setpoint of the latest tick, after collision avoidance."""
        return _motion(self._setpoint[self._at(vehicle)])

    def mode(self, vehicle: int) -> int:
        """Flight mode, one of the ``MODE_`` constants of the engine."""
        return int(self._modes[self._at(vehicle)])

    def planner(self, vehicle: int) -> planner:
        """Planner of one vehicle; it shares the vehicle's memory."""
        index = self._at(vehicle)
        return planner(self._planner[index], self._memory[index])

    def param_names(self, vehicle: int) -> Sequence[str]:
        """Names of all parameters that :meth:`get_param` knows."""
        return tuple(self._params[self._at(vehicle)])

    # Internals

    def _at(self, vehicle: int) -> int:
        try:
            return self._index[vehicle]
        except (KeyError, TypeError):
            known = ", ".join(map(str, self._ids))
            raise CommandError(f"no vehicle with id {vehicle!r}; the fleet has {known}") from None

    def _advance(self, now: float) -> None:
        dt = now - self._now
        if dt <= 0:
            return
        flying = int(np.count_nonzero(self._modes != MODE_IDLE))
        if flying:
            advance_fleet(
                now,
                dt,
                self._motion,
                self._avoiding,
                self._options.max_velocity,
                self._options.disturbance,
                np.random.normal(size=(flying, 3)),  # noqa: NPY002
            )
        self._now = now

    def _execute(self, index: int, command: c.Command) -> None:
        if self._locked[index] and not isinstance(command, c.Emergency):
            warnings.warn(
                f"{self._configs[index].name}: {verb(command)}: ignored; the emergency stop locks "
                "the vehicle until it is rebooted",
                stacklevel=4,
            )
            return
        mask = getattr(command, "group_mask", 0)
        if (
            mask != 0
            and not isinstance(command, c.SetGroupMask)
            and not (int(self._params[index][_GROUP_MASK]) & int(mask))
        ):
            return
        _HANDLERS[type(command)](self, index, command)

    def _takeoff(self, index: int, m: c.Takeoff) -> None:
        if self._planner[index, PL_STATE] == IDLE:
            self._vertical(index, m, landing=False)

    def _land(self, index: int, m: c.Land) -> None:
        if self._planner[index, PL_STATE] != LANDING:
            self._vertical(index, m, landing=True)

    def _vertical(self, index: int, m: c.Takeoff | c.Land, landing: bool) -> None:
        state = self._state[index]
        yaw = float(state[MO_YAW] if m.yaw is None else m.yaw)
        plan_vertical(
            self._planner[index], state, self._now, float(m.height), float(m.duration), yaw, landing
        )
        self._modes[index] = MODE_HIGH_LEVEL

    def _go_to(self, index: int, m: c.GoTo) -> None:
        if self._modes[index] != MODE_HIGH_LEVEL:
            raise CommandError(
                f"{self._configs[index].name}: goTo: the high-level commander is not in charge; "
                "take off first, or call notifySetpointsStop() after streaming setpoints"
            )
        x, y, z = (float(value) for value in np.asarray(m.position, dtype=np.float64))
        plan_go_to(
            self._planner[index],
            self._memory[index],
            self._state[index],
            self._now,
            x,
            y,
            z,
            float(m.yaw),
            float(m.duration),
            bool(m.relative),
        )

    def _stop(self, index: int, m: c.Command) -> None:
        self._modes[index] = freeze(self._planner[index], self._state[index])

    def _notify(self, index: int, m: c.NotifySetpointsStop) -> None:
        # The planner takes over from the present state, and hovers there until told otherwise.
        if self._modes[index] not in (MODE_IDLE, MODE_HIGH_LEVEL):
            self._planner[index, PL_STATE] = IDLE
            self._modes[index] = MODE_HIGH_LEVEL

    def _begin_stream(self, index: int, mode: int) -> np.ndarray:
        self._planner[index, PL_STATE] = IDLE
        self._modes[index] = mode
        row = self._stream[index]
        row[:] = 0.0
        return row

    def _full_state(self, index: int, m: c.FullState) -> None:
        row = self._begin_stream(index, MODE_FULL_STATE)
        row[MO_POS : MO_POS + 3] = m.position
        row[MO_VEL : MO_VEL + 3] = m.velocity
        row[MO_ACC : MO_ACC + 3] = m.acceleration
        row[MO_YAW] = m.yaw
        row[MO_OMEGA : MO_OMEGA + 3] = m.omega

    def _position(self, index: int, m: c.Position) -> None:
        row = self._begin_stream(index, MODE_POSITION)
        row[MO_POS : MO_POS + 3] = m.position
        row[MO_YAW] = m.yaw

    def _velocity(self, index: int, m: c.VelocityWorld) -> None:
        row = self._begin_stream(index, MODE_VELOCITY)
        row[MO_VEL : MO_VEL + 3] = m.velocity
        row[MO_OMEGA + 2] = m.yaw_rate

    def _hover(self, index: int, m: c.Hover) -> None:
        row = self._begin_stream(index, MODE_HOVER)
        row[MO_VEL] = m.vx
        row[MO_VEL + 1] = m.vy
        row[MO_POS + 2] = m.height
        row[MO_OMEGA + 2] = m.yaw_rate

    def _attitude(self, index: int, m: c.Attitude | c.RollPitchYawThrust) -> None:
        raise CommandError(
            f"{self._configs[index].name}: {verb(m)}: perfect tracking has no attitude to command; "
            "use --backend sim"
        )

    def _emergency(self, index: int, m: c.Emergency) -> None:
        self._stop(index, m)
        self._locked[index] = True

    def _arm(self, index: int, m: c.Arm) -> None:
        if not m.arm:
            self._stop(index, m)

    def _upload(self, index: int, m: c.UploadTrajectory) -> None:
        self._stored[index].note(m)
        # The planner reads the vehicle's format: 32 coefficients, then the duration, float32.
        self._trajectories[index][m.trajectory_id] = np.frombuffer(
            np.roll(np.asarray(m.pieces, dtype=np.float64), -1, axis=1).astype("<f4").tobytes(),
            dtype=np.uint8,
        )

    def _start(self, index: int, m: c.StartTrajectory) -> None:
        self._stored[index].require(m.trajectory_id)
        trajectory = self._trajectories[index][m.trajectory_id]
        self._memory[index, : len(trajectory)] = trajectory
        plan_trajectory(
            self._planner[index],
            self._memory[index],
            self._state[index],
            self._now,
            len(trajectory) // PIECE_BYTES,
            float(m.timescale),
            bool(m.reverse),
            bool(m.relative),
        )
        self._modes[index] = MODE_HIGH_LEVEL

    def _set_group_mask(self, index: int, m: c.SetGroupMask) -> None:
        self._params[index][_GROUP_MASK] = int(m.group_mask)

    def _set_param(self, index: int, m: c.SetParam) -> None:
        params = self._params[index]
        params[m.name] = int(m.value) if isinstance(params.get(m.name), int) else float(m.value)
        if m.name.startswith("colAv."):
            self._load_avoidance(index)

    def _set_led(self, index: int, m: c.SetLed) -> None:
        for name, value in (("Red", m.red), ("Green", m.green), ("Blue", m.blue)):
            self._params[index][f"ring.solid{name}"] = int(255 * value)

    def _collision_avoidance(self, index: int, m: c.CollisionAvoidance) -> None:
        params = self._params[index]
        params["colAv.enable"] = int(m.enable)
        if m.enable:
            for axis, name in enumerate("XYZ"):
                params[f"colAv.ellipsoid{name}"] = float(m.radii[axis])
                params[f"colAv.bboxMin{name}"] = float(m.bbox_min[axis])
                params[f"colAv.bboxMax{name}"] = float(m.bbox_max[axis])
            params["colAv.horizon"] = float(m.horizon)
            params["colAv.maxSpeed"] = float(m.max_speed)
            self._peers[index] = m.peers is None
            for peer in m.peers or ():
                self._peers[index, self._at(peer)] = True
            self._peers[index, index] = False
        self._load_avoidance(index)

    def _load_avoidance(self, index: int) -> None:
        params = self._params[index]
        self._avoidance[index] = [params[param.name] for param in collision_avoidance.PARAMS]
        self._last_feasible[index] = collision_avoidance.new_memory()


_HANDLERS: dict[type, Callable[[IdealBackend, int, Any], None]] = {
    c.Takeoff: IdealBackend._takeoff,
    c.Land: IdealBackend._land,
    c.GoTo: IdealBackend._go_to,
    c.Stop: IdealBackend._stop,
    c.NotifySetpointsStop: IdealBackend._notify,
    c.FullState: IdealBackend._full_state,
    c.Position: IdealBackend._position,
    c.VelocityWorld: IdealBackend._velocity,
    c.Hover: IdealBackend._hover,
    c.Attitude: IdealBackend._attitude,
    c.RollPitchYawThrust: IdealBackend._attitude,
    c.CutMotors: IdealBackend._stop,
    c.Emergency: IdealBackend._emergency,
    c.Arm: IdealBackend._arm,
    c.UploadTrajectory: IdealBackend._upload,
    c.StartTrajectory: IdealBackend._start,
    c.SetGroupMask: IdealBackend._set_group_mask,
    c.SetParam: IdealBackend._set_param,
    c.SetLed: IdealBackend._set_led,
    c.CollisionAvoidance: IdealBackend._collision_avoidance,
}


def _motion(row: Vector) -> IdealState:
    return IdealState(
        pos=row[MO_POS : MO_POS + 3].copy(),
        vel=row[MO_VEL : MO_VEL + 3].copy(),
        acc=row[MO_ACC : MO_ACC + 3].copy(),
        yaw=float(row[MO_YAW]),
        omega=row[MO_OMEGA : MO_OMEGA + 3].copy(),
    )


def flat_attitude(acc: Vector, yaw: float) -> Vector:
    """Quaternion x, y, z, w of a vehicle whose thrust gives ``acc`` (3,) m/s² at ``yaw`` rad."""
    tx, ty, tz = float(acc[0]), float(acc[1]), float(acc[2]) + 9.81
    half = 0.5 * float(yaw)
    cos, sin = math.cos(half), math.sin(half)
    # Thrust direction, seen from the heading.
    c2, s2 = cos * cos - sin * sin, 2 * sin * cos
    length = math.sqrt(tx * tx + ty * ty + tz * tz)
    if length < 1e-9:  # free fall: any attitude will do
        return np.array([0.0, 0.0, sin, cos])
    zx, zy, zz = (c2 * tx + s2 * ty) / length, (c2 * ty - s2 * tx) / length, tz / length
    # y_b = z_b x heading has no part along the heading: a roll about it comes first, then pitch.
    roll = 0.5 * math.atan2(-zy, zz)
    pitch = 0.5 * math.atan2(zx, math.hypot(zy, zz))
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    x, y, z, w = sr * cp, cr * sp, sr * sp, cr * cp
    return np.array([cos * x - sin * y, cos * y + sin * x, cos * z + sin * w, cos * w - sin * z])


def open_ideal(fleet: FleetConfig, clock: Clock, options: SimOptions) -> IdealBackend:
    """Factory named in the registry of backends."""
    if not isinstance(clock, VirtualClock):
        raise BackendError("backend 'ideal': perfect tracking needs a virtual clock")
    return IdealBackend(fleet, clock, options)
