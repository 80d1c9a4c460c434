"""Types that cross borders between folders: poses, vehicle states, telemetry.

SI units and radians; world frame ENU-like (x forward, y left, z up); quaternions are
body-to-world in the order x, y, z, w.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


def _identity() -> Vector:
    return np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class Pose:
    """Position (3,) in m and attitude quaternion (4,) x, y, z, w, both in the world frame."""

    position: Vector
    quaternion: Vector = field(default_factory=_identity)


@dataclass(frozen=True, slots=True)
class PoseFrame:
    """What a camera system (or simulator) saw at one instant.

    Attributes
    ----------
    timestamp: capture time, s, on the session clock.
    received: when the frame reached this process, s, same clock.
    frame_id: counts up by one per frame at the source; a gap is a lost frame.
    bodies: rigid bodies by name; a body that was not seen is absent.
    markers: (m, 3) unlabelled markers in m, possibly empty.
    """

    timestamp: float
    received: float
    frame_id: int
    bodies: Mapping[str, Pose]
    markers: Vector = field(default_factory=lambda: np.empty((0, 3)))


@dataclass(frozen=True, slots=True)
class VehicleState:
    """Full state of one vehicle.

    position (3,) m, velocity (3,) m/s world, quaternion (4,) x, y, z, w,
    angular_velocity (3,) rad/s in the body frame, timestamp s.
    """

    timestamp: float
    position: Vector
    velocity: Vector
    quaternion: Vector
    angular_velocity: Vector


@dataclass(frozen=True, slots=True)
class Telemetry:
    """Last known health of one vehicle; ``None`` where the link has not told yet.

    battery V; link_quality 0..1; rssi dBm (negative); supervisor is the bit field of the
    firmware's ``supervisor.info``; state is the on-board estimate; power_state is ``pm.state``:
    0 on battery, 1 charging, 2 charged, 3 low, 4 empty; motors (4,) are the commands of M1..M4 as
    shares of full scale; acceleration (3,) g is the specific force in body axes; rates_at s is when
    the angular velocity of ``state`` was told, if that is not the time of the state; position_std m
    and velocity_std m/s are the largest standard deviations, over the axes, that the on-board
    filter gives its estimate.
    """

    timestamp: float
    battery: float | None = None
    link_quality: float | None = None
    rssi: float | None = None
    supervisor: int | None = None
    state: VehicleState | None = None
    power_state: int | None = None
    motors: Vector | None = None
    acceleration: Vector | None = None
    rates_at: float | None = None
    position_std: float | None = None
    velocity_std: float | None = None


@dataclass(frozen=True, slots=True)
class VehicleContact:
    """Two vehicles begin to touch: ``time`` s, their ids (``first`` comes first in the fleet),
    and the ``speed`` (m/s) at which their closest points approached each other."""

    time: float
    first: int
    second: int
    speed: float
