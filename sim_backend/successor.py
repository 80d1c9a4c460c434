"""lsy_drone_racing's simulation as a world: one drone, exact truth, a step at a time.

It reproduces the published loop (state commands through the position controller at the
environment's rate, attitude commands directly, first-principles dynamics, disturbances), for
comparison with published results. ``sim_backend.arena`` is what a real vehicle does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from crazyarena.levels.lsy.draw import LsyDraw, Nominal
from crazyarena.levels.lsy.schema import LsyLevel
from crazyarena.sim_backend import successor_kernel as core
from crazyarena.sim_backend.firmware.successor_control import control_row
from crazyarena.sim_backend.physics.successor_plant import SS_RATE, parameter_row
from crazyarena.sim_backend.physics.successor_scene import SOLID_SIZE, build_solids
from crazyarena.sim_backend.successor_models import model
from crazyarena.sim_backend.trace import TRACE_SIZE

Array = NDArray[np.float64]


def nominal(level: LsyLevel) -> Nominal:
    """What the level's vehicle is before anything is drawn."""
    chosen = model(level.sim.drone_model)
    return Nominal(chosen.mass, chosen.inertia)


class SuccessorWorld:
    """The simulation of one level; :meth:`reset` before the first :meth:`step`."""

    def __init__(self, level: LsyLevel) -> None:
        chosen = model(level.sim.drone_model)
        self._level = level
        self._model = chosen
        self._control = control_row(
            chosen.controller_mass, chosen.thrust_min, chosen.thrust_max,
            chosen.pwm_min, chosen.pwm_max, chosen.rpm2thrust,
        )  # fmt: skip
        self._limits = 4.0 * np.array([chosen.thrust_min, chosen.thrust_max])
        sim = level.sim
        self._rates = np.array([sim.freq, level.env.freq, sim.attitude_freq], float)
        self._is_state = level.env.control_mode == "state"
        self._drone = np.zeros(SOLID_SIZE)
        self._command = np.zeros(13)

    def reset(self, draw: LsyDraw) -> None:
        """Place the drone, motors off, and the track as drawn."""
        chosen = self._model
        self._draw = draw
        self._vehicle = core.new_vehicle(draw.start)
        self._plant = parameter_row(
            draw.mass, draw.inertia, chosen.L, chosen.rpm2thrust, chosen.rpm2torque,
            chosen.rotor_dyn_coef, chosen.prop_inertia, chosen.drag,
        )  # fmt: skip
        self._solids = build_solids(draw.gates, draw.obstacles)

    @property
    def state(self) -> Array:
        """(13,) position 3, velocity 3, quaternion 4 (x, y, z, w), body rates 3."""
        return self._vehicle[: SS_RATE + 3].copy()

    def step(self, command: Array) -> Array:
        """Fly one step under a command of the level's mode.

        Returns
        -------
        Its ticks, (k, TRACE_SIZE), see :mod:`.trace`.
        """
        noise, force = self._draw.step_noise()
        self._command[: len(command)] = command + noise
        trace = np.zeros((self._level.ticks, TRACE_SIZE))
        core.step(
            self._vehicle, self._plant, self._control, self._solids, self._drone, self._command,
            self._is_state, self._limits, force, self._rates, trace,
        )  # fmt: skip
        return trace
