"""The report of a run: what became of it, every flight of note, checklist, provenance."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from crazyarena.bounded_read import read_json
from crazyarena.errors import InputError
from crazyarena.runner.records.bodies import gate_openings
from crazyarena.runner.records.compare import compare
from crazyarena.runner.records.pages.charts import Line, chart
from crazyarena.runner.records.pages.compare_page import comparison
from crazyarena.runner.records.pages.flown import Flown, NothingFlown, read_flown, scene
from crazyarena.runner.records.pages.page import folded, page, section, table, text, wide
from crazyarena.runner.records.pages.race import named, races

MOST_FLIGHTS = 16
"""That are shown in full: failures first; all are in the table."""
_MOST_EVENTS = 150
_MOST_ROWS = 2000


def run_page(run: Path, against: Path | None = None) -> str:
    """The page of a results folder; ``against``: another one to compare it with.

    Raises
    ------
    InputError: there is no ``result.json``, or it or a recording is none of ours.
    """
    file = run / "result.json"
    if not file.is_file():
        raise InputError(f"{run}: no result.json here. Pass the results folder of a run")
    document = read_json(file, "result")
    if not isinstance(document, dict):
        raise InputError(f"{file}: need a mapping")
    episodes = document.get("episodes")
    if not isinstance(episodes, list) or not all(isinstance(e, dict) for e in episodes):
        raise InputError(f"{file}: field episodes: need a list of mappings")
    origin = document.get("provenance")
    origin = origin if isinstance(origin, dict) else {}
    parts = [_lead(document, episodes), section("Episodes", _overview(episodes))]
    parts.append(races(episodes, [_recording(run, episode) for episode in episodes]))
    parts += _flights(run, episodes)
    if against is not None:
        found = compare([against], [run], (against.name, run.name))
        parts.append(section(f"Against {against.name}", comparison(found)))
    parts.append(_checklist(origin))
    parts.append(section("Provenance", _provenance(origin)))
    return page(f"{origin.get('level', 'flight')}: {run.resolve().name}", *parts)


def _good(episode: dict[str, Any]) -> bool:
    return bool(episode.get("clean", episode.get("success", False)))


def _why(episode: dict[str, Any]) -> str:
    return str(episode.get("why") or episode.get("termination", ""))


def _lead(document: dict[str, Any], episodes: Sequence[dict[str, Any]]) -> str:
    clean = sum(map(_good, episodes))
    told = f"{clean} of {len(episodes)} episodes clean."
    score = document.get("score")
    if isinstance(score, dict):
        a, b = score.get("A_flight_time"), score.get("B_total_time")
        if isinstance(a, int | float) and isinstance(b, int | float):
            told += f" Score: A {a:.3f} s (last flight), B {b:.3f} s (all flight and learning)."
    if not document.get("finished", True):
        told += " The run was not finished."
    if not document.get("isolated", False):
        told += " Not isolated: the submission could reach its judge."
    style = "good" if episodes and clean == len(episodes) else "bad"
    return f'<p class="lead {style}">{text(told)}</p>'


def _overview(episodes: Sequence[dict[str, Any]]) -> str:
    # Counted by the rules of 2022 only.
    counted = [name for name in ("collisions", "violations") if any(name in e for e in episodes)]
    rows = [
        (
            named(e, number),
            _why(e),
            _seconds(e.get("flight_time", e.get("time"))),
            f"{e.get('gates_passed', '?')}/{e.get('gates', '?')}",
            *(e.get(name) for name in counted),
        )
        for number, e in enumerate(episodes[:_MOST_ROWS])
    ]
    state = ["good" if _good(e) else "bad" for e in episodes]
    names = ("#", "outcome", "time s", "gates", *counted)
    return table(names, rows, state, "outcomes")


def _seconds(value: Any) -> str:
    return f"{value:.3f}" if isinstance(value, int | float) else "–"


def _flights(run: Path, episodes: Sequence[dict[str, Any]]) -> list[str]:
    order = sorted(range(len(episodes)), key=lambda i: (_good(episodes[i]), i))[:MOST_FLIGHTS]
    first = min(order, default=0) if all(map(_good, episodes)) else order[0] if order else 0
    parts = []
    for i in sorted(order):
        file = _recording(run, episodes[i])
        try:
            inner = "" if file is None else flight(read_flown(file))
        except NothingFlown:
            inner = "<p>Nothing was flown.</p>"
        inner += _details(episodes[i])
        parts.append(folded(f"Episode {named(episodes[i], i)}: {_why(episodes[i])}",
                            inner, shut=i != first))  # fmt: skip
    left = len(episodes) - len(order)
    if left:
        parts.append(f"<p>{left} more episodes are in the table above.</p>")
    return parts


def _recording(run: Path, episode: dict[str, Any]) -> Path | None:
    files = episode.get("files")
    name = files.get("recording") if isinstance(files, dict) else None
    # A name and no way: a result from elsewhere names nothing outside its folder.
    if not isinstance(name, str) or Path(name).name != name:
        return None
    file = run / name
    return file if file.is_file() else None


def flight(flown: Flown) -> str:
    """View, charts and events of one flight."""
    gates, time = flown.gate_times, flown.time
    told = [(m.time, "late" if m.kind == "late" else "mark", m.text) for m in flown.marks]
    parts = [scene([(flown, "c0")])]
    if not flown.complete:
        parts.append("<p>The recording was cut short.</p>")
    charts = []
    for i, axis in enumerate("xyz"):
        lines = [Line("flown", time, flown.position[:, i], "s0")]
        if np.isfinite(flown.setpoint).any():  # attitudes are no places
            lines.append(Line("commanded", time, flown.setpoint[:, i], "s4 dash"))
        openings = _openings(flown) if axis == "z" else ()
        charts.append(chart(f"{axis} [m]", lines, gates=gates, marks=told, openings=openings))
    speed = Line("speed", time, np.linalg.norm(flown.velocity, axis=1), "s2")
    charts.append(chart("[m/s]", [speed], gates=gates, marks=told))
    margins = [
        Line(f"{name} (least {far.min():.2f} m)", time, far, style)
        for (name, far), style in zip(flown.margins().items(), ("s1", "s3"), strict=False)
    ]
    if margins:
        charts.append(chart("[m]", margins, gates=gates, marks=told, limits=(-0.05, 1.0)))
    rows = [(f"{e['time']:.3f}", e["event"], e["detail"]) for e in flown.events]
    shown = table(("s", "event", ""), rows[:_MOST_EVENTS])
    if len(rows) > _MOST_EVENTS:
        shown += f"<p>{len(rows) - _MOST_EVENTS} more events are in the recording.</p>"
    return "".join([*parts, wide(*charts)]) + folded(f"{len(rows)} events", shown)


def _openings(flown: Flown) -> list[tuple[float, float, float]]:
    """Heights of the openings of the gates, at the times they were passed."""
    found = gate_openings(flown.entities)
    return [
        (when, float(centre[2]) - half, float(centre[2]) + half)
        for when, name in flown.passes
        if name in found
        for centre, half in (found[name],)
    ]


def _details(episode: dict[str, Any]) -> str:
    parts = []
    phases = episode.get("phases")
    if isinstance(phases, dict) and phases:
        parts.append(folded("Phases", table(("phase", "s"), list(phases.items()))))
    timing = [
        (name, *(entry.get(key) for key in ("p50", "p99", "max")))
        for name in ("compute_ms", "answer_ms", "late_ms")
        if isinstance(entry := episode.get(name), dict) and entry
    ]
    if timing:
        rows = [*timing, ("missed ticks", episode.get("missed_ticks"), "", "")]
        parts.append(folded("Timing", table(("ms", "median", "p99", "max"), rows)))
    if episode.get("error"):
        parts.append(folded("Error", f"<pre>{text(episode['error'])}</pre>", shut=False))
    return "".join(parts)


def _checklist(origin: dict[str, Any]) -> str:
    preflight = origin.get("preflight")
    checks = preflight.get("checks") if isinstance(preflight, dict) else None
    if not isinstance(checks, list) or not checks or not isinstance(checks[-1], list):
        return ""
    lines = [line for line in checks[-1] if isinstance(line, dict)]
    rows = [
        (
            line.get("name"),
            "waived" if line.get("waived") else "ok" if line.get("ok") else "NOT OK",
            line.get("found"),
            "" if line.get("ok") else line.get("remedy"),
        )
        for line in lines
    ]
    state = ["good" if line.get("ok") else "bad" for line in lines]
    return section("Checklist", table(("", "", "found", "remedy"), rows, state))


def _provenance(origin: dict[str, Any]) -> str:
    long = ("level_file", "vehicle_file", "preflight")
    rows = [(name, value) for name, value in origin.items() if name not in long]
    files = [
        folded(name.replace("_", " "), f"<pre>{text(origin[name])}</pre>")
        for name in long[:2]
        if origin.get(name)
    ]
    return (table((), rows, kind="facts") if rows else "") + "".join(files)


def bench_page(folder: Path) -> str:
    """The page of a bench: its flights beside the dry runs of the same draw."""
    flown, dry = (sorted(folder.glob(f"{kind}_[0-9]*")) for kind in ("bench", "dry"))
    told = [(run, *_told(run)) for run in (*flown, *dry)]
    good = [clean for run, clean, *_ in told if run in flown]
    style = "good" if good and all(good) else "bad"
    lead = f"{sum(good)} of {len(good)} bench flights clean"
    if dry:
        lead += f", {sum(clean for run, clean, *_ in told if run in dry)} of {len(dry)} dry runs"
    parts = [f'<p class="lead {style}">{lead}.</p>']
    names = ("run", "outcome", "time s", "gates", "missed ticks")
    rows = [(run.name, *row) for run, _, row, _ in told]
    state = ["good" if clean else "bad" for _, clean, *_ in told]
    parts.append(section("Flights", table(names, rows, state, "outcomes")))
    if flown and dry:
        try:
            found = comparison(compare(dry, flown, ("dry run", "bench")))
        except InputError as error:
            found = f"<p>Not compared: {text(error)}</p>"
        parts.append(section("Bench against dry run", found))
    for run, *_ in told[:MOST_FLIGHTS]:
        for file in sorted(run.glob("*.mcap"))[:1]:
            inner = flight(read_flown(file))
            parts.append(folded(run.name, inner, shut=run is not flown[0]))
    origin = next((origin for *_, origin in told if origin), {})
    parts += [_checklist(origin), section("Provenance", _provenance(origin))]
    return page(f"bench: {folder.resolve().name}", *parts)


def _told(run: Path) -> tuple[bool, tuple[Any, ...], dict[str, Any]]:
    """Whether the first episode of a run was clean, its row, and where the run comes from."""
    file = run / "result.json"
    document = read_json(file, "result") if file.is_file() else None
    episodes = document.get("episodes") if isinstance(document, dict) else None
    first = episodes[0] if isinstance(episodes, list) and episodes else None
    if not isinstance(document, dict) or not isinstance(first, dict):
        return False, ("no result", None, None, None), {}
    gates = f"{first.get('gates_passed', '?')}/{first.get('gates', '?')}"
    time = _seconds(first.get("flight_time", first.get("time")))
    origin = document.get("provenance")
    row = (_why(first), time, gates, first.get("missed_ticks"))
    return _good(first), row, origin if isinstance(origin, dict) else {}
