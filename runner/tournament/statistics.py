"""How sure one can be: intervals and paired comparisons of what teams have flown.

Wilson's score interval for shares (E. B. Wilson, 1927), the percentile bootstrap for medians (B.
Efron, 1979), McNemar's exact test for successes and Wilcoxon's signed-rank test for times on the
same draws.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

LEVEL = 0.95
"""Of all intervals."""
_RESAMPLES = 2000
_SEED = 20220101  # the same numbers from the same flights, whenever they are asked for
_FEWEST = 6  # pairs: with fewer no signed-rank test can tell anything at the 5 % level


def success_interval(successes: int, flown: int) -> tuple[float, float] | None:
    """Wilson's interval of a success rate; None where nothing was flown."""
    if flown == 0:
        return None
    interval = stats.binomtest(successes, flown).proportion_ci(LEVEL, method="wilson")
    return float(interval.low), float(interval.high)


def median_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Bootstrap interval of a median; None for fewer than two values."""
    if len(values) < 2:
        return None
    rng = np.random.default_rng(_SEED)
    sample = np.array(values, float)
    drawn = np.median(rng.choice(sample, (_RESAMPLES, len(sample))), axis=1)
    tail = 50.0 * (1.0 - LEVEL)
    low, high = np.percentile(drawn, [tail, 100.0 - tail])
    return float(low), float(high)


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two teams on the draws that both have flown.

    Attributes
    ----------
    pairs: draws. only_first, only_second: in which one alone succeeded.
    success_p: McNemar's exact test. both: draws in which both succeeded.
    difference: median of first minus second time on those, s, with its interval; None without.
    time_p: Wilcoxon's test; None with too few.
    better: ``first``, ``second``, or None: not distinguishable.
    """

    pairs: int
    only_first: int
    only_second: int
    success_p: float
    both: int
    difference: float | None
    interval: tuple[float, float] | None
    time_p: float | None
    better: str | None

    @property
    def words(self) -> str:
        """In one line."""
        if self.pairs == 0:
            return "no draws in common"
        if self.better is None:
            return f"not distinguishable on {self.pairs} draws"
        more = self.only_first if self.better == "first" else self.only_second
        less = self.only_second if self.better == "first" else self.only_first
        if self.success_p < 1.0 - LEVEL:
            return f"succeeds more often: {more} draws against {less} (p = {self.success_p:.3g})"
        assert self.difference is not None
        assert self.time_p is not None
        return f"faster by {abs(self.difference):.2f} s in the median (p = {self.time_p:.3g})"


Key = tuple[str, int]
"""Level and number of the draw."""


def compare(
    first: Mapping[Key, Mapping[str, Any]], second: Mapping[Key, Mapping[str, Any]]
) -> Comparison:
    """Compare two teams on the same draws: successes first, then the times where both succeeded."""
    common = sorted(first.keys() & second.keys())
    won = [(bool(first[k]["clean"]), bool(second[k]["clean"])) for k in common]
    only_first = sum(a and not b for a, b in won)
    only_second = sum(b and not a for a, b in won)
    differing = only_first + only_second
    success_p = float(stats.binomtest(only_first, differing).pvalue) if differing else 1.0
    times = np.array(
        [
            first[k]["flight_time"] - second[k]["flight_time"]
            for k, (a, b) in zip(common, won, strict=True)
            if a and b
        ]
    )
    difference = float(np.median(times)) if len(times) else None
    interval = median_interval(list(times)) if len(times) else None
    time_p = None
    moved = times[np.abs(times) > 1e-9]
    if len(moved) >= _FEWEST:
        time_p = float(stats.wilcoxon(moved, method="auto").pvalue)
    elif len(times):
        time_p = 1.0
    better = None
    if success_p < 1.0 - LEVEL:
        better = "first" if only_first > only_second else "second"
    elif time_p is not None and time_p < 1.0 - LEVEL and difference:
        better = "first" if difference < 0.0 else "second"
    return Comparison(
        len(common),
        only_first,
        only_second,
        success_p,
        len(times),
        difference,
        interval,
        time_p,
        better,
    )
