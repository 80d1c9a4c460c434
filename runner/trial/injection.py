"""Gate-pose injection as others see it: what the contestant was told of which gate, and when.

The decision is the referee's. This is its echo: every change goes into the recording and, where
a publisher is given, out over zenoh (keys in docs/trials.md):

* ``<prefix>/track``: the measured track, once an episode: ``{"gates": [[x, y, z, roll, pitch,
  yaw, type], ...], "obstacles": [...], "source": ...}``;
* ``<prefix>/gates/<i>``: every change of what is told of gate i (from 0): ``{"gate": i, "time":
  s, "in_range": bool, "pose": [6]}``;
* ``<prefix>/gates/<i>/measured``: where the cameras see gate i, if it may move: ``{"gate": i,
  "time": s, "pose": [6]}``.

Poses that change all the time go out ten times a second.
"""

from __future__ import annotations

import json
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from crazyarena.levels.schema import Level
from crazyarena.runner.judging.referee import Verdict
from crazyarena.runner.records.recorder import Recorder
from crazyarena.runner.trial.phase import MeasuredTrack

DEFAULT_PREFIX = "crazyarena/trial"
_PERIOD = 0.1  # s, between poses of one gate that moves


class Outlet(Protocol):
    """Where JSON goes: a key and its value."""

    def put(self, key: str, value: dict[str, Any]) -> None: ...

    def close(self) -> None: ...


class ZenohOutlet:
    """Publishes JSON under ``<prefix>/<key>``; raises InputError for bad endpoints."""

    def __init__(self, prefix: str = DEFAULT_PREFIX, session: Any = None, **endpoints: Any) -> None:
        from crazyarena.mocap.zenoh_session import open_session

        self._owns_session = session is None
        self._session = open_session(**endpoints) if session is None else session
        self._prefix = prefix

    def put(self, key: str, value: dict[str, Any]) -> None:
        import zenoh

        self._session.put(
            f"{self._prefix}/{key}",
            json.dumps(value).encode(),
            encoding=zenoh.Encoding.APPLICATION_JSON,
        )

    def close(self) -> None:
        if self._owns_session:
            self._session.close()


class Injection:
    """Follows the referee's verdicts of one trial."""

    def __init__(self, outlet: Outlet | None = None) -> None:
        self._outlet = outlet
        self._recorder: Recorder | None = None
        self._told: tuple[int, bool] | None = None
        self._tracked: tuple[int, ...] = ()
        self._published: dict[int, float] = {}
        self.reveals: list[dict[str, Any]] = []

    def begin(self, track: MeasuredTrack, level: Level, recorder: Recorder | None) -> None:
        """A new episode on this track."""
        self._recorder = recorder
        self._told = None
        self._tracked = level.track.tracked
        self._published = {}
        self.reveals = []
        if self._outlet is not None:
            self._outlet.put(
                "track",
                {
                    "level": level.name,
                    "gates": track.gates.tolist(),
                    "obstacles": track.obstacles.tolist(),
                    "source": track.source,
                },
            )

    def judged(self, verdict: Verdict, time: float) -> None:
        """Take note of what the next question will tell; ``time`` s since the start."""
        told = (verdict.gate, bool(verdict.info["current_target_gate_in_range"]))
        gate, in_range = told
        pose = [float(value) for value in verdict.info["current_target_gate_pos"]]
        news = told != self._told
        if not news:
            # The recording has what was told at every step; here the gist of it is enough.
            last = self.reveals[-1]
            if not in_range or gate not in self._tracked or pose == last["pose"]:
                return
            if time - last["time"] < _PERIOD - 1e-6:
                return
        self._told = told
        entry = {"gate": gate, "time": time, "in_range": in_range, "pose": pose}
        self.reveals.append(entry)
        if news and self._recorder is not None:
            what = "exact" if in_range else "nominal"
            self._recorder.event(
                time, round(time * 500), "gate told", f"gate {gate}: {what} {entry['pose']}"
            )
        if self._outlet is not None and gate >= 0:
            self._outlet.put(f"gates/{gate}", entry)

    def moved(self, gate: int, time: float, pose: NDArray[np.float64]) -> None:
        """Gate ``gate`` is seen at another place now: (6,) m, rad."""
        if self._outlet is None or time - self._published.get(gate, -1.0) < _PERIOD - 1e-6:
            return
        self._published[gate] = time
        self._outlet.put(
            f"gates/{gate}/measured", {"gate": gate, "time": time, "pose": pose.tolist()}
        )
