"""A world known through its camera system alone: poses become rows for the referee.

The same for simulation, bench and arena: nothing here knows where the poses come from.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.crazyswarm_compat.commands import Command, FullState
from crazyarena.mocap.estimator import FrameResult
from crazyarena.runner.rig.rig import Rig
from crazyarena.sim_backend.firmware.supervisor import INFO_CRASHED, INFO_TUMBLED
from crazyarena.sim_backend.trace import (
    TR_CONTACT,
    TR_OMEGA,
    TR_POS,
    TR_QUAT,
    TR_RPY,
    TR_SETPOINT,
    TR_TIME,
    TR_TUMBLED,
    TR_VEL,
    TRACE_SIZE,
    UNKNOWN_CONTACT,
)
from crazyarena.types import Pose, PoseFrame

Array = NDArray[np.float64]


# A row of what the vehicle tells of itself: time s, battery V, motors 4, accelerometer g 3.
LOG_SIZE = 9
_LOG_PERIOD = 0.0149  # s at least between rows
_AT_REST = 100  # rows before an episode that are kept: the battery without load
_IS_TIME = np.eye(1, LOG_SIZE)[0]


class TrackedWorld:
    """The :class:`~crazyarena.runner.trial.world.World` of a rig.

    Episode time starts with :meth:`begin`; a row is kept for every accepted pose that was
    captured since. The setpoint in it is the last one streamed. Frames come in the thread that
    lets time pass on the rig's clock.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.clock = rig.clock
        self._rows: list[Array] = []
        self._log: list[Array] = []
        self._logged_at = -math.inf
        self._last: Array | None = None
        self._epoch = math.inf
        self._setpoint: Array = np.full(10, np.nan)
        rig.listeners.frames.append(self._see)

    def begin(self) -> float:
        """Start the episode's time now; returns that, s on the session's clock."""
        self._rows.clear()
        self._epoch = self.clock.now()
        self._log = [row - self._epoch * _IS_TIME for row in self._log[-_AT_REST:]]
        return self._epoch

    def reset(self, draw: Any) -> None:
        """Make ready for an episode; its time does not run before :meth:`begin`."""
        self.rig.stage(draw)
        self._rows.clear()
        self._log.clear()
        self._last = None
        self._epoch = math.inf

    def send(self, command: Command) -> None:
        """Send to the rig's vehicle."""
        self.rig.backend.send(command, self.rig.vehicle)
        if isinstance(command, FullState):
            parts = (command.position, command.velocity, command.acceleration, (command.yaw,))
            self._setpoint = np.concatenate(parts)
        else:
            self._setpoint = np.full(10, np.nan)

    def poll(self) -> Array:
        """Rows (k, TRACE_SIZE) of the poses since the last call."""
        rows, self._rows = self._rows, []
        if not rows:
            return np.empty((0, TRACE_SIZE))
        info = self.rig.backend.telemetry(self.rig.vehicle).supervisor
        if info is not None:
            rows[-1][TR_TUMBLED] = float(info & (INFO_TUMBLED | INFO_CRASHED) != 0)
        return np.array(rows)

    def logged(self) -> Array:
        """Rows (k, LOG_SIZE) of what the vehicle has told of itself since the last call."""
        rows, self._log = self._log, []
        return np.array(rows).reshape(-1, LOG_SIZE)

    def motor_forces(self) -> Array:
        """Nobody measures them: NaN."""
        return np.full(4, np.nan)

    def state(self) -> Array | None:
        """(12,) state as a contestant's full state, of the last pose seen; None if never."""
        row = self._last
        if row is None:
            return None
        state = np.empty(12)
        state[0:6:2] = row[TR_POS : TR_POS + 3]
        state[1:6:2] = row[TR_VEL : TR_VEL + 3]
        state[6:9] = row[TR_RPY : TR_RPY + 3]
        state[9:12] = row[TR_OMEGA : TR_OMEGA + 3]
        return state

    def close(self) -> None:
        """Release the rig; idempotent."""
        self.rig.close()

    def _see(self, frame: PoseFrame, result: FrameResult) -> None:
        self._note_log()
        pose = result.accepted.get(self.rig.body)
        if pose is None:
            return
        row = self._row(pose, frame.received)
        row[TR_TIME] = frame.timestamp - self._epoch
        self._last = row
        if row[TR_TIME] > 0.0:
            self._rows.append(row)

    def _note_log(self) -> None:
        told = self.rig.backend.telemetry(self.rig.vehicle)
        if told.motors is None or told.acceleration is None or told.battery is None:
            return
        if told.timestamp - self._logged_at < _LOG_PERIOD:
            return
        self._logged_at = told.timestamp
        time = told.timestamp
        if math.isfinite(self._epoch):
            time -= self._epoch
        else:
            del self._log[:-_AT_REST]
        self._log.append(np.array((time, told.battery, *told.motors, *told.acceleration)))

    def _row(self, pose: Pose, received: float) -> Array:
        # As of its arrival, also when nobody had the time to look at it then.
        moving = self.rig.pipeline.estimate(self.rig.body, received).state
        row = np.full(TRACE_SIZE, np.nan)
        row[TR_POS : TR_POS + 3] = pose.position
        row[TR_QUAT : TR_QUAT + 4] = pose.quaternion
        row[TR_RPY : TR_RPY + 3] = roll_pitch_yaw(pose.quaternion)
        row[TR_VEL : TR_VEL + 3] = moving.velocity
        row[TR_OMEGA : TR_OMEGA + 3] = moving.angular_velocity
        row[TR_CONTACT] = UNKNOWN_CONTACT
        row[TR_SETPOINT : TR_SETPOINT + 10] = self._setpoint
        return row


def heading_like(yaw: float, quaternion: Array) -> float:
    """Heading, rad, of a measured body that has no front: of its two, the one near ``yaw``."""
    turned = roll_pitch_yaw(quaternion)[2] - yaw
    return yaw + (turned + 0.5 * math.pi) % math.pi - 0.5 * math.pi


def roll_pitch_yaw(quaternion: Array) -> tuple[float, float, float]:
    """Fixed-axis XYZ angles, rad, of a quaternion x, y, z, w."""
    x, y, z, w = quaternion.tolist()
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x)))),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )
