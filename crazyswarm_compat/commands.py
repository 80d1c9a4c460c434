"""One class per verb that can be sent to a vehicle.

Plain data, SI units and radians. Arrays are anything :func:`numpy.asarray` takes with shape
(3,); a backend converts to its own units at its border. ``group_mask`` 0 addresses everybody,
otherwise the vehicles whose own mask shares a bit with it (firmware rule).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, slots=True)
class Takeoff:
    """Rise vertically to ``height`` (m, absolute) in ``duration`` s.

    ``yaw`` rad, or None to keep the present heading.
    """

    height: float
    duration: float
    yaw: float | None = None
    group_mask: int = 0


@dataclass(frozen=True, slots=True)
class Land:
    """Descend vertically to ``height`` (m, absolute) in ``duration`` s; then motors idle."""

    height: float
    duration: float
    yaw: float | None = None
    group_mask: int = 0


@dataclass(frozen=True, slots=True)
class GoTo:
    """Fly to ``position`` (3,) m with ``yaw`` rad, arriving at rest after ``duration`` s.

    ``relative`` adds both to the present setpoint.
    """

    position: ArrayLike
    yaw: float
    duration: float
    relative: bool = False
    group_mask: int = 0


@dataclass(frozen=True, slots=True)
class Stop:
    """Make the high-level planner idle (on a real vehicle: motors off)."""

    group_mask: int = 0


@dataclass(frozen=True, slots=True)
class NotifySetpointsStop:
    """Hand control from streamed setpoints back to the high-level planner."""

    remain_valid_ms: int = 100
    group_mask: int = 0


@dataclass(frozen=True, slots=True)
class FullState:
    """Streamed setpoint: position m, velocity m/s, acceleration m/s², each (3,) world;
    yaw rad; body rates ``omega`` (3,) rad/s."""

    position: ArrayLike
    velocity: ArrayLike
    acceleration: ArrayLike
    yaw: float
    omega: ArrayLike


@dataclass(frozen=True, slots=True)
class Position:
    """Streamed setpoint: position (3,) m and yaw rad."""

    position: ArrayLike
    yaw: float = 0.0


@dataclass(frozen=True, slots=True)
class VelocityWorld:
    """Streamed setpoint: velocity (3,) m/s in the world frame, yaw rate rad/s, CCW positive."""

    velocity: ArrayLike
    yaw_rate: float = 0.0


@dataclass(frozen=True, slots=True)
class Hover:
    """Streamed setpoint: velocity vx, vy m/s in the yaw-aligned body frame, yaw rate rad/s CCW,
    absolute height m."""

    vx: float
    vy: float
    yaw_rate: float
    height: float


@dataclass(frozen=True, slots=True)
class Attitude:
    """Streamed setpoint: roll, pitch rad (positive pitch is nose down), yaw rate rad/s CCW,
    thrust 0..65535."""

    roll: float
    pitch: float
    yaw_rate: float
    thrust: int


@dataclass(frozen=True, slots=True)
class RollPitchYawThrust:
    """Streamed setpoint: roll, pitch rad (positive pitch is nose down) and heading ``yaw`` rad,
    thrust 0..65535.

    The legacy packet (CRTP port 3), which says a yaw *rate* unless the vehicle's parameter
    ``flightmode.stabModeYaw`` is 1; the firmware takes at most 60000 of the thrust.
    """

    roll: float
    pitch: float
    yaw: float
    thrust: int


@dataclass(frozen=True, slots=True)
class CutMotors:
    """Streamed setpoint: motors off now; a later setpoint may start them again."""


@dataclass(frozen=True, slots=True)
class Emergency:
    """Firmware emergency stop: motors off and locked until reboot."""


@dataclass(frozen=True, slots=True)
class Arm:
    """Arm (or disarm) the motors."""

    arm: bool = True


@dataclass(frozen=True, slots=True)
class UploadTrajectory:
    """Store a piecewise polynomial in the vehicle's trajectory memory.

    ``pieces`` (n, 33): duration s, then x, y, z (m) and yaw (rad) with 8 ascending
    coefficients each. ``piece_offset`` counts pieces, not bytes.
    """

    trajectory_id: int
    piece_offset: int
    pieces: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class StartTrajectory:
    """Fly an uploaded trajectory; ``timescale`` 2 takes twice as long."""

    trajectory_id: int
    timescale: float = 1.0
    reverse: bool = False
    relative: bool = True
    group_mask: int = 0


@dataclass(frozen=True, slots=True)
class SetGroupMask:
    """Set the vehicle's own 8-bit group mask."""

    group_mask: int


@dataclass(frozen=True, slots=True)
class SetParam:
    """Write one firmware parameter, ``name`` as ``group.name``."""

    name: str
    value: float


@dataclass(frozen=True, slots=True)
class SetLed:
    """LED ring colour, 0..1 each."""

    red: float
    green: float
    blue: float


@dataclass(frozen=True, slots=True)
class CollisionAvoidance:
    """Buffered-Voronoi collision avoidance on board (Zhou et al., RA-L 2017).

    ``radii`` (3,) m ellipsoid; ``bbox_min``/``bbox_max`` (3,) m; ``horizon`` s; ``max_speed`` m/s.
    ``peers`` are the ids to avoid, None for everybody (a real vehicle avoids all it hears of).
    """

    enable: bool
    radii: Sequence[float] = (0.3, 0.3, 0.9)
    bbox_min: Sequence[float] = field(default=(-np.inf, -np.inf, -np.inf))
    bbox_max: Sequence[float] = field(default=(np.inf, np.inf, np.inf))
    horizon: float = 1.0
    max_speed: float = 0.5
    peers: Sequence[int] | None = None


Command: TypeAlias = (
    Takeoff
    | Land
    | GoTo
    | Stop
    | NotifySetpointsStop
    | FullState
    | Position
    | VelocityWorld
    | Hover
    | Attitude
    | CutMotors
    | Emergency
    | Arm
    | UploadTrajectory
    | StartTrajectory
    | SetGroupMask
    | SetParam
    | SetLed
    | CollisionAvoidance
    | RollPitchYawThrust
)

# Setpoints: they count until the next one, which must not be long in coming.
STREAMED = (FullState, Position, VelocityWorld, Hover, Attitude, RollPitchYawThrust)
