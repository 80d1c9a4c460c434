"""How a trial is flown, as chosen on the command line."""

from __future__ import annotations

from dataclasses import dataclass, field

from crazyarena.errors import InputError
from crazyarena.levels.schema import Level, Profile
from crazyarena.runner.contestant.compute import FREE, MEASURED, Compute, parse_compute
from crazyarena.runner.contestant.sandbox.limits import Limits
from crazyarena.runner.trial.control_loop import Deadlines, LatePolicy


@dataclass(frozen=True, slots=True)
class FlightOptions:
    """Choices that do not belong to the level.

    sandbox: the contestant in a process of its own; None: on arena levels, not on those of the
    competition profile. compute: ``measured``, ``free`` or ``fixed=MS``; None: measured on arena
    levels, free on the others. factor: how much slower the flight machine is.
    """

    sandbox: bool | None = None
    require_sandbox: bool = False
    compute: str | None = None
    factor: float = 1.0
    late: LatePolicy = LatePolicy.HOLD
    max_misses: int = 15
    limits: Limits = field(default_factory=Limits)

    def check(self) -> None:
        """Raise InputError for what contradicts itself."""
        if self.require_sandbox and self.sandbox is False:
            raise InputError("--require-sandbox and --no-sandbox exclude each other")
        if self.max_misses < 1:
            raise InputError(f"max misses: found {self.max_misses}; need 1 or more")
        if self.compute is not None:
            parse_compute(self.compute, self.factor)

    def deadlines(self, level: Level) -> Deadlines:
        """Deadlines for a level."""
        default = MEASURED if level.profile is Profile.ARENA else FREE
        compute: Compute = parse_compute(self.compute or default, self.factor)
        return Deadlines(self.late, self.max_misses, compute)
