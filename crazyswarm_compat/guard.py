"""What a script sees of the safety around its fleet.

The API knows the guard by this interface only; what stands behind it is named in
:data:`.registry.GUARD` and imported when a script asks for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from crazyarena.crazyswarm_compat.backend import Backend
from crazyarena.errors import BackendError


class FlightEnded(BackendError):
    """The safety has taken a vehicle from the script: the watchdog or an emergency stop."""


class FleetGuard(Backend, Protocol):
    """A vehicle link behind the command gate, with a watchdog for every vehicle.

    ``send`` raises :class:`~crazyarena.errors.CommandError` for what the gate refuses and
    :class:`FlightEnded` for vehicles that are no longer the script's.
    """

    scene: dict[str, Any]
    """What of it a viewer can show, as plain data."""

    @property
    def events(self) -> Sequence[Any]:
        """What the safety has noticed and done so far, oldest first."""
        ...

    def check(self) -> None:
        """Warn of what has happened meanwhile; raises :class:`FlightEnded`, once for each
        vehicle that was taken from the script."""
        ...

    def on_frame(self, frame: Any, result: Any) -> None:
        """A pose frame has been through the estimator (real vehicles)."""
        ...

    def watch(self, estimate: Callable[[str], Any]) -> None:
        """Begin to watch in a thread, by the estimates of a running pose pipeline (real
        vehicles)."""
        ...

    def frozen(self) -> Sequence[str]:
        """Names of vehicles whose poses repeat to the bit, so that they get none."""
        ...

    def finish(self) -> None:
        """Land what still flies and wait for it; needs poses. Idempotent."""
        ...
