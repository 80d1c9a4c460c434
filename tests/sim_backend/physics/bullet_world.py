"""A PyBullet world built from the numbers of the competition's assets: the measuring stick.

Dimensions are written out here, not imported, so that the tests compare two derivations.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

try:
    import pybullet
except ImportError:
    pybullet = None

LEVEL_GATES = [
    [0.5, -2.5, 0, 0, 0, -1.57, 0],
    [2.0, -1.5, 0, 0, 0, 0, 1],
    [0.0, 0.2, 0, 0, 0, 1.57, 1],
    [-0.5, 1.5, 0, 0, 0, 0, 0],
]
LEVEL_OBSTACLES = [
    [1.5, -2.5, 0, 0, 0, 0],
    [0.5, -1.0, 0, 0, 0, 0],
    [1.5, 0.0, 0, 0, 0, 0],
    [-1.0, 0.0, 0, 0, 0, 0],
]

_BEAMS = [
    ("0 0 0.225", '<box size="0.5 0.05 0.05"/>'),
    ("0 0 -0.225", '<box size="0.5 0.05 0.05"/>'),
    ("0.225 0 0", '<box size="0.05 0.05 0.5"/>'),
    ("-0.225 0 0", '<box size="0.05 0.05 0.5"/>'),
]
_STAND = '<box size="0.15 0.15 0.25"/>'
_POLE = '<cylinder radius="0.05" length="0.8"/>'
_SHAPES = {
    "vehicle": [("0 0 0", '<cylinder radius="0.06" length="0.025"/>')],
    "tall": [*_BEAMS, ("0 0 -0.6", _POLE)],
    "low": [*_BEAMS, ("0 0 -0.4", _STAND)],
    "obstacle": [("0 0 0", _POLE), ("0 0 -0.4", _STAND)],
    "ground": [("0 0 -5", '<box size="200 200 10"/>')],
}


def _urdf(name: str, mass: float) -> str:
    shapes = "".join(
        f'<collision><origin rpy="0 0 0" xyz="{at}"/><geometry>{shape}</geometry></collision>'
        for at, shape in _SHAPES[name]
    )
    friction = '<contact><lateral_friction value="1"/></contact>' if name == "ground" else ""
    return (
        f'<?xml version="1.0"?><robot name="{name}"><link name="base">{friction}<inertial>'
        f'<origin rpy="0 0 0" xyz="0 0 0"/><mass value="{mass}"/><inertia ixx="1.4e-5" ixy="0"'
        f' ixz="0" iyy="1.4e-5" iyz="0" izz="2.17e-5"/></inertial>{shapes}</link></robot>'
    )


class BulletWorld:
    """Ground, gates, obstacles and one vehicle in a PyBullet client of its own."""

    def __init__(self, folder: Path, gates, obstacles, *, ground=True, dt=0.002) -> None:
        self.client = pybullet.connect(pybullet.DIRECT)
        pybullet.setTimeStep(dt, physicsClientId=self.client)
        pybullet.setGravity(0, 0, -9.8, physicsClientId=self.client)
        self._folder = folder
        self.codes: dict[int, int] = {}
        for g, (x, y, _, r, p, yaw, kind) in enumerate(gates):
            name, z = ("tall", 1.0) if kind == 0 else ("low", 0.525)
            self.codes[self._load(name, 0.0, (x, y, z), (r, p, yaw))] = g
        for o, (x, y, _, r, p, yaw) in enumerate(obstacles):
            body = self._load("obstacle", 0.0, (x, y, 0.525), (r, p, yaw))
            self.codes[body] = len(gates) + o
        if ground:
            self.ground = self._load("ground", 0.0, (0, 0, 0), (0, 0, 0))
            self.codes[self.ground] = len(gates) + len(obstacles)
        self.bodies = {code: body for body, code in self.codes.items()}
        self.vehicle = self._load("vehicle", 0.03454, (0, 0, 5), (0, 0, 0))
        pybullet.changeDynamics(
            self.vehicle, -1, linearDamping=0, angularDamping=0, physicsClientId=self.client
        )

    def _load(self, name, mass, position, rpy) -> int:
        path = self._folder / f"{name}.urdf"
        path.write_text(_urdf(name, mass))
        return pybullet.loadURDF(
            str(path),
            position,
            pybullet.getQuaternionFromEuler(rpy),
            flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
            physicsClientId=self.client,
        )

    def close(self) -> None:
        pybullet.disconnect(self.client)

    def place(self, position, quaternion, velocity=(0, 0, 0), omega_world=(0, 0, 0)) -> None:
        at = {"physicsClientId": self.client}
        pybullet.resetBasePositionAndOrientation(self.vehicle, position, quaternion, **at)
        pybullet.resetBaseVelocity(self.vehicle, velocity, omega_world, **at)

    def step(self) -> None:
        pybullet.stepSimulation(physicsClientId=self.client)

    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        p, q = pybullet.getBasePositionAndOrientation(self.vehicle, physicsClientId=self.client)
        return np.array(p), np.array(q)

    def velocity(self) -> tuple[np.ndarray, np.ndarray]:
        v, w = pybullet.getBaseVelocity(self.vehicle, physicsClientId=self.client)
        return np.array(v), np.array(w)

    def detect(self) -> None:
        pybullet.performCollisionDetection(physicsClientId=self.client)

    def contact(self) -> int:
        """Contact code as the competition finds it: gates, obstacles, ground."""
        for code in sorted(self.bodies):
            if pybullet.getContactPoints(
                self.vehicle, self.bodies[code], physicsClientId=self.client
            ):
                return code
        return -1

    def closest(self, code: int, limit: float) -> float:
        points = pybullet.getClosestPoints(
            self.vehicle, self.bodies[code], limit, physicsClientId=self.client
        )
        return min((point[8] for point in points), default=limit)

    def ray_hits(self, starts, ends) -> list[int]:
        """Body hit by each ray with a fraction below 0.9999, or -1."""
        hits = pybullet.rayTestBatch(starts, ends, physicsClientId=self.client)
        return [hit[0] if hit[2] < 0.9999 else -1 for hit in hits]


def gate_rays(gate) -> tuple[list, list]:
    """The seven upright rays of a gate row."""
    x, y, _, _, _, yaw, kind = gate
    z = 1.0 if kind == 0 else 0.525
    direction = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    feet = [np.array([x, y, z]) + offset * direction for offset in np.arange(-3, 4) * 0.05]
    up = np.array([0.0, 0.0, 0.1875])
    return [list(foot - up) for foot in feet], [list(foot + up) for foot in feet]
