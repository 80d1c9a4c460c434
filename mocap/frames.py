"""Vendor axes, units and quaternion orders to ours, once, in named functions.

Ours: world x forward, y left, z up (right-handed), metres, quaternions x, y, z, w, body to
world. The ``motioncapture`` package already gives metres and named components.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from crazyarena.errors import InputError
from crazyarena.mocap.rotations import conjugate, multiply, rotate
from crazyarena.types import Pose, PoseFrame, Vector


def xyzw_from_wxyz(quaternion: Vector) -> Vector:
    """Reorder a scalar-first quaternion (Qualisys skeletons, Eigen constructors, ROS 1 tools)."""
    w, x, y, z = quaternion
    return np.array([x, y, z, w])


def metres_from_millimetres(position: Vector) -> Vector:
    """Vicon DataStream, Qualisys RT and NOKOV report millimetres."""
    return np.asarray(position, dtype=float) * 1e-3


def pose_from_y_up(pose: Pose) -> Pose:
    """A y-up world (OptiTrack Motive's default: x right, y up, z towards you) to z up.

    World axes turn by +90 degrees about x: (x, y, z) becomes (x, -z, y). Body axes turn with
    them, so a body at rest in Motive is at rest here.
    """
    return _turned_world(pose, _Y_UP)


def points_from_y_up(points: Vector) -> Vector:
    """Marker positions (n, 3) for :func:`pose_from_y_up`."""
    return rotate(_Y_UP, np.asarray(points, dtype=float))


def pose_to_y_up(pose: Pose) -> Pose:
    """Inverse of :func:`pose_from_y_up`."""
    return _turned_world(pose, conjugate(_Y_UP))


def points_to_y_up(points: Vector) -> Vector:
    """Inverse of :func:`points_from_y_up`."""
    return rotate(conjugate(_Y_UP), np.asarray(points, dtype=float))


def pose_from_z_up(pose: Pose) -> Pose:
    """Vicon, Qualisys and NOKOV set up as usual (z up, right-handed): nothing to do."""
    return pose


def points_from_z_up(points: Vector) -> Vector:
    """Marker positions for :func:`pose_from_z_up`."""
    return points


_HALF = float(np.sqrt(0.5))
_Y_UP = np.array([_HALF, 0.0, 0.0, _HALF])


def _turned_world(pose: Pose, turn: Vector) -> Pose:
    quaternion = multiply(multiply(turn, pose.quaternion), conjugate(turn))
    return Pose(rotate(turn, pose.position), quaternion)


_AXES: dict[str, tuple[Callable[[Pose], Pose], Callable[[Vector], Vector]]] = {
    "z-up": (pose_from_z_up, points_from_z_up),
    "y-up": (pose_from_y_up, points_from_y_up),
}


@dataclass(frozen=True)
class Convention:
    """How one camera system's frames become ours.

    Attributes
    ----------
    axes: ``z-up`` or ``y-up`` (see :func:`pose_from_y_up`).
    scale: metres per unit of the source; 1 through the ``motioncapture`` package.
    world: pose of the vendor's origin in our world.
    offsets: pose of the vehicle in the vendor's body frame, by body name: where the centre
        of the vehicle is as seen from the centre of its markers, and how it is turned.
    rename: vendor's body name to ours.
    """

    axes: str = "z-up"
    scale: float = 1.0
    world: Pose = field(default_factory=lambda: Pose(np.zeros(3)))
    offsets: Mapping[str, Pose] = field(default_factory=dict)
    rename: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.axes not in _AXES:
            raise InputError(f"mocap axes: found {self.axes!r}; choose {' or '.join(_AXES)}")
        if not self.scale > 0:
            raise InputError(f"mocap scale: found {self.scale}; need metres per unit above 0")

    def body(self, name: str, pose: Pose) -> Pose:
        """Convert one pose; ``name`` is the vendor's."""
        pose = _AXES[self.axes][0](Pose(pose.position * self.scale, pose.quaternion))
        world = self.world
        position = world.position + rotate(world.quaternion, pose.position)
        quaternion = multiply(world.quaternion, pose.quaternion)
        offset = self.offsets.get(name)
        if offset is not None:
            position = position + rotate(quaternion, offset.position)
            quaternion = multiply(quaternion, offset.quaternion)
        return Pose(position, quaternion / np.linalg.norm(quaternion))

    def points(self, points: Vector) -> Vector:
        """Convert marker positions (n, 3)."""
        turned = _AXES[self.axes][1](points * self.scale)
        return self.world.position + rotate(self.world.quaternion, turned)

    @property
    def is_identity(self) -> bool:
        return (
            self.axes == "z-up"
            and self.scale == 1.0
            and not self.offsets
            and not self.rename
            and not self.world.position.any()
            and bool((self.world.quaternion == [0.0, 0.0, 0.0, 1.0]).all())
        )

    def frame(self, frame: PoseFrame) -> PoseFrame:
        """Convert a whole frame."""
        if self.is_identity:
            return frame
        bodies = {
            self.rename.get(name, name): self.body(name, pose)
            for name, pose in frame.bodies.items()
        }
        markers = self.points(frame.markers) if len(frame.markers) else frame.markers
        return replace(frame, bodies=bodies, markers=markers)


def chosen_convention(convention: Convention | None, axes: str | None) -> Convention:
    """The convention that the options of a source name; raises InputError if both do."""
    if axes is None:
        return convention or Convention()
    if convention is not None:
        raise InputError("mocap axes: the convention has axes of its own; state one of them")
    return Convention(axes)
