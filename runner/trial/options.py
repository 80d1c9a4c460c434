"""How a trial is flown, as chosen on the command line."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field

from crazyarena.errors import InputError
from crazyarena.levels.schema import Level, Profile
from crazyarena.runner.contestant.compute import (
    FREE,
    MEASURED,
    Budget,
    Compute,
    parse_compute,
)
from crazyarena.runner.contestant.sandbox.limits import Limits
from crazyarena.runner.trial.control_loop import Deadlines, LatePolicy

_SECRET_BITS = 128


def secret_seed() -> int:
    """A seed that nobody can guess."""
    return secrets.randbits(_SECRET_BITS)


@dataclass(frozen=True, slots=True)
class FlightOptions:
    """Choices that do not belong to the level.

    sandbox: the contestant in a process of its own; None: on arena levels, not on those of the
    competition profile. secret: the level is drawn from a seed that nobody can guess. compute:
    ``measured``, ``free`` or ``fixed=MS``; None: measured on arena levels, free on the others.
    factor: how much slower the flight machine is. budget: wall time of steps, episodes and trials.
    parameters: told to the contestant, see :class:`.Sandboxed`.
    """

    sandbox: bool | None = None
    secret: bool = False
    require_sandbox: bool = False
    compute: str | None = None
    factor: float = 1.0
    budget: Budget = field(default_factory=Budget)
    late: LatePolicy = LatePolicy.HOLD
    max_misses: int = 15
    limits: Limits = field(default_factory=Limits)
    parameters: Mapping[str, object] = field(default_factory=dict)

    def check(self) -> None:
        """Raise InputError for what contradicts itself."""
        if self.require_sandbox and self.sandbox is False:
            raise InputError("--require-sandbox and --no-sandbox exclude each other")
        if self.secret and self.sandbox is False:
            raise InputError("--secret and --no-sandbox exclude each other: it would be no secret")
        if self.max_misses < 1:
            raise InputError(f"max misses: found {self.max_misses}; need 1 or more")
        self.budget.check()
        if self.compute is not None:
            parse_compute(self.compute, self.factor)

    def sandboxed(self, level: Level) -> bool:
        """Whether the contestant gets a process of its own."""
        if self.sandbox is not None:
            return self.sandbox
        return self.secret or self.require_sandbox or level.profile is Profile.ARENA

    def seed(self, given: int | None, level: Level) -> int:
        """What a level is drawn with.

        Raises
        ------
        InputError: one is given, and a secret one asked for.
        """
        if not self.secret:
            return level.seed if given is None else given
        if given is not None:
            raise InputError("--seed and --secret exclude each other")
        return secret_seed()

    def deadlines(self, level: Level) -> Deadlines:
        """Deadlines for a level."""
        default = MEASURED if level.profile is Profile.ARENA else FREE
        compute: Compute = parse_compute(self.compute or default, self.factor, self.budget)
        return Deadlines(self.late, self.max_misses, compute)
