"""How a trial is flown, as ``dry-run``, ``fly`` and ``bench`` share it."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from crazyarena.runner.trial.control_loop import LatePolicy
    from crazyarena.runner.trial.options import FlightOptions


class LateChoice(StrEnum):
    """:class:`~crazyarena.runner.trial.control_loop.LatePolicy`, without its imports."""

    HOLD = "hold"
    EXTRAPOLATE = "extrapolate"
    HOVER = "hover"

    @property
    def policy(self) -> LatePolicy:
        from crazyarena.runner.trial.control_loop import LatePolicy

        return LatePolicy(self.value)


Compute = Annotated[
    str | None,
    typer.Option(
        metavar="measured|free|fixed=MS",
        help="What thinking costs on the simulated clock. Default: measured on arena levels, "
        "free on others. free and fixed repeat to the bit.",
    ),
]
ComputeFactor = Annotated[
    float, typer.Option(help="How many times slower than this one the flight machine is.")
]
Late = Annotated[
    LateChoice,
    typer.Option(help="What the vehicle hears at a tick whose command is late."),
]
MaxMisses = Annotated[
    int, typer.Option(min=1, help="Missed ticks in a row after which the contestant is out.")
]
StepLimit = Annotated[
    float,
    typer.Option(
        metavar="S",
        help="Wall time of one answer, s, where thinking is free or fixed.",
    ),
]
EpisodeLimit = Annotated[
    float, typer.Option(metavar="S", help="Wall time of all answers of an episode, s.")
]
TrialLimit = Annotated[
    float, typer.Option(metavar="S", help="Wall time of all answers and hooks of a trial, s.")
]
RequireSandbox = Annotated[
    bool, typer.Option("--require-sandbox", help="Refuse to fly without a full sandbox.")
]
Sandbox = Annotated[
    bool | None,
    typer.Option(
        "--sandbox/--no-sandbox",
        help="Run the submission in a process of its own. Default: on arena levels only.",
    ),
]


def flight_options(
    compute: Compute = None,
    compute_factor: ComputeFactor = 1.0,
    late: Late = LateChoice.HOLD,
    max_misses: MaxMisses = 15,
    step_limit: StepLimit = 30.0,
    episode_limit: EpisodeLimit = 600.0,
    trial_limit: TrialLimit = 3600.0,
    require_sandbox: RequireSandbox = False,
) -> FlightOptions:
    """A group of options: deadlines, the cost of thinking, the contestant's process."""
    from crazyarena.runner.contestant.compute import Budget
    from crazyarena.runner.trial.options import FlightOptions

    return FlightOptions(
        budget=Budget(step_limit, episode_limit, trial_limit),
        require_sandbox=require_sandbox,
        compute=compute,
        factor=compute_factor,
        late=late.policy,
        max_misses=max_misses,
    )
