"""Gates that move during a run, followed by the cameras.

Their bodies go through an estimator of their own (filter, outlier and swap rejection, the same
as the vehicles') with the temper of furniture instead of aircraft. A gate that is lost stays where
it was last seen.
"""

from __future__ import annotations

import math
import threading
from collections import deque

import numpy as np
from numpy.typing import NDArray

from crazyarena.levels.schema import Level
from crazyarena.mocap.estimator import EstimatorConfig, FrameResult, Freshness, PoseEstimator
from crazyarena.mocap.events import EventKind, MocapEvent
from crazyarena.runner.judging.referee import Event
from crazyarena.runner.records.recorder import Recorder
from crazyarena.runner.records.scene import moved_gates
from crazyarena.runner.rig.rig import Rig
from crazyarena.runner.trial.injection import Injection
from crazyarena.runner.trial.tracked_world import heading_like
from crazyarena.types import PoseFrame, VehicleState

Array = NDArray[np.float64]

# A person or a motor moves a gate; what accelerates it more than that is an error of measurement.
GATE_BODIES = EstimatorConfig(
    jerk=0.5,
    angular_jerk=0.3,
    max_acceleration=10.0,
    jump_gate=0.05,
    jump_limit=0.2,
    flip_gate=0.3,
    max_angular_acceleration=30.0,
    flip_limit=0.6,
    max_tilt=0.35,
)
_MOVED, _TURNED = 2e-3, 5e-3  # m, rad: what counts as a change; less is noise
_SCENE_PERIOD = 0.1  # s, between updates for viewers

_WORDS = {
    EventKind.BODY_STALE: "gate lost",
    EventKind.BODY_RECOVERED: "gate seen again",
    EventKind.JUMP_REJECTED: "gate jump not believed",
    EventKind.FLIP_REJECTED: "gate jump not believed",
    EventKind.SWAP_CORRECTED: "gate name corrected",
}


class MovingGates:
    """Where the gates of a level are that are marked ``tracked``.

    Listens to the frames of ``rig``, in whatever thread they come. :meth:`begin` an episode with
    the surveyed track, :meth:`start` its run.

    Attributes
    ----------
    events: what was noted in the present run: losses, recoveries, jumps.
    """

    def __init__(self, level: Level, rig: Rig) -> None:
        self._clock = rig.clock
        self._arena = level.arena
        self._gate = {f"gate{i + 1}": i for i in level.track.tracked}
        self._estimator = PoseEstimator(tuple(self._gate), GATE_BODIES)
        self._lock = threading.Lock()
        self._table: Array | None = None
        self._coming: deque[tuple[float, Array]] = deque()
        self._epoch = math.inf
        self._noted: list[MocapEvent] = []
        self.events: list[Event] = []
        # Before the world that makes rows of the vehicle's poses: no row without its gates.
        rig.listeners.frames.insert(0, self._see)

    def begin(self, gates: Array) -> None:
        """An episode on a surveyed track, (n, 7) as the referee takes it."""
        with self._lock:
            for name in self._gate:
                self._estimator.reset(name)
            self._table = np.array(gates, dtype=np.float64)
            self._told = np.full_like(self._table, np.inf)
            self._shown = self._told.copy()
            self._shown_at = -math.inf
            self._outside: set[str] = set()
            self._epoch = math.inf
            self._noted.clear()
            self._coming.clear()
            self.events = []

    def start(self, epoch: float) -> None:
        """The run begins; times are counted from ``epoch``, s on the session clock."""
        with self._lock:
            assert self._table is not None, "begin() comes first"
            self._epoch = epoch
            self._now = self._table

    def at(self, time: float) -> Array:
        """(n, 7) at a time of the run, s, which never goes back; another array when a gate has
        moved. Before the run: as surveyed."""
        with self._lock:
            if self._epoch == math.inf:
                assert self._table is not None
                return self._table
            while self._coming and self._coming[0][0] - self._epoch <= time + 1e-9:
                self._now = self._coming.popleft()[1]
            return self._now

    def tell(self, time: float, recorder: Recorder | None, injection: Injection) -> None:
        """After every judgement: record and publish what has changed."""
        gates = self.at(time)
        with self._lock:
            noted = [*self._noted, *self._estimator.check(self._clock.now())]
            self._noted.clear()
        for told in noted:
            self._note(told, time, recorder)
        for i in self._changed(gates, self._told):
            self._told[i] = gates[i]
            injection.moved(i, time, gates[i, :6])
            if recorder is not None:
                recorder.gate(time, i, gates[i, :6])
        if recorder is not None and time - self._shown_at >= _SCENE_PERIOD:
            changed = self._changed(gates, self._shown)
            if changed:
                self._shown_at = time
                self._shown[changed] = gates[changed]
                recorder.scene(time, moved_gates(gates, changed, time))

    def _changed(self, gates: Array, before: Array) -> list[int]:
        """Which of the followed gates are somewhere else than in ``before``."""
        different = np.abs(gates - before)
        return [
            i
            for i in self._gate.values()
            if max(different[i, 0], different[i, 1]) > _MOVED or different[i, 5] > _TURNED
        ]

    def _note(self, told: MocapEvent, time: float, recorder: Recorder | None) -> None:
        name = _WORDS.get(told.kind)
        if name is None or told.body is None:
            return
        when = max(0.0, told.time - self._epoch)
        event = Event(name, round(when * 500), when, f"gate {self._gate[told.body]}")
        self.events.append(event)
        if recorder is not None:
            recorder.event(event.time, event.tick, event.name, event.detail)

    def _see(self, frame: PoseFrame, result: FrameResult) -> None:
        """For the pipeline."""
        with self._lock:
            if self._table is None:
                return
            running = self._epoch < math.inf
            events = self._estimator.update(frame).events
            if running:
                self._noted += events
            table: Array | None = None
            for name, estimate in self._estimator.estimates(frame.timestamp).items():
                if estimate.freshness in (Freshness.NEVER, Freshness.STALE):
                    continue
                if not self._is_inside(name, estimate.state, frame.received):
                    continue
                table = self._table.copy() if table is None else table
                _put(table[self._gate[name]], estimate.state)
            if table is not None:
                self._table = table
                if running:
                    self._coming.append((frame.timestamp, table))

    def _is_inside(self, name: str, state: VehicleState, time: float) -> bool:
        """A gate outside of the arena is none: it was taken away, or mistaken for another."""
        low, high = self._arena.low, self._arena.high
        x, y, _ = state.position.tolist()
        inside = low[0] <= x <= high[0] and low[1] <= y <= high[1]
        if inside:
            self._outside.discard(name)
        elif name not in self._outside:
            self._outside.add(name)
            self._noted.append(MocapEvent(time, EventKind.JUMP_REJECTED, name, "outside"))
        return inside


def _put(row: Array, state: VehicleState) -> None:
    """Move a gate's row; x, y and heading alone: it stands on the floor, and has no front."""
    row[:2] = state.position[:2]
    row[5] = heading_like(row[5], state.quaternion)
