"""Finds the backend that stands behind a script, by name and only when it is asked for.

The API knows no simulator: a backend is a factory named here as ``module:function`` and
imported at run time, so that a flight over the radio never loads a physics engine and the
dependencies keep pointing one way.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Protocol, runtime_checkable

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat.backend import Backend
from crazyarena.crazyswarm_compat.config import FleetConfig
from crazyarena.crazyswarm_compat.guard import FleetGuard
from crazyarena.errors import BackendError, InputError
from crazyarena.types import Vector


@dataclass(slots=True)
class SimOptions:
    """What a script may change while a simulation runs.

    disturbance: standard deviation of the velocity noise, m/s; max_velocity: clamp on the
    speed, m/s. Settled when a backend opens: downwash, whether vehicles push down on those below
    them; vehicle, the model of all of them, and vehicle_set, fields of it that differ.
    """

    disturbance: float = 0.0
    max_velocity: float = math.inf
    downwash: bool = False
    vehicle: str | None = None
    vehicle_set: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class IdealState:
    """Motion of one vehicle: pos m, vel m/s, acc m/s² (3,) world; yaw rad, not wrapped;
    omega (3,) rad/s body."""

    pos: Vector
    vel: Vector
    acc: Vector
    yaw: float
    omega: Vector


@runtime_checkable
class InspectableBackend(Backend, Protocol):
    """A simulation that shows more of a vehicle than a radio link could."""

    def state(self, vehicle: int) -> IdealState:
        """True motion."""
        ...

    def setpoint(self, vehicle: int) -> IdealState:
        """Setpoint of the latest tick."""
        ...

    def mode(self, vehicle: int) -> int:
        """Flight mode, 0..5: idle, high-level, full state, position, velocity, hover."""
        ...

    def planner(self, vehicle: int) -> Any:
        """Planner of the high-level commander, as in the firmware bindings."""
        ...


class BackendFactory(Protocol):
    """Signature of the functions named in :data:`ENTRIES`."""

    def __call__(self, fleet: FleetConfig, clock: Clock, options: SimOptions) -> Backend: ...


class GuardFactory(Protocol):
    """Signature of the function named in :data:`GUARD`; ``arena`` is what ``--guard`` says."""

    def __call__(
        self,
        arena: str,
        fleet: FleetConfig,
        link: Backend,
        clock: Clock,
        options: SimOptions | None = None,
    ) -> FleetGuard: ...


ENTRIES: dict[str, str] = {
    "ideal": "crazyarena.sim_backend.ideal_backend:open_ideal",
    "sim": "crazyarena.sim_backend.swarm_backend:open_arena",
    "pybullet": "crazyarena.sim_backend.swarm_backend:open_pybullet",
    "radio": "crazyarena.crazyswarm_compat.radio:open_radio",
}
# The firmware's planner by the names of its Python bindings, for scripts that plan by themselves.
BINDINGS = "crazyarena.sim_backend.bindings"
# Motion capture for scripts that fly real vehicles.
POSE_PARTS = {
    "open_source": "crazyarena.mocap.opening:open_source",
    "PoseEstimator": "crazyarena.mocap.estimator:PoseEstimator",
    "PoseForwarder": "crazyarena.mocap.forwarder:PoseForwarder",
    "PosePipeline": "crazyarena.mocap.pipeline:PosePipeline",
}
# The arena's safety around a fleet; called as GuardFactory below.
GUARD = "crazyarena.runner.rig.guarded:open_guard"
# What looks at vehicles that nobody guards.
LOOKOUT = "crazyarena.safety.lookout:open_lookout"
SIMULATED = frozenset({"ideal", "sim", "pybullet"})  # these run on a virtual clock


def open_backend(
    name: str, fleet: FleetConfig, clock: Clock, options: SimOptions | None = None
) -> Backend:
    """Open the backend ``name`` (a key of :data:`ENTRIES`) for a fleet.

    A simulated backend registers itself with the virtual ``clock``.

    Raises
    ------
    InputError
        for an unknown name.
    BackendError
        if this installation has no such backend, or it cannot be opened.
    """
    try:
        module_name, function = ENTRIES[name].split(":")
    except KeyError:
        raise InputError(
            f"--backend: found {name!r}; expected one of {', '.join(sorted(ENTRIES))}"
        ) from None
    try:
        module = importlib.import_module(module_name)
        factory: BackendFactory = getattr(module, function)
    except (ModuleNotFoundError, AttributeError) as error:
        raise BackendError(
            f"backend {name!r}: {ENTRIES[name]} is not part of this installation ({error})"
        ) from error
    return factory(fleet, clock, options or SimOptions())


def open_guard(
    arena: str,
    fleet: FleetConfig,
    link: Backend,
    clock: Clock,
    options: SimOptions | None = None,
) -> FleetGuard:
    """Put the safety around an open ``link``; raises InputError for a wrong ``arena``."""
    module, function = GUARD.split(":")
    factory: GuardFactory = getattr(importlib.import_module(module), function)
    return factory(arena, fleet, link, clock, options)


def open_lookout(link: Backend, bodies: Mapping[str, int], clock: Clock) -> Any:
    """Watch whether the cameras' headings are the vehicles' (``bodies``: vehicle id by name)."""
    module, function = LOOKOUT.split(":")
    return getattr(importlib.import_module(module), function)(link, bodies, clock)


def pose_parts() -> dict[str, Any]:
    """Classes and functions of :data:`POSE_PARTS`, imported only now."""
    parts = {}
    for name, entry in POSE_PARTS.items():
        module, attribute = entry.split(":")
        parts[name] = getattr(importlib.import_module(module), attribute)
    return parts


def firmware_bindings() -> ModuleType:
    """Module :data:`BINDINGS`, imported only now."""
    return importlib.import_module(BINDINGS)
