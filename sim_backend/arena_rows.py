"""The memory of one ``arena`` vehicle by the names of its parts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyarena.sim_backend.firmware import stack_2026
from crazyarena.sim_backend.firmware.kalman import KM_P

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class VehicleRows:
    """Live views of one vehicle's memory, for the kernels of ``firmware/``."""

    body: Array
    plant: Array
    memory: Array
    params: Array
    trajectories: NDArray[np.uint8]

    @property
    def state(self) -> Array:
        return self.memory[stack_2026.F_STATE : stack_2026.F_SETPOINT]

    @property
    def setpoint(self) -> Array:
        return self.memory[stack_2026.F_SETPOINT : stack_2026.F_CONTROL]

    @property
    def control(self) -> Array:
        return self.memory[stack_2026.F_CONTROL : stack_2026.F_MOTORS]

    @property
    def motors(self) -> Array:
        return self.memory[stack_2026.F_MOTORS : stack_2026.F_SUPPLY]

    @property
    def supervisor(self) -> Array:
        return self.memory[stack_2026.F_SUPERVISOR : stack_2026.F_COMMANDER]

    @property
    def commander(self) -> Array:
        return self.memory[stack_2026.F_COMMANDER : stack_2026.F_MELLINGER]

    @property
    def mellinger(self) -> Array:
        return self.memory[stack_2026.F_MELLINGER : stack_2026.F_PID]

    @property
    def pid(self) -> Array:
        return self.memory[stack_2026.F_PID : stack_2026.F_AVOIDANCE]

    @property
    def kalman(self) -> Array:
        return self.memory[stack_2026.F_KALMAN : stack_2026.F_HIGH_LEVEL]

    @property
    def stds(self) -> tuple[float, float]:
        """Standard deviations that the filter gives position (m) and velocity (m/s), each on its
        worst axis."""
        x, y, z, vx, vy, vz = self.kalman[KM_P : KM_P + 60 : 10].tolist()
        return math.sqrt(max(x, y, z)), math.sqrt(max(vx, vy, vz))

    @property
    def high_level(self) -> Array:
        return self.memory[stack_2026.F_HIGH_LEVEL : stack_2026.F_PLATFORM]

    @property
    def high_level_params(self) -> Array:
        return self.params[stack_2026.P_HIGH_LEVEL : stack_2026.P_AVOIDANCE]
