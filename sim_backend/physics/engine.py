"""Physics engines: one interface, several ways to move the vehicles.

:class:`NativeEngine` is the compiled default; ``pybullet_engine.PyBulletEngine`` has the same
interface and serves as a second opinion, with a window and camera images.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazyarena.errors import InputError
from crazyarena.jit import kernel
from crazyarena.sim_backend.physics.competition_step import (
    B_OMEGA,
    B_POS,
    B_QUAT,
    B_VEL,
    BODY_SIZE,
)
from crazyarena.sim_backend.physics.contact import resolve
from crazyarena.sim_backend.physics.fleet import downwash, vehicle_contacts
from crazyarena.sim_backend.physics.geometry import NO_CONTACT, forget, make_workspace
from crazyarena.sim_backend.physics.rigid_body import (
    FULL_PLANT_SIZE,
    P_GRAVITY,
    P_INERTIA,
    P_MASS,
    step,
)
from crazyarena.sim_backend.physics.scene import build_scene, ground_code


class Engine(Protocol):
    """Rigid-body world of n vehicles among static gates and obstacles.

    Attributes
    ----------
    dt: s per step.
    bodies: (n, BODY_SIZE) rows; position, velocity, attitude and rates are up to date after
        :meth:`reset` and :meth:`step` (B_POS, B_VEL, B_QUAT, B_OMEGA of ``competition_step``).
    contacts: (n,) contact code of the last step (``sim_backend/trace.py``), or NO_CONTACT.
    partners: (n,) index of another vehicle touched in the last step, or -1.
    """

    dt: float
    bodies: NDArray[np.float64]
    contacts: NDArray[np.int64]
    partners: NDArray[np.int64]

    def reset(
        self,
        positions: ArrayLike,
        quaternions: ArrayLike | None = None,
        velocities: ArrayLike | None = None,
        rates: ArrayLike | None = None,
    ) -> None:
        """Place all vehicles.

        positions (n, 3) m; quaternions (n, 4) x, y, z, w; velocities (n, 3) m/s, world;
        rates (n, 3) rad/s, body. What is not given is level, or zero.
        """

    def step(self, rotor_forces: ArrayLike, forces: ArrayLike | None = None) -> None:
        """Advance by ``dt``.

        rotor_forces (n, 4) N: front-left, back-left, back-right, front-right; forces (n, 3) N
        at the centres of mass, world frame.
        """

    def close(self) -> None:
        """Release what the engine holds; it cannot be used afterwards."""


def check_plants(plants: ArrayLike) -> NDArray[np.float64]:
    """(n, FULL_PLANT_SIZE) array of plant rows; one row alone counts as a fleet of one.

    Raises
    ------
    InputError: a wrong shape, or a mass or inertia that is not positive.
    """
    rows = np.atleast_2d(np.array(plants, dtype=np.float64))
    if rows.ndim != 2 or rows.shape[1] != FULL_PLANT_SIZE or len(rows) == 0:
        raise InputError(f"plants: expected (n, {FULL_PLANT_SIZE}) rows, found shape {rows.shape}")
    if not (rows[:, [P_MASS, P_INERTIA, P_INERTIA + 1, P_INERTIA + 2]] > 0.0).all():
        raise InputError("plants: mass and inertia must be positive")
    return rows


def place(
    engine: Engine,
    positions: ArrayLike,
    quaternions: ArrayLike | None,
    velocities: ArrayLike | None,
    rates: ArrayLike | None,
) -> None:
    """Write initial states into an engine's rows, which touch nothing; see :meth:`Engine.reset`."""
    bodies = engine.bodies
    bodies[:] = 0.0
    bodies[:, B_POS : B_POS + 3] = positions
    quaternion = np.broadcast_to(
        np.asarray([0.0, 0.0, 0.0, 1.0] if quaternions is None else quaternions, float),
        (len(bodies), 4),
    )
    norm = np.linalg.norm(quaternion, axis=1, keepdims=True)
    if not (norm > 1e-6).all():
        raise InputError(f"quaternions: norm must not be zero, found {quaternion.tolist()}")
    bodies[:, B_QUAT : B_QUAT + 4] = quaternion / norm
    if velocities is not None:
        bodies[:, B_VEL : B_VEL + 3] = velocities
    if rates is not None:
        bodies[:, B_OMEGA : B_OMEGA + 3] = rates
    engine.contacts[:] = NO_CONTACT
    engine.partners[:] = -1


def lifts(plants: NDArray[np.float64], rotors: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) thrust over weight of vehicles with rotor forces (n, 4) N."""
    return rotors.sum(axis=1) / (plants[:, P_MASS] * plants[:, P_GRAVITY])


@kernel
def step_fleet(bodies, plants, rotor_forces, forces, scene, ground, dt, works, contacts):
    """One free-flight and contact step of every vehicle; rows of all arrays are vehicles."""
    for i in range(bodies.shape[0]):
        f = rotor_forces[i]
        x, y, z = forces[i, 0], forces[i, 1], forces[i, 2]
        body, plant = bodies[i], plants[i]
        step(body, plant, f[0], f[1], f[2], f[3], x, y, z, 0.0, 0.0, 0.0, dt)
        contacts[i] = resolve(body, plant, scene, ground, dt, works[i])


class NativeEngine:
    """The compiled engine: ``rigid_body``, ``contact`` and ``fleet`` put together.

    Parameters
    ----------
    plants: (n, FULL_PLANT_SIZE) rows, one a vehicle, e.g. ``rigid_body.plant_row(...)``.
    gates, obstacles: true poses, rows as for ``scene.build_scene``.
    dt: s per step; 1 or 2 ms.
    ground: False for a world without floor.
    wakes: True adds downwash between vehicles.

    Raises
    ------
    InputError: malformed rows.
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
    ) -> None:
        self.dt = dt
        self.plants = check_plants(plants)
        n = len(self.plants)
        self.scene = build_scene(gates, obstacles)
        self.bodies = np.zeros((n, BODY_SIZE))
        self.contacts = np.full(n, NO_CONTACT, dtype=np.int64)
        self.partners = np.full(n, -1, dtype=np.int64)
        self._ground = ground_code(self.scene) if ground else NO_CONTACT
        self._wakes = wakes
        self._works = np.array([make_workspace() for _ in range(n)])
        self._forces = np.zeros((n, 3))
        self.reset(np.zeros((n, 3)))

    def reset(
        self,
        positions: ArrayLike,
        quaternions: ArrayLike | None = None,
        velocities: ArrayLike | None = None,
        rates: ArrayLike | None = None,
    ) -> None:
        """See :meth:`Engine.reset`."""
        place(self, positions, quaternions, velocities, rates)
        for work in self._works:
            forget(work)

    def step(self, rotor_forces: ArrayLike, forces: ArrayLike | None = None) -> None:
        """See :meth:`Engine.step`."""
        n = len(self.bodies)
        rotors = np.ascontiguousarray(
            np.broadcast_to(np.asarray(rotor_forces, dtype=np.float64), (n, 4))
        )
        self._forces[:] = 0.0 if forces is None else forces
        if self._wakes:
            downwash(self.bodies, lifts(self.plants, rotors), self._forces)
        step_fleet(
            self.bodies,
            self.plants,
            rotors,
            self._forces,
            self.scene,
            self._ground,
            self.dt,
            self._works,
            self.contacts,
        )
        if n > 1:
            vehicle_contacts(self.bodies, self.plants, self.dt, self.partners, self._works[0])

    def close(self) -> None:
        """Nothing to release."""
