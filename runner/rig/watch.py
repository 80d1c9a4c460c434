"""Who may take the vehicle from the contestant, be it here or in another process."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from crazyarena.runner.judging.referee import Event
from crazyarena.runner.rig.stops import StopOptions
from crazyarena.safety.estop import Hold
from crazyarena.safety.events import SafetyEvent
from crazyarena.safety.fence import Fence
from crazyarena.safety.limits import Limits


class Watch(Protocol):
    """Whoever may take the vehicle from the contestant during a run."""

    def begin(self) -> None:
        """The run begins now."""
        ...

    def answered(self) -> None:
        """The contestant has answered."""
        ...

    def late(self, seconds: float) -> None:
        """How late a tick began."""
        ...

    def verdict(self) -> str | None:
        """Why the run must end, or None; asked at every tick."""
        ...

    def hand_over(self, rule: str) -> None:
        """Take the vehicle, for the reason ``rule``."""
        ...

    def end(self) -> bool:
        """The run is over. True if the vehicle was taken; it is down then, or as good as."""
        ...

    def events(self) -> list[Event]:
        """What happened since the last call."""
        ...

    def stop(self, source: str, reason: str) -> None:
        """Stop the motors at once; any thread."""
        ...


class Guard(Watch, Protocol):
    """A watch with the sources of its emergency stop; ``fence`` is what it holds the vehicle to,
    ``limits`` what it trusts it with."""

    fence: Fence
    limits: Limits

    @property
    def ladder(self) -> str:
        """Where the watchdog's ladder stands, by name."""
        ...

    def record(self) -> list[SafetyEvent]:
        """Everything the watchdog has done so far."""
        ...

    def open_stops(self, options: StopOptions) -> tuple[list[str], Hold | None]:
        """Open sources of the emergency stop; the terminal's keys are another matter.

        Returns what is in force, in words, and what must be held, if anything.
        """
        ...

    def open_keys(self, options: StopOptions) -> Sequence[str]:
        """Let the terminal's keys stop, and be held for what must be held."""
        ...

    def close_keys(self) -> None:
        """Give the keys back; idempotent."""
        ...
