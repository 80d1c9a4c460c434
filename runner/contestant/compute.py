"""What a contestant's thinking costs, on whatever clock the trial runs.

On a wall clock an answer is there when it is there. On a virtual clock the answer is waited for
and then becomes due after the time it took (``measured``), after a set time (``fixed``), or at
once (``free``); the last two make a dry run repeatable to the bit.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Protocol

from crazyarena.clock import Clock, VirtualClock
from crazyarena.errors import InputError
from crazyarena.runner.contestant.dialogue import Answer, Contestant

MEASURED, FREE, FIXED = "measured", "free", "fixed"


@dataclass(frozen=True, slots=True)
class Budget:
    """Wall time that a contestant may take where a simulated clock does not bound it.

    step: s for one answer whose duration does not count; episode, trial: s in all answers of an
    episode, and in all answers and hooks of a trial.
    """

    step: float = 30.0
    episode: float = 600.0
    trial: float = 3600.0

    def check(self) -> None:
        """Raise InputError for limits of no time."""
        for name in ("step", "episode", "trial"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise InputError(f"--{name}-limit: found {value}; need seconds above 0")


@dataclass(frozen=True, slots=True)
class Compute:
    """How compute time is charged to a virtual clock.

    mode: ``measured``, ``free`` or ``fixed``; fixed: s per control step; factor: how much
    slower the flight machine is than this one; budget: of wall time.
    """

    mode: str = MEASURED
    fixed: float = 0.0
    factor: float = 1.0
    budget: Budget = Budget()

    @property
    def counts(self) -> bool:
        """Whether thinking costs any time on the clock."""
        return self.mode != FREE

    def cost(self, seconds: float) -> float:
        """What a step that took ``seconds`` is charged, s."""
        if self.mode == FREE:
            return 0.0
        return self.factor * (self.fixed if self.mode == FIXED else seconds)

    def __str__(self) -> str:
        text = f"fixed={self.fixed * 1e3:g}" if self.mode == FIXED else self.mode
        return text if self.factor == 1.0 else f"{text} x {self.factor:g}"


def parse_compute(text: str, factor: float = 1.0, budget: Budget | None = None) -> Compute:
    """Read ``measured``, ``free`` or ``fixed=MS``; raises InputError for anything else."""
    if not 0.0 < factor <= 1000.0:
        raise InputError(f"compute factor: found {factor}; need a number above 0 (up to 1000)")
    budget = budget or Budget()
    budget.check()
    if text in (MEASURED, FREE):
        return Compute(text, factor=factor, budget=budget)
    match = re.fullmatch(r"fixed=([0-9]*\.?[0-9]+)(ms)?", text)
    if match is None or float(match[1]) > 10_000.0:
        raise InputError(f"compute: found {text!r}; write measured, free or fixed=MS (fixed=5)")
    return Compute(FIXED, float(match[1]) * 1e-3, factor, budget)


class Waiter(Protocol):
    """Waits on the clock for the answer to the last question."""

    def asked(self, step: int) -> None:
        """A question was put to the contestant just now, of this control step."""
        ...

    def wait(self, deadline: float) -> Answer | None:
        """The answer once it is there, with the clock at that time; None at ``deadline``."""
        ...


class _WallWaiter:
    def __init__(self, contestant: Contestant, clock: Clock) -> None:
        self._contestant = contestant
        self._clock = clock

    def asked(self, step: int) -> None:
        return

    def wait(self, deadline: float) -> Answer | None:
        return self._contestant.wait(max(0.0, deadline - self._clock.now()))


class _VirtualWaiter:
    def __init__(
        self, contestant: Contestant, clock: VirtualClock, compute: Compute, patience: float
    ) -> None:
        self._contestant = contestant
        self._clock = clock
        self._compute = compute
        self._counted = compute.mode == MEASURED
        # s of wall time for one answer: on the clock nobody waits longer than patience.
        self._limit = patience / compute.factor if self._counted else compute.budget.step
        self._asked_at = 0.0
        self._answer: Answer | None = None
        self._ready = float("inf")

    def asked(self, step: int) -> None:
        self._asked_at = self._clock.now()
        limit = self._limit
        answer = self._contestant.wait(limit)
        if answer is None and not self._counted:
            text = f"step {step}: no answer within {limit:g} s of wall time"
            answer = Answer(step, None, text, limit, timed_out=True)
        self._answer = answer
        if answer is not None:
            late = answer.timed_out
            self._ready = self._asked_at + (0.0 if late else self._compute.cost(answer.seconds))

    def wait(self, deadline: float) -> Answer | None:
        if self._answer is None or self._ready > deadline:
            self._clock.sleep_until(deadline)
            return None
        if self._ready > self._asked_at:
            self._clock.sleep_until(self._ready)
        answer, self._answer = self._answer, None
        return answer


def make_waiter(contestant: Contestant, clock: Clock, compute: Compute, patience: float) -> Waiter:
    """Waiter for a clock; ``patience`` s is when a missing answer ends the run anyway."""
    if isinstance(clock, VirtualClock):
        return _VirtualWaiter(contestant, clock, compute, patience + 0.05)
    return _WallWaiter(contestant, clock)
