"""Everything the monitors look at, as plain numbers, at one moment."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from crazyarena.safety.heading import GRAVITY, Point, Turned

LAG = 0.5
"""s: damping over stiffness of the Mellinger controller, sideways. A vehicle that is told places
but no velocity is behind by its speed times that."""
NOWHERE: Point = (math.nan, math.nan, math.nan)


def yaw_of(quaternion: Any) -> float:
    """Heading, rad, of an attitude x, y, z, w."""
    x, y, z, w = (float(value) for value in quaternion)
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def upright_of(quaternion: Any) -> float:
    """Cosine of the tilt of an attitude x, y, z, w."""
    x, y, _, _ = (float(value) for value in quaternion)
    return 1.0 - 2.0 * (x * x + y * y)


def as_point(values: Any) -> Point:
    """Three numbers, of an array or any other sequence, as plain floats."""
    x, y, z = values
    return float(x), float(y), float(z)


@dataclass(slots=True)
class Observation:
    """State and flags of one vehicle; ``None`` is "nobody has told", and trips no monitor.

    Attributes
    ----------
    time: s, session clock.
    active: a trial is on; the vehicle has been given a command that makes it fly.
    airborne: off the ground, as far as anybody knows.
    position, velocity: m, m/s, world; None when neither cameras nor vehicle know.
    quaternion: x, y, z, w.
    rates: rad/s, of the body.
    pose_age: s since the capture of the last believed pose; inf before the first.
    camera_rate: Hz, of the frames of the last second.
    doubted: s for which poses have arrived that were not believed (0 while they are).
    swapped: this frame's bodies had exchanged names.
    onboard: the vehicle's own estimate of its position, if it is recent.
    link_age: s since the vehicle was last heard.
    setpoint: position the vehicle was last told to be at now, m.
    setpoint_velocity: m/s, that it was told with it.
    streamed: place of the last streamed setpoint that had one, whatever else it said, m.
    pushed: acceleration, m/s2, that the streamed attitude asks for; None if none is streamed.
    controller_age: s since the contestant last answered or refreshed its streamed setpoint.
    lateness: of the last control step, s.
    clock_error: s by which two clocks that should run alike have drifted apart.
    turned: what the vehicle's gyroscope says of the heading that cameras give it.
    dead_man_age: s since the operator last held the key; None when there is none to hold.
    neighbour, neighbour_predicted: m to the nearest other vehicle in the air, now and if both were
        told to stop now.
    below: places, m, of other vehicles, flying or not, in whose way this one would come down.
    person_distance: m to the nearest person, horizontally; person_depth: how far the one
        deepest inside the fence is inside, m (negative: all outside).
    strangers: bodies seen that nobody has named.
    """

    time: float
    active: bool = False
    airborne: bool = False
    position: Point | None = None
    velocity: Point = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    rates: Point = (0.0, 0.0, 0.0)
    pose_age: float = 0.0
    camera_rate: float | None = None
    doubted: float = 0.0
    swapped: bool = False
    onboard: Point | None = None
    link_age: float | None = None
    link_quality: float | None = None
    battery: float | None = None
    supervisor: int | None = None
    setpoint: Point | None = None
    setpoint_velocity: Point = (0.0, 0.0, 0.0)
    streamed: Point | None = None
    pushed: Point | None = None
    controller_age: float | None = None
    lateness: float | None = None
    clock_error: float | None = None
    turned: Turned | None = None
    dead_man_age: float | None = None
    neighbour: float | None = None
    neighbour_predicted: float | None = None
    below: tuple[Point, ...] = ()
    person_distance: float | None = None
    person_depth: float | None = None
    strangers: int = 0

    def flown_from(self, tolerance: float) -> Point | None:
        """Where the vehicle's own controllers take it to be: what they are told must fit that.

        The position, but the vehicle's estimate if the two are further apart than ``tolerance``.
        """
        if self.position is None or self.onboard is None:
            return self.position
        return (
            self.position if math.dist(self.position, self.onboard) <= tolerance else self.onboard
        )

    @property
    def upright(self) -> float:
        """Cosine of the tilt."""
        return upright_of(self.quaternion)

    @property
    def yaw(self) -> float:
        """rad."""
        return yaw_of(self.quaternion)

    def horizontal_acceleration(self, limit: float) -> tuple[float, float]:
        """What the attitude makes of gravity, m/s2, if the height is kept; at most ``limit``."""
        x, y, z, w = self.quaternion
        up = max(self.upright, 0.3)
        ax = GRAVITY * 2.0 * (x * z + w * y) / up
        ay = GRAVITY * 2.0 * (y * z - w * x) / up
        size = math.hypot(ax, ay)
        if size > limit:
            ax, ay = ax * limit / size, ay * limit / size
        return ax, ay
