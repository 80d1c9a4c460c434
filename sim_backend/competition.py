"""The IROS 2022 competition pipeline as a world that a trial can fly in.

One vehicle, virtual time, exact truth. Commands queue up and at most one is executed at the
start of a control period, always after a stop of the planner, as in the published software
(safe-control-gym, branch of the competition). ``CompetitionBatch`` is the same kernel over many
worlds for Monte-Carlo runs.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from crazyarena.clock import VirtualClock
from crazyarena.crazyswarm_compat import commands
from crazyarena.errors import BackendError, CommandError
from crazyarena.levels.draw import Draw
from crazyarena.sim_backend import competition_kernel as core
from crazyarena.sim_backend.firmware import high_level, mellinger, parameters
from crazyarena.sim_backend.physics import geometry
from crazyarena.sim_backend.physics.scene import build_scene, ground_code
from crazyarena.sim_backend.trace import TRACE_SIZE
from crazyarena.types import Pose, Telemetry

Array = NDArray[np.float64]
_MEMORY_BYTES = 4096


class CompetitionWorld:
    """A vehicle of the 2022 pipeline behind the :class:`Backend` protocol.

    Parameters
    ----------
    control_rate: Hz; a control period is 16 or 17 ticks of 2 ms at 30 Hz.
    vehicle: the id under which the vehicle is addressed.

    The world registers with its own :attr:`clock`: ``clock.sleep_until`` flies every control
    period that ends by then. :meth:`poll` returns the ticks flown since.
    """

    def __init__(self, control_rate: float = 30.0, vehicle: int = 0) -> None:
        self.clock = VirtualClock()
        self.control_rate = float(control_rate)
        self._id = vehicle
        self._unregister: Callable[[], None] | None = self.clock.on_advance(self._advance)
        bodies, firmware = core.new_rows(1)
        self._body, self._firmware = bodies[0], firmware[0]
        self._gains = parameters.default_row(mellinger.PARAMS, 2022)
        self._memory = np.zeros(_MEMORY_BYTES, np.uint8)
        self._plant = np.zeros(4)
        self._queue: deque[commands.Command] = deque()
        self._pending: list[Array] = []
        self._draw: Draw | None = None

    # --- world -----------------------------------------------------------------------------

    def reset(self, draw: Draw) -> None:
        """Place the vehicle and the track as drawn; episode time restarts at 0 now."""
        x, vx, y, vy, z, vz, roll, pitch, yaw, p, q, r = draw.start
        core.reset(self._body, self._firmware, x, y, z, vx, vy, vz, roll, pitch, yaw, p, q, r)
        self._plant[0] = draw.mass
        self._plant[1:] = draw.inertia
        self._scene = build_scene(draw.gates, draw.obstacles)
        self._ground = ground_code(self._scene)
        self._work = geometry.make_workspace()
        self._queue.clear()
        self._pending.clear()
        self._draw = draw
        self._period = 0
        self._epoch = self.clock.now()

    def poll(self) -> Array:
        """Ticks flown since the last call, (k, TRACE_SIZE), see :mod:`.trace`."""
        if len(self._pending) == 1:
            return self._pending.pop()
        rows = np.concatenate(self._pending) if self._pending else np.empty((0, TRACE_SIZE))
        self._pending.clear()
        return rows

    def motor_forces(self) -> Array:
        """(4,) rotor forces the firmware asks of the next tick, N; order as in the trace."""
        return self._firmware[core.F_ACTION : core.F_ACTION + 4].copy()

    def close(self) -> None:
        """Stop following the clock; idempotent."""
        if self._unregister is not None:
            self._unregister()
            self._unregister = None

    def _advance(self, now: float) -> None:
        if self._draw is None:
            return
        # Periods are counted, not timed: their tick counts come from the original's rounding.
        # One that has not ended yet is not flown: commands may still come.
        due = int((now - self._epoch) * self.control_rate + 1e-6)
        while self._period < due:
            self._fly_period()

    def _fly_period(self) -> None:
        assert self._draw is not None
        if self._queue:
            self._execute(self._queue.popleft())
        n_ticks = core.ticks_due(int(self._firmware[core.F_TICK]), self._period, self.control_rate)
        trace = np.empty((n_ticks, TRACE_SIZE))
        core.advance(
            self._body,
            self._plant,
            self._firmware,
            self._gains,
            self._memory,
            self._scene,
            self._ground,
            self._work,
            self._draw.tick_noise(n_ticks),
            n_ticks,
            trace,
        )
        self._pending.append(trace)
        self._period += 1

    def _execute(self, command: commands.Command) -> None:
        firmware = self._firmware
        planner = firmware[core.F_HIGH_LEVEL :]
        now = self._period * (1.0 / self.control_rate)
        high_level.stop(planner)
        match command:
            case commands.FullState():
                core.full_state(firmware, _full_state_values(command))
                return
            case commands.Takeoff(height, duration, yaw):
                high_level.takeoff(planner, *_vertical(height, duration, yaw), now)
            case commands.Land(height, duration, yaw):
                high_level.land(planner, *_vertical(height, duration, yaw), now)
            case commands.GoTo(position, yaw, duration, relative):
                x, y, z = np.asarray(position, dtype=np.float64)
                high_level.go_to(
                    planner, self._memory, x, y, z, float(yaw), float(duration), bool(relative),
                    False, now,
                )  # fmt: skip
            case commands.Stop():
                return
            case commands.NotifySetpointsStop():
                high_level.tell_state(planner, firmware[core.F_STATE : core.F_SETPOINT])
        firmware[core.F_STREAMING] = 0.0

    # --- Backend ---------------------------------------------------------------------------

    @property
    def vehicles(self) -> Sequence[int]:
        return (self._id,)

    def send(self, command: commands.Command, vehicle: int | None = None) -> None:
        """Queue a command for the next control period.

        Raises
        ------
        CommandError: unknown vehicle, or a verb that the 2022 wrapper does not have.
        """
        self._check(vehicle)
        if isinstance(command, commands.SetParam):
            self._gains[self._gain(command.name)] = command.value
        elif isinstance(command, _VERBS):
            self._queue.append(command)
        else:
            raise CommandError(
                f"vehicle {self._id}: the competition profile knows "
                f"{', '.join(verb.__name__ for verb in _VERBS)}; found {type(command).__name__}"
            )

    def send_external_poses(self, poses: Mapping[int, Pose]) -> None:
        """Ignored: the competition's firmware was fed from the truth."""

    def telemetry(self, vehicle: int) -> Telemetry:
        """Only the time: the pipeline models neither battery nor link."""
        self._check(vehicle)
        return Telemetry(timestamp=self.clock.now())

    def get_param(self, vehicle: int, name: str) -> float:
        """Read a gain of the Mellinger controller, e.g. ``ctrlMel.kp_xy``."""
        self._check(vehicle)
        return float(self._gains[self._gain(name)])

    def _check(self, vehicle: int | None) -> None:
        if vehicle is not None and vehicle != self._id:
            raise CommandError(f"vehicle {vehicle}: unknown; this world has vehicle {self._id}")

    def _gain(self, name: str) -> int:
        try:
            return parameters.index(mellinger.PARAMS, name)
        except KeyError:
            raise BackendError(
                f"vehicle {self._id}: no parameter '{name}'; the competition profile has "
                f"{', '.join(p.name for p in mellinger.PARAMS)}"
            ) from None


_VERBS = (
    commands.Takeoff,
    commands.Land,
    commands.GoTo,
    commands.Stop,
    commands.NotifySetpointsStop,
    commands.FullState,
)


def _vertical(height: float, duration: float, yaw: float | None) -> tuple:
    # Exact types: a kernel called with integers would be compiled a second time.
    return float(height), float(duration), 0.0 if yaw is None else float(yaw), yaw is None


def _full_state_values(command: commands.FullState) -> Array:
    values = np.empty(13)
    values[0:3] = command.position
    values[3:6] = command.velocity
    values[6:9] = command.acceleration
    values[9] = command.yaw
    values[10:13] = command.omega
    return values


class CompetitionBatch:
    """Many independent worlds of the 2022 pipeline in lock step, parallel over worlds.

    Parameters
    ----------
    draws: one per world, all with the same number of gates and obstacles.
    control_rate: Hz.

    Vehicles are flown with full-state setpoints (:meth:`full_state`); :attr:`states` is the
    truth after the last period.
    """

    def __init__(self, draws: Sequence[Draw], control_rate: float = 30.0) -> None:
        worlds = len(draws)
        self.control_rate = float(control_rate)
        self._bodies, self._firmware = core.new_rows(worlds)
        self._plants = np.array([[d.mass, *d.inertia] for d in draws])
        self._scenes = np.stack([build_scene(d.gates, d.obstacles) for d in draws])
        self._ground = ground_code(self._scenes[0])
        self._work = np.stack([geometry.make_workspace() for _ in draws])
        self._gains = parameters.default_row(mellinger.PARAMS, 2022)
        self._memory = np.zeros(_MEMORY_BYTES, np.uint8)
        self._draws = [draw for draw in draws if draw.disturbed]
        if 0 < len(self._draws) < worlds:
            raise ValueError("either all draws have disturbances or none")
        self._noise = np.zeros((1 if not self._draws else worlds, 0, 7))
        self._period = 0
        for body, firmware, draw in zip(self._bodies, self._firmware, draws, strict=True):
            x, vx, y, vy, z, vz, roll, pitch, yaw, p, q, r = draw.start
            core.reset(body, firmware, x, y, z, vx, vy, vz, roll, pitch, yaw, p, q, r)

    @property
    def states(self) -> Array:
        """Position 3, velocity 3, quaternion 4 (x, y, z, w), body rates 3: (worlds, 13)."""
        return self._bodies[:, :13]

    def full_state(self, values: Array) -> None:
        """Stream one setpoint to each world: (worlds, 13), see :func:`.full_state`."""
        core.full_state_worlds(self._firmware, values)

    def advance(self, trace: Array | None = None) -> int:
        """Fly one control period; returns its ticks.

        ``trace`` (worlds, >= 17, TRACE_SIZE) is filled if given.
        """
        first = int(self._firmware[0, core.F_TICK])
        n_ticks: int = core.ticks_due(first, self._period, self.control_rate)
        noise = self._next_noise(n_ticks)
        rows = np.empty((1, 0, TRACE_SIZE)) if trace is None else trace
        core.advance_worlds(
            self._bodies, self._plants, self._firmware, self._gains, self._memory,
            self._scenes, self._ground, self._work, noise, n_ticks, rows,
        )  # fmt: skip
        self._period += 1
        return n_ticks

    def _next_noise(self, n_ticks: int) -> Array:
        """Disturbances of the coming ticks; drawn ahead, because a call costs as much as many."""
        if self._noise.shape[1] < n_ticks:
            ahead = 6 * n_ticks
            if self._draws:
                fresh = np.stack([draw.tick_noise(ahead) for draw in self._draws])
            else:
                fresh = np.zeros((1, ahead, 7))
            self._noise = np.concatenate([self._noise, fresh], axis=1)
        taken, self._noise = self._noise[:, :n_ticks], self._noise[:, n_ticks:]
        return np.ascontiguousarray(taken)
