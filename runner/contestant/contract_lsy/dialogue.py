"""What goes between the trial and a controller of lsy_drone_racing, a step at a time."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Observation = dict[str, Any]
Array = NDArray[np.float64]

EPISODE_HOOKS = ("episode_callback", "episode_reset")


@dataclass(slots=True)
class Told:
    """Arguments of ``step_callback`` after a step."""

    action: NDArray[np.float32]
    obs: Observation
    reward: float
    terminated: bool
    truncated: bool


@dataclass(slots=True)
class LsyQuestion:
    """One step: ``told`` of the step before comes first; ``ask`` whether a command is wanted if
    the controller has not finished with that; ``draw`` whether its drawings are."""

    step: int
    told: Told | None
    obs: Observation | None
    draw: bool = False


@dataclass(slots=True)
class Drawing:
    """Something drawn: ``line`` or ``points``, (n, 3) m, colour, size as given."""

    kind: str
    points: Array
    rgba: tuple[float, float, float, float]
    size: float


@dataclass(slots=True)
class LsyAnswer:
    """command: None if none was asked for, or the controller finished or failed; error: its
    traceback. timed_out: it did not come in the time allowed. seconds: of ``compute_control`` and
    of ``step_callback``, as measured where it is.
    """

    step: int
    command: Array | None = None
    finished: bool = False
    error: str | None = None
    command_seconds: float = 0.0
    callback_seconds: float = 0.0
    seconds: float = 0.0
    timed_out: bool = False
    drawings: list[Drawing] = field(default_factory=list)


class LsyContestant(Protocol):
    """A loaded controller. One question at a time."""

    digest: str
    description: dict[str, Any]

    def make(
        self, obs: Observation, config: dict[str, Any], info: dict[str, Any] | None = None
    ) -> None:
        """Construct the controller of an episode; raises InputError if that fails.

        info: what it is told with every observation; empty unless in a race.
        """
        ...

    def ask(self, question: LsyQuestion) -> LsyAnswer:
        """Put a question and wait for its answer."""
        ...

    def hook(self, name: str) -> tuple[float, str | None]:
        """Call one of :data:`EPISODE_HOOKS`; wall time in s, and the traceback if it raised."""
        ...

    def close(self) -> None:
        """Get rid of it; idempotent."""
        ...
