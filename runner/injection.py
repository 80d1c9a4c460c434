"""Gate-pose injection as others see it: what the contestant was told of which gate, and when.

The decision is the referee's. This is its echo: every change goes into the recording and, where
a publisher is given, out over zenoh (keys in docs/trials.md):

* ``<prefix>/track``: the measured track, once an episode: ``{"gates": [[x, y, z, roll, pitch,
  yaw, type], ...], "obstacles": [...], "source": ...}``;
* ``<prefix>/gates/<i>``: every change of what is told of gate i (from 0): ``{"gate": i, "time":
  s, "in_range": bool, "pose": [6]}``.
"""

from __future__ import annotations

import json
from typing import Any, Protocol

from crazyarena.levels.schema import Level
from crazyarena.runner.crew import MeasuredTrack
from crazyarena.runner.recording import Recorder
from crazyarena.runner.referee import Verdict

DEFAULT_PREFIX = "crazyarena/trial"


class Outlet(Protocol):
    """Where JSON goes: a key and its value."""

    def put(self, key: str, value: dict[str, Any]) -> None: ...

    def close(self) -> None: ...


class ZenohOutlet:
    """Publishes JSON under ``<prefix>/<key>``; raises InputError for bad endpoints."""

    def __init__(self, prefix: str = DEFAULT_PREFIX, session: Any = None, **endpoints: Any) -> None:
        from crazyarena.mocap.zenoh_link import open_session

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
        self.reveals: list[dict[str, Any]] = []

    def begin(self, track: MeasuredTrack, level: Level, recorder: Recorder | None) -> None:
        """A new episode on this track."""
        self._recorder = recorder
        self._told = None
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
        if told == self._told:
            return
        self._told = told
        gate, in_range = told
        entry = {
            "gate": gate,
            "time": time,
            "in_range": in_range,
            "pose": [float(value) for value in verdict.info["current_target_gate_pos"]],
        }
        self.reveals.append(entry)
        if self._recorder is not None:
            what = "exact" if in_range else "nominal"
            self._recorder.event(
                time, round(time * 500), "gate told", f"gate {gate}: {what} {entry['pose']}"
            )
        if self._outlet is not None and gate >= 0:
            self._outlet.put(f"gates/{gate}", entry)
