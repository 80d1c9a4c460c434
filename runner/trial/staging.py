"""What surrounds the run of an episode; the trial itself is the same program everywhere.

:class:`Staging` is that of the 2022 competition's own simulation, where an episode is nothing but
its run. :class:`~crazyarena.runner.trial.arena_staging.ArenaStaging` brings a vehicle up and down.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from crazyarena.levels.draw import Draw
from crazyarena.levels.schema import Level
from crazyarena.runner.contestant.interrupt import Interrupt
from crazyarena.runner.judging.referee import Event, Verdict
from crazyarena.runner.judging.result import EpisodeResult
from crazyarena.runner.records.recorder import Recorder
from crazyarena.runner.rig.watch import Watch
from crazyarena.runner.trial.injection import Injection
from crazyarena.runner.trial.phase import MeasuredTrack


class Staging:
    """Nothing happens before or after a run.

    Parameters
    ----------
    injection: told of the track and of every verdict, and publishes them; None for nobody.

    Attributes
    ----------
    watch: may take the vehicle during a run; None if nobody watches.
    keep_alive: setpoints must be repeated while the contestant is silent.
    logs: the vehicle tells of itself, which is recorded.
    fresh: every episode begins with an observation of its own, not with the last one's.
    renews: every episode has a new vehicle, whatever became of the last.
    in_force: what was granted of real-time privileges.
    """

    watch: Watch | None = None
    keep_alive = False
    fresh = False
    renews = False
    logs = False

    def __init__(self, injection: Injection | None = None) -> None:
        self._injection = injection
        self.in_force: list[str] = []

    @contextlib.contextmanager
    def interruptible(self) -> Iterator[Interrupt]:
        """Ctrl-C during the trial."""
        with Interrupt() as interrupt:
            yield interrupt

    # Before the run

    def prepare(self, draw: Draw) -> MeasuredTrack:
        """The track that is flown; raises :class:`~.phase.Aborted`."""
        return MeasuredTrack(draw.gates, draw.obstacles, "drawn")

    def follow(self) -> Any:
        """What tells the referee of gates that move; None if none does."""
        return None

    def start(self, draw: Draw) -> np.ndarray:
        """(12,) state at the start, as far as anybody can know it."""
        return draw.start

    @contextlib.contextmanager
    def else_abort(self) -> Iterator[None]:
        """For what has to be there before the start: if it raises, the vehicle is disarmed."""
        yield

    def metadata(self, track: MeasuredTrack) -> dict[str, str]:
        """What a recording says of the staging."""
        return {} if self._injection is None else {"track_source": track.source}

    def announce(self, track: MeasuredTrack, level: Level, recorder: Recorder | None) -> None:
        """The track is known and the recording is open."""
        if self._injection is not None:
            self._injection.begin(track, level, recorder)

    @contextlib.contextmanager
    def on_stage(self) -> Iterator[None]:
        """Around launch, run and way home; raises :class:`~.phase.Aborted`."""
        yield

    # The run

    def begin(self) -> None:
        """The run begins now."""

    def judged(self, verdict: Verdict, time: float, recorder: Recorder | None) -> None:
        """Told of every verdict, at ``time`` s of the run."""
        if self._injection is not None:
            self._injection.judged(verdict, time)

    def failed(self) -> None:
        """The run was left by an exception."""

    # After the run

    def end(self, result: EpisodeResult, recorder: Recorder | None) -> None:
        """The run is over: get the vehicle home, and note what happened."""

    def finish(self, recorder: Recorder) -> None:
        """Close the recording."""
        recorder.close()

    @property
    def durations(self) -> dict[str, float]:
        """s by phase."""
        return {}

    @property
    def reveals(self) -> list[dict[str, Any]]:
        """What the contestant was told of which gate, and when."""
        return [] if self._injection is None else self._injection.reveals


def note(recorder: Recorder | None, result: EpisodeResult, event: Event) -> None:
    """Put an event into the result and, if there is one, into the recording."""
    result.events = [*result.events, event]
    if recorder is not None:
        recorder.event(event.time, event.tick, event.name, event.detail)
