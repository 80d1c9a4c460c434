"""Watches what a dongle carries, and lets log data give way before anything else has to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from crazyarena.crazyswarm_compat.radio.air_queue import Share
from crazyarena.crazyswarm_compat.radio.air_schedule import DongleStatistics

_PERIOD = 1.0  # s between looks
_FULL, _ROOMY = 0.85, 0.6  # share of the time that is not spent on packets with nothing to say
_BACK = 5  # looks in a row with room before the logs come back
_THINNED = 0.1  # share of the poses that newer ones replaced before they were sent
STEPS = (1, 2, 4)  # by which the rates of the log blocks are divided


@dataclass(frozen=True, slots=True)
class Verdict:
    """What changed: ``logs`` divided by ``divisor`` (1 as asked for), or ``poses`` of which the
    share ``fallen`` is not sent."""

    what: str
    divisor: int = 1
    fallen: float = 0.0


class AirWatch:
    """One dongle. Called from one thread.

    Parameters
    ----------
    statistics: of the dongle, as they grow.
    replaced: poses that were replaced in the queues of its vehicles so far.
    """

    def __init__(self, statistics: DongleStatistics, replaced: Callable[[], int]) -> None:
        self._statistics = statistics
        self._replaced = replaced
        self._next = -1.0
        self._step = 0
        self._room = 0
        self._thinned = False
        self._before = self._counts(0.0)

    @property
    def divisor(self) -> int:
        """By what the rates of the log blocks are divided now."""
        return STEPS[self._step]

    def _counts(self, now: float) -> tuple[float, float, int, int, int, int]:
        s = self._statistics
        total = sum(s.exchanges.values())
        polls = s.exchanges[Share.POLL]
        sent = s.exchanges[Share.POSE] + s.broadcasts
        return now, s.busy, total, polls, sent, s.overtaken + self._replaced()

    def look(self, now: float) -> list[Verdict]:
        """What has changed since the last look; looks once a second, whoever asks."""
        if now < self._next:
            return []
        self._next = now + _PERIOD
        before, self._before = self._before, self._counts(now)
        if before[0] <= 0.0:
            return []
        elapsed, busy, total, polls, sent, overtaken = (
            a - b for a, b in zip(self._before, before, strict=True)
        )
        verdicts = []
        idle = polls / total if total else 1.0
        if self._adjust((busy / elapsed) * (1.0 - idle)):
            verdicts.append(Verdict("logs", self.divisor))
        fallen = overtaken / (sent + overtaken) if sent + overtaken else 0.0
        if (fallen > _THINNED) != self._thinned:
            self._thinned = not self._thinned
            verdicts.append(Verdict("poses", fallen=fallen if self._thinned else 0.0))
        return verdicts

    def _adjust(self, load: float) -> bool:
        """Move the log rates by one step, if the load asks for it."""
        self._room = self._room + 1 if load < _ROOMY else 0
        if load > _FULL and self._step < len(STEPS) - 1:
            self._step += 1
        elif self._room >= _BACK and self._step > 0:
            self._step -= 1
            self._room = 0
        else:
            return False
        return True
