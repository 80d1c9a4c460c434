"""A block of episodes, flown where the work is done: one team, one level, one controller.

What a worker is sent (:class:`Order`) and what it gives back (:class:`Flown`) is plain data. The
flight is that of ``crazyarena dry-run --draw``, always behind walls.
"""

from __future__ import annotations

import io
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from crazyarena.errors import InputError
from crazyarena.levels.draw_file import LoadedDraw, read_draw
from crazyarena.levels.lsy import LsyLevel
from crazyarena.levels.schema import Level
from crazyarena.plain_text import shown
from crazyarena.runner.contestant.compute import Budget
from crazyarena.runner.contestant.sandbox.process import SandboxError
from crazyarena.runner.dry_run import DryRun
from crazyarena.runner.judging.result import EpisodeResult
from crazyarena.runner.lsy_run import LsyRun
from crazyarena.runner.records.recorder import Recorder
from crazyarena.runner.trial.lsy_episode import LsyEpisodeResult
from crazyarena.runner.trial.options import FlightOptions
from crazyarena.sim_backend.trace import TR_POS

NOT_FLOWN = "NOT FLOWN"
SUBMISSION_ERROR = "SUBMISSION ERROR"
_MOST_TEXT = 4000  # characters of a contestant's traceback that are kept
_MOST_EVENTS = 100
_EVERY = 25  # ticks of 2 ms between points of a path, before those that say nothing are left out
_TOLERANCE = 0.02  # m
_ANSWERS = 12  # times the patience for one answer: all answers of an episode

Keep = Callable[[int, Recorder | None], None]
_one_at_a_time = threading.Lock()


@dataclass(frozen=True)
class Order:
    """What to fly.

    Attributes
    ----------
    key: of the block. team, level: keys. draws: numbers of its draws on the level, from 0.
    archive: SHA-256 of the submission's archive; place: where in it the submission is.
    contract: of the submission. draw_file: text of the draw file; toml: name and text of the level
    beside it, if there is one. record: write recordings. patience: s of wall time for an answer
    whose time does not count. parameters: told to the submission.
    """

    key: str
    team: str
    level: str
    draws: tuple[int, ...]
    archive: str
    place: str
    contract: str
    draw_file: str
    toml: tuple[str, str] | None = None
    record: bool = True
    patience: float = 10.0
    parameters: Mapping[str, object] = field(default_factory=dict)


@dataclass
class Flown:
    """Episodes as lines of the journal, recordings by number of the draw."""

    episodes: list[dict[str, Any]]
    recordings: dict[int, bytes]
    wall: float


class NoWalls(Exception):
    """This machine cannot put a contestant behind walls."""


def fly(order: Order, submission: Path) -> Flown:
    """Fly a block; whatever the submission does ends its own block alone.

    Raises
    ------
    NoWalls: files, network and other processes cannot be shut off here.
    """
    with _one_at_a_time:  # an interpreter that flies two would measure the one with the other
        started = time.perf_counter()
        noise = machine_noise()
        with tempfile.TemporaryDirectory(prefix="crazyarena-block-") as name:
            folder = Path(name)
            lines, recordings = _fly(order, submission, folder)
        wall = time.perf_counter() - started
    for index, line in enumerate(lines):
        for name in ("why", "error"):  # where it lay for the flight means nothing to anybody
            if line[name]:
                line[name] = line[name].replace(str(submission.parent), "").replace("//", "/")
        line |= {
            "key": f"{order.team}/{order.level}/{order.draws[index]}",
            "team": order.team,
            "level": order.level,
            "draw": order.draws[index],
            "block": order.key,
            "noise_ms": noise,
            "wall": wall / len(lines),
        }
    return Flown(lines, recordings, wall)


def _fly(
    order: Order, submission: Path, folder: Path
) -> tuple[list[dict[str, Any]], dict[int, bytes]]:
    (folder / "draw.yaml").write_text(order.draw_file, "utf-8")
    if order.toml is not None:
        (folder / order.toml[0]).write_text(order.toml[1], "utf-8")
    draw = read_draw(folder / "draw.yaml")
    flown: list[dict[str, Any]] = []
    out = folder / "out"
    out.mkdir()

    paths: dict[int, tuple[list[list[float]], list[float]]] = {}

    def keep(index: int, recorder: Recorder | None) -> None:
        positions = (
            np.empty((0, 3)) if recorder is None else recorder.states[:, TR_POS : TR_POS + 3]
        )
        if len(positions):
            last = [round(float(x), 3) for x in positions[-1]]
            paths[index] = thinned(np.vstack([positions[::_EVERY], positions[-1:]])), last

    trouble = None
    try:
        if isinstance(draw.level, LsyLevel):
            _fly_lsy(order, draw, submission, out, keep, flown)
        else:
            _fly_2022(order, draw, draw.level, submission, out, keep, flown)
    except SandboxError as error:
        raise NoWalls(str(error)) from None
    except InputError as error:
        trouble = _bounded(str(error))
    for index, line in enumerate(flown):
        line["path"], line["place"] = paths.get(index, ([], None))
    gates = (
        len(draw.level.env.track.gates)
        if isinstance(draw.level, LsyLevel)
        else len(draw.level.track.gates)
    )
    reason = SUBMISSION_ERROR if trouble and not flown else NOT_FLOWN
    for _ in range(len(flown), len(order.draws)):
        why = _last_line(trouble) if trouble else "the controller failed in an episode before"
        flown.append({**_nothing(gates), "outcome": reason, "why": why, "error": trouble})
    recordings = {}
    if order.record:
        for index, number in enumerate(order.draws):
            file = out / f"episode_{index:03d}.mcap"
            if file.is_file():
                recordings[number] = file.read_bytes()
    return flown, recordings


def _budget(order: Order) -> Budget:
    """Wall time of a contestant: who is slow all the time must not hold up the others either."""
    episode = _ANSWERS * order.patience
    return Budget(order.patience, episode, episode * len(order.draws))


def _fly_2022(
    order: Order,
    draw: LoadedDraw,
    level: Level,
    submission: Path,
    out: Path,
    keep: Keep,
    flown: list[dict[str, Any]],
) -> None:
    options = FlightOptions(
        sandbox=True,
        require_sandbox=True,
        compute=draw.file.compute,
        budget=_budget(order),
        parameters=order.parameters,
    )
    results: list[EpisodeResult] = []

    def told(result: EpisodeResult, recorder: Recorder | None, track: Any) -> None:
        results.append(result)
        keep(result.index, recorder)

    run = DryRun(
        submission,
        level,
        out=out,
        record=order.record,
        figure=False,
        console=Console(file=io.StringIO()),
        options=options,
        seeds=draw.seeds,
        on_episode=told,
    )
    try:
        results = run.run().episodes
    finally:
        # What was flown before a controller could not be made again counts.
        flown += map(_line_2022, results)


def _line_2022(result: EpisodeResult) -> dict[str, Any]:
    return {
        "outcome": result.termination,
        "why": result.why or _last_line(result.error) or result.termination,
        "clean": result.clean,
        "completed": result.completed,
        "flight_time": result.flight_time,
        "learning_time": result.interstep_learning_time + result.interepisode_learning_time,
        "gates_passed": result.gates_passed,
        "gates": result.gates,
        "collisions": result.collisions,
        "violations": result.violations,
        "gate_times": [round(t, 3) for t in result.gate_times],
        "compute_ms": {k: round(v, 4) for k, v in result.compute_ms.items()},
        "missed_ticks": result.missed_ticks,
        "events": [
            {"time": e.time, "event": e.name, "detail": e.detail}
            for e in list(result.events)[:_MOST_EVENTS]
        ],
        "error": _bounded(result.error),
        "path": [],
        "place": None,
    }


def _fly_lsy(
    order: Order,
    draw: LoadedDraw,
    submission: Path,
    out: Path,
    keep: Keep,
    flown: list[dict[str, Any]],
) -> None:
    assert isinstance(draw.level, LsyLevel)

    def told(result: LsyEpisodeResult, recorder: Recorder | None, track: Any) -> None:
        flown.append(_line_lsy(result))
        keep(result.index, recorder)

    LsyRun(
        submission,
        draw.level,
        out=out,
        record=order.record,
        sandbox=True,
        require_sandbox=True,
        console=Console(file=io.StringIO()),
        seeds=draw.seeds,
        parameters=order.parameters,
        budget=_budget(order),
        on_episode=told,
    ).run()


def _line_lsy(result: LsyEpisodeResult) -> dict[str, Any]:
    return {
        "outcome": result.termination,
        "why": _last_line(result.error) or result.termination,
        "clean": result.success,
        "completed": result.success,
        "flight_time": result.time,
        "learning_time": 0.0,
        "gates_passed": result.gates_passed,
        "gates": result.gates,
        "collisions": 0,
        "violations": 0,
        "gate_times": [round(t, 3) for t in result.gate_times],
        "compute_ms": {k: round(v, 4) for k, v in result.compute_ms.items()},
        "missed_ticks": 0,
        "events": [
            {"time": e.time, "event": e.name, "detail": e.detail}
            for e in result.events[:_MOST_EVENTS]
        ],
        "notes": result.notes[:20],
        "error": _bounded(result.error),
        "path": [],
        "place": None,
    }


def _nothing(gates: int) -> dict[str, Any]:
    """An episode that was not flown."""
    return {
        "clean": False,
        "completed": False,
        "flight_time": 0.0,
        "learning_time": 0.0,
        "gates_passed": 0,
        "gates": gates,
        "collisions": 0,
        "violations": 0,
        "gate_times": [],
        "compute_ms": {},
        "missed_ticks": 0,
        "events": [],
        "error": None,
        "path": [],
        "place": None,
    }


def _bounded(text: str | None) -> str | None:
    if text is None:
        return None
    text = shown(text)
    return text if len(text) <= _MOST_TEXT else f"... {text[-_MOST_TEXT:]}"


def _last_line(text: str | None) -> str:
    lines = [line.strip() for line in (text or "").splitlines() if line.strip()]
    return lines[-1][:300] if lines else ""


def thinned(points: NDArray[np.float64], tolerance: float = _TOLERANCE) -> list[list[float]]:
    """Points (n, 3) of a path, m, without those that lie within ``tolerance`` m of the line between
    their neighbours that stay (Ramer, Douglas and Peucker); rounded to 1 cm."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return []
    keep = np.zeros(len(points), bool)
    keep[[0, -1]] = True
    pending = [(0, len(points) - 1)]
    while pending:
        first, last = pending.pop()
        if last - first < 2:
            continue
        start, line = points[first], points[last] - points[first]
        inner = points[first + 1 : last] - start
        length = float(line @ line)
        along = np.clip(inner @ line / length, 0.0, 1.0) if length > 0.0 else np.zeros(len(inner))
        away = np.linalg.norm(inner - along[:, None] * line, axis=1)
        worst = int(np.argmax(away))
        if away[worst] > tolerance:
            middle = first + 1 + worst
            keep[middle] = True
            pending += [(first, middle), (middle, last)]
    return [[round(float(x), 2) for x in point] for point in points[keep]]


def machine_noise(repeats: int = 200) -> dict[str, float]:
    """How long the machine takes for a piece of work that is always the same: ms, percentiles.

    What compute times are worth: the p99 of a contestant that is below this p99 is the machine's.
    """
    seconds = np.empty(repeats)
    for index in range(repeats):
        started = time.perf_counter()
        total = 0
        for number in range(500):
            total += number * number
        seconds[index] = time.perf_counter() - started
    p50, p99 = np.percentile(seconds, [50, 99]) * 1e3
    return {
        "p50": round(float(p50), 4),
        "p99": round(float(p99), 4),
        "max": round(float(seconds.max()) * 1e3, 4),
    }
