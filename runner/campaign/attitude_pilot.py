"""A contestant of the fault campaign that flies its circuit by attitude."""

from __future__ import annotations

import math

import numpy as np

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.safety.attitude_path import FULL, GRAVITY, tilt_of
from crazyarena.types import VehicleState

_STIFFNESS = np.array([8.0, 8.0, 14.0])  # 1/s2
_DAMPING = np.array([4.5, 4.5, 6.0])  # 1/s
_INTEGRAL = 4.0  # 1/s3
_TILT = 0.5  # rad


class AttitudePilot:
    """Follows setpoints with roll, pitch, a heading of 0 and thrust.

    thrust_to_weight: of the vehicle; what is wrong about it is learned on the way.
    """

    def __init__(self, thrust_to_weight: float) -> None:
        self._full = thrust_to_weight * GRAVITY
        self._bias = np.zeros(3)
        self._last = -math.inf

    def command(self, now: float, state: VehicleState, goal: c.FullState) -> c.RollPitchYawThrust:
        """What to ask for at a time, s."""
        dt = min(max(now - self._last, 0.0), 0.1)
        self._last = now
        error = np.asarray(goal.position) - state.position
        self._bias = np.clip(self._bias + _INTEGRAL * dt * error, -2.0, 2.0)
        want = np.asarray(goal.acceleration) + self._bias + _STIFFNESS * error
        want = want + _DAMPING * (np.asarray(goal.velocity) - state.velocity)
        lift = max(float(want[2]) + GRAVITY, 3.0)
        flat = float(np.hypot(*want[:2]))
        most = math.tan(_TILT) * lift
        if flat > most:
            want[:2] *= most / flat
        total = math.hypot(float(want[0]), float(want[1]), lift)
        roll, pitch = tilt_of(float(want[0]), float(want[1]), 0.0, total)
        return c.RollPitchYawThrust(roll, pitch, 0.0, int(min(total / self._full, 1.0) * FULL))
