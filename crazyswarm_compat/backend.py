"""The vehicle link: the one interface behind which simulation and radio differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

from crazyarena.crazyswarm_compat.commands import Command
from crazyarena.types import Pose, Telemetry


@runtime_checkable
class Backend(Protocol):
    """Carries commands to one or many vehicles.

    ``send`` neither blocks nor raises for link trouble (that is reported by ``telemetry`` and
    events); it raises :class:`~crazyarena.errors.CommandError` for a command that no vehicle
    could execute, naming the vehicle and the field.
    """

    @property
    def vehicles(self) -> Sequence[int]:
        """Ids of the vehicles on this link, in the order of configuration."""
        ...

    def send(self, command: Command, vehicle: int | None = None) -> None:
        """Send to one vehicle, or broadcast with ``vehicle=None``."""
        ...

    def send_external_poses(self, poses: Mapping[int, Pose]) -> None:
        """Forward poses measured by a motion-capture system, keyed by vehicle id."""
        ...

    def telemetry(self, vehicle: int) -> Telemetry:
        """Return the last known health of a vehicle without waiting for it."""
        ...

    def get_param(self, vehicle: int, name: str) -> float:
        """Read a firmware parameter (``group.name``); raises BackendError if unknown."""
        ...

    def close(self) -> None:
        """Release the link; idempotent."""
        ...
