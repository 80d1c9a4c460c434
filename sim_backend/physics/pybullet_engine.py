"""The same world in PyBullet: a second opinion on physics, with a window and camera images.

PyBullet is imported when an engine is made, not before. The assets are URDF files written from
the dimensions in ``scene.py``.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazyarena.errors import DependencyMissing
from crazyarena.sim_backend.physics import scene as s
from crazyarena.sim_backend.physics import sizes
from crazyarena.sim_backend.physics.competition_step import (
    B_OMEGA,
    B_POS,
    B_QUAT,
    B_VEL,
    BODY_SIZE,
    P_INERTIA,
    P_MASS,
)
from crazyarena.sim_backend.physics.engine import check_plants, lifts, place
from crazyarena.sim_backend.physics.fleet import downwash
from crazyarena.sim_backend.physics.geometry import NO_CONTACT
from crazyarena.sim_backend.physics.rigid_body import (
    P_DRAG,
    P_GRAVITY,
    P_ROTOR_X,
    P_ROTOR_Y,
    P_YAW,
)

_ROTOR_SIGNS = ((1, 1), (-1, 1), (-1, -1), (1, -1))  # x, y of each rotor, in units of the offset
_ROTOR_SPIN = np.array([1.0, -1.0, 1.0, -1.0])
_CENTRE_LINK = 4
_COLOURS = {
    "gate": "0.9 0.45 0.1 1",
    "obstacle": "0.55 0.1 0.1 1",
    "vehicle": "0.1 0.1 0.1 1",
    "ground": "0.85 0.87 0.9 1",
}


def _box(x: float, y: float, z: float) -> str:
    return f'<box size="{x} {y} {z}"/>'


def _cylinder(radius: float, length: float) -> str:
    return f'<cylinder radius="{radius}" length="{length}"/>'


_BASE = ((0, 0, -sizes.BASE_DROP), _box(sizes.BASE_WIDTH, sizes.BASE_WIDTH, sizes.BASE_HEIGHT))
_LYING = _box(sizes.BEAM_LENGTH, sizes.BEAM_WIDTH, sizes.BEAM_WIDTH)
_STANDING = _box(sizes.BEAM_WIDTH, sizes.BEAM_WIDTH, sizes.BEAM_LENGTH)
_FRAME = (
    ((0, 0, sizes.BEAM_OFFSET), _LYING),
    ((0, 0, -sizes.BEAM_OFFSET), _LYING),
    ((sizes.BEAM_OFFSET, 0, 0), _STANDING),
    ((-sizes.BEAM_OFFSET, 0, 0), _STANDING),
)
_POST = ((0, 0, -sizes.POST_DROP), _cylinder(sizes.POST_RADIUS, sizes.POST_LENGTH))
_POLE = ((0, 0, 0), _cylinder(sizes.OBSTACLE_RADIUS, sizes.OBSTACLE_LENGTH))
_HULL = ((0, 0, 0), _cylinder(sizes.VEHICLE_RADIUS, 2 * sizes.VEHICLE_HALF_LENGTH))
_FLOOR = ((0, 0, -5), _box(200, 200, 10))


def _inertial(mass: float, inertia: Iterable[float]) -> str:
    x, y, z = inertia
    return (
        f'<inertial><mass value="{mass}"/><inertia ixx="{x}" iyy="{y}" izz="{z}"'
        ' ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def _static_urdf(kind: str, shapes: Iterable[tuple[Sequence[float], str]], friction: float) -> str:
    return (
        f'<?xml version="1.0"?><robot name="{kind}"><link name="base">'
        f'<contact><lateral_friction value="{friction}"/></contact>'
        f"{_inertial(0, (0, 0, 0))}{_solids(kind, shapes)}</link></robot>"
    )


def _solids(kind: str, shapes: Iterable[tuple[Sequence[float], str]]) -> str:
    parts = []
    for (x, y, z), shape in shapes:
        body = f'<origin xyz="{x} {y} {z}"/><geometry>{shape}</geometry>'
        colour = f'<material name="{kind}"><color rgba="{_COLOURS[kind]}"/></material>'
        parts.append(f"<collision>{body}</collision><visual>{body}{colour}</visual>")
    return "".join(parts)


def _vehicle_urdf(plant: NDArray[np.float64]) -> str:
    """A body with a link at each rotor and one at its centre, for forces in link frames."""
    x, y = plant[P_ROTOR_X], plant[P_ROTOR_Y]
    offsets = [(i * x, j * y) for i, j in _ROTOR_SIGNS] + [(0.0, 0.0)]
    links = "".join(
        f'<link name="l{k}">{_inertial(0, (0, 0, 0))}</link>'
        f'<joint name="j{k}" type="fixed"><parent link="base"/><child link="l{k}"/>'
        f'<origin xyz="{ox} {oy} 0"/></joint>'
        for k, (ox, oy) in enumerate(offsets)
    )
    inertial = _inertial(plant[P_MASS], plant[P_INERTIA : P_INERTIA + 3])
    return (
        '<?xml version="1.0"?><robot name="vehicle"><link name="base">'
        f"{inertial}{_solids('vehicle', [_HULL])}</link>{links}</robot>"
    )


class PyBulletEngine:
    """An :class:`~crazyarena.sim_backend.physics.engine.Engine` on PyBullet.

    Parameters
    ----------
    plants, gates, obstacles, dt, ground, wakes: as for ``engine.NativeEngine``; all plants must
        share one gravity, the first row's counts.
    gui: True opens PyBullet's window.
    link_frames: True applies rotor forces in link frames, as the 2022 competition did. PyBullet
        keeps those one step late, which shows in the flight (see ``competition_step.py``).
    """

    def __init__(
        self,
        plants: ArrayLike,
        gates: Sequence[Sequence[float]] = (),
        obstacles: Sequence[Sequence[float]] = (),
        dt: float = 0.001,
        *,
        ground: bool = True,
        wakes: bool = False,
        gui: bool = False,
        link_frames: bool = False,
    ) -> None:
        try:
            import pybullet
        except ImportError:
            raise DependencyMissing("pybullet", "pybullet", "the PyBullet engine") from None

        self._bullet: Any = pybullet
        self.dt = dt
        self.plants = check_plants(plants)
        self.scene = s.build_scene(gates, obstacles)
        n = len(self.plants)
        self.bodies = np.zeros((n, BODY_SIZE))
        self.contacts = np.full(n, NO_CONTACT, dtype=np.int64)
        self.partners = np.full(n, -1, dtype=np.int64)
        self._wakes = wakes
        self._link_frames = link_frames
        self._client = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        self._at = {"physicsClientId": self._client}
        pybullet.setTimeStep(dt, **self._at)
        pybullet.setGravity(0, 0, -self.plants[0, P_GRAVITY], **self._at)
        with tempfile.TemporaryDirectory() as folder:
            self._code_of = self._load_track(Path(folder), gates, obstacles, ground)
            self._vehicles = [
                self._load(Path(folder), _vehicle_urdf(plant), (0, 0, 0), (0, 0, 0))
                for plant in self.plants
            ]
        self._index_of = {body: i for i, body in enumerate(self._vehicles)}
        for body in self._vehicles:
            pybullet.changeDynamics(body, -1, linearDamping=0, angularDamping=0, **self._at)
        self.reset(np.zeros((n, 3)))

    def _load(self, folder: Path, urdf: str, position, rpy) -> int:
        # PyBullet caches files by name: every asset needs its own.
        path = folder / f"{len(list(folder.iterdir()))}.urdf"
        path.write_text(urdf)
        return self._bullet.loadURDF(
            str(path),
            position,
            self._bullet.getQuaternionFromEuler(rpy),
            flags=self._bullet.URDF_USE_INERTIA_FROM_FILE,
            **self._at,
        )

    def _load_track(self, folder: Path, gates, obstacles, ground: bool) -> dict[int, int]:
        """Contact code of every static body."""
        codes: dict[int, int] = {}
        for x, y, _, roll, pitch, yaw, kind in gates:
            shapes = (*_FRAME, _POST if kind == sizes.TALL else _BASE)
            urdf = _static_urdf("gate", shapes, 0.5)
            z = sizes.GATE_CENTRE_Z[int(kind)]
            codes[self._load(folder, urdf, (x, y, z), (roll, pitch, yaw))] = len(codes)
        for x, y, _, roll, pitch, yaw in obstacles:
            urdf = _static_urdf("obstacle", (_POLE, _BASE), 0.5)
            at = (x, y, sizes.OBSTACLE_CENTRE_Z)
            codes[self._load(folder, urdf, at, (roll, pitch, yaw))] = len(codes)
        if ground:
            urdf = _static_urdf("ground", (_FLOOR,), 1.0)
            codes[self._load(folder, urdf, (0, 0, 0), (0, 0, 0))] = len(codes)
        return codes

    def reset(
        self,
        positions: ArrayLike,
        quaternions: ArrayLike | None = None,
        velocities: ArrayLike | None = None,
        rates: ArrayLike | None = None,
    ) -> None:
        """See :meth:`Engine.reset`."""
        place(self, positions, quaternions, velocities, rates)
        for row, body in zip(self.bodies, self._vehicles, strict=True):
            quaternion = row[B_QUAT : B_QUAT + 4]
            self._bullet.resetBasePositionAndOrientation(
                body, row[B_POS : B_POS + 3], quaternion, **self._at
            )
            omega = self._rotation(quaternion) @ row[B_OMEGA : B_OMEGA + 3]
            self._bullet.resetBaseVelocity(body, row[B_VEL : B_VEL + 3], omega, **self._at)

    def step(self, rotor_forces: ArrayLike, forces: ArrayLike | None = None) -> None:
        """See :meth:`Engine.step`."""
        n = len(self.bodies)
        rotors = np.broadcast_to(np.asarray(rotor_forces, dtype=np.float64), (n, 4))
        others = np.zeros((n, 3))
        others[:] = 0.0 if forces is None else forces
        if self._wakes:
            downwash(self.bodies, lifts(self.plants, rotors), others)
        for i in range(n):
            self._push(i, rotors[i], others[i])
        self._bullet.stepSimulation(**self._at)
        for i in range(n):
            self._read(i)

    def _rotation(self, quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.reshape(self._bullet.getMatrixFromQuaternion(quaternion), (3, 3))

    def _push(self, i: int, rotors: NDArray[np.float64], other: NDArray[np.float64]) -> None:
        bullet, body, plant, row = self._bullet, self._vehicles[i], self.plants[i], self.bodies[i]
        position = row[B_POS : B_POS + 3]
        rotation = self._rotation(row[B_QUAT : B_QUAT + 4])
        drag = -rotation @ (plant[P_DRAG : P_DRAG + 3] * (rotation.T @ row[B_VEL : B_VEL + 3]))
        yaw = plant[P_YAW] * float(_ROTOR_SPIN @ rotors)
        link, world = bullet.LINK_FRAME, bullet.WORLD_FRAME
        if self._link_frames:
            for k in range(4):
                bullet.applyExternalForce(body, k, [0, 0, rotors[k]], [0, 0, 0], link, **self._at)
            bullet.applyExternalTorque(body, _CENTRE_LINK, [0, 0, yaw], link, **self._at)
            bullet.applyExternalForce(body, _CENTRE_LINK, other + drag, position, world, **self._at)
            return
        signs = np.array(_ROTOR_SIGNS)
        x, y = plant[P_ROTOR_X], plant[P_ROTOR_Y]
        torque = np.array([y * (signs[:, 1] @ rotors), -x * (signs[:, 0] @ rotors), yaw])
        force = rotation[:, 2] * rotors.sum() + drag + other
        bullet.applyExternalForce(body, -1, force, position, world, **self._at)
        bullet.applyExternalTorque(body, -1, rotation @ torque, world, **self._at)

    def _read(self, i: int) -> None:
        bullet, body, row = self._bullet, self._vehicles[i], self.bodies[i]
        position, quaternion = bullet.getBasePositionAndOrientation(body, **self._at)
        velocity, omega = bullet.getBaseVelocity(body, **self._at)
        row[B_POS : B_POS + 3] = position
        row[B_QUAT : B_QUAT + 4] = quaternion
        row[B_VEL : B_VEL + 3] = velocity
        row[B_OMEGA : B_OMEGA + 3] = self._rotation(quaternion).T @ omega
        # A contact names both bodies; the vehicle asked for comes first.
        touched = {point[2] for point in bullet.getContactPoints(body, **self._at)}
        codes = [self._code_of[other] for other in touched if other in self._code_of]
        self.contacts[i] = min(codes, default=NO_CONTACT)
        partners = [self._index_of[other] for other in touched if other in self._index_of]
        self.partners[i] = min(partners, default=-1)

    def image(
        self,
        eye: Sequence[float],
        target: Sequence[float],
        width: int = 640,
        height: int = 480,
        field_of_view: float = math.radians(60.0),
    ) -> NDArray[np.uint8]:
        """Camera picture (height, width, 3) from ``eye`` towards ``target`` (m, world).

        field_of_view: vertical, rad. Rendered in software: works without a display.
        """
        view = self._bullet.computeViewMatrix(eye, target, [0, 0, 1])
        lens = self._bullet.computeProjectionMatrixFOV(
            math.degrees(field_of_view), width / height, 0.02, 50.0
        )
        pixels = self._bullet.getCameraImage(
            width,
            height,
            view,
            lens,
            renderer=self._bullet.ER_TINY_RENDERER,
            **self._at,
        )[2]
        return np.reshape(np.asarray(pixels, dtype=np.uint8), (height, width, 4))[:, :, :3]

    def close(self) -> None:
        """Disconnect from PyBullet (and close its window)."""
        if self._client >= 0:
            self._bullet.disconnect(**self._at)
            self._client = -1
