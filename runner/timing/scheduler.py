"""Control steps on absolute deadlines ``t0 + k / rate``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from crazyarena.clock import Clock
from crazyarena.runner.timing.rows import Rows
from crazyarena.runner.timing.wakeup import StampedClock


class Scheduler:
    """Waits for the start of each control step; never drifts, records how late it woke.

    A wake-up that is late by a whole period or more does not lead to a burst of steps: the
    missed ones are skipped and counted, and ``step`` stays the number of periods since the start.

    Attributes
    ----------
    skipped: steps that were skipped; skipped_own: those of them that would have been without what
        the machine is known to have caused.

    Parameters
    ----------
    clock: what time to wait for.
    rate: control steps per second, > 0.
    """

    def __init__(self, clock: Clock, rate: float) -> None:
        if not rate > 0:
            raise ValueError(f"rate is {rate}; expected more than 0 Hz")
        self._clock = clock
        self._rate = rate
        self._stamped = clock if isinstance(clock, StampedClock) else None
        self.start()

    def start(self) -> None:
        """Begin a new time line now: step 0 is due at once. Lateness records are dropped."""
        self.t0 = self._clock.now()
        self.step = 0
        self.skipped = self.skipped_own = 0
        # Late, by the machine, standstill.
        self._ticks = Rows(3, 1024)

    def deadline(self, step: int) -> float:
        """Time on the clock at which ``step`` is due, s."""
        return self.t0 + step / self._rate

    def wait(self) -> float:
        """Wait for the next step and return how late it starts (s)."""
        step = self.step + 1
        late = self._clock.sleep_until(self.deadline(step))
        machine = standstill = np.nan
        if self._stamped is not None:
            machine, standstill = self._stamped.machine_late, self._stamped.standstill
        missed = int(late * self._rate)
        if missed:
            step += missed
            self.skipped += missed
            self.skipped_own += missed if np.isnan(machine) else int((late - machine) * self._rate)
        self.step = step
        if self._stamped is not None:
            self._stamped.expect(self.deadline(step + 1))
        row = self._ticks.next()
        row[0] = late
        row[1] = machine
        row[2] = standstill
        return late

    @property
    def lateness(self) -> NDArray[np.float64]:
        """Lateness of every wake-up since :meth:`start`, s."""
        return self._ticks.rows[:, 0].copy()

    @property
    def shares(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lateness that the machine caused by waking us late, and what we added ourselves, s;
        of the steps that were slept for, on a clock that can tell."""
        late, machine, _ = self._ticks.rows.T
        known = ~np.isnan(machine)
        return machine[known], late[known] - machine[known]

    @property
    def standstill(self) -> NDArray[np.float64]:
        """How long after a deadline no processor was awake, s; of the same steps."""
        standstill = self._ticks.rows[:, 2]
        return standstill[~np.isnan(standstill)]
