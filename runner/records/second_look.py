"""Does a recording bear out what was said of its flight? Asked in a process of its own.

A submission without a sandbox shares the judge's process and can write what the judge says. So what
was recorded is judged once more where the submission has never been. This finds results that were
forged without flying; who forges the recording as well is kept out by walls alone
(``--require-sandbox``).

Run as a module it reads JSON from standard input: ``level`` (YAML), and ``episodes`` with ``file``
and what was said of each (``_CLAIMS``, ``flight_time``); it answers with a list of what is not
borne out by episode, "" for nothing.
"""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from crazyarena.errors import CrazyarenaError
from crazyarena.levels import Level, dump_level, load_level
from crazyarena.runner.judging.referee import Referee
from crazyarena.runner.judging.result import EpisodeResult
from crazyarena.runner.records.export import read
from crazyarena.sim_backend.trace import TRACE_SIZE

_PATIENCE = 120.0  # s
_CLAIMS = ("completed", "gates_passed", "collisions", "violations")
# The last step's start is told, and the recording has the last tick, some of a step later.
_SAME_TIME = 0.25  # s


def judged_again(level: Level, file: Path) -> dict[str, Any]:
    """What the referee says of a recording.

    Raises
    ------
    InputError: the file is no recording, or is damaged.
    """
    recording = read(file)
    rows = np.ascontiguousarray(recording.tables["state"][:, :TRACE_SIZE])
    steps = recording.tables["referee"][:, 0]
    gates, obstacles = (json.loads(recording.metadata[k]) for k in ("gates", "obstacles"))
    referee = Referee(level)
    referee.begin(np.array(gates), np.array(obstacles))
    found: dict[str, Any] = {**dict.fromkeys(_CLAIMS, 0), "completed": False}
    found["flight_time"] = float(steps[-1]) if len(steps) else 0.0
    # The verdict of a control step is that of its last tick.
    ends = np.searchsorted(rows[:, 0], steps + 1e-9, side="right")
    for begin, end in itertools.pairwise([0, *ends.tolist()]):
        if end == begin:
            continue
        verdict = referee.judge(rows[begin:end])
        found["collisions"] += verdict.collided
        found["violations"] += verdict.violated
        found["completed"] = verdict.completed
        found["gates_passed"] += sum(e.name == "gate passed" for e in verdict.events)
    return found


def doubts(level_text: str, episodes: list[dict[str, Any]]) -> list[str]:
    """What of each episode its recording does not bear out, in words; "" for nothing.

    Asks a new process, which knows nothing of this one but what it is told.
    """
    question = json.dumps({"level": level_text, "episodes": episodes})
    command = [sys.executable, "-P", "-m", __spec__.name]  # nothing of the working folder
    try:
        asked = subprocess.run(
            command, input=question, capture_output=True, text=True, timeout=_PATIENCE, check=True
        )
        answer = json.loads(asked.stdout)
    except (OSError, subprocess.SubprocessError, ValueError) as error:
        return [f"its recording could not be judged again ({type(error).__name__})"] * len(episodes)
    return [str(text) for text in answer]


def _doubt(level: Level, episode: dict[str, Any]) -> str:
    try:
        found = judged_again(level, Path(episode["file"]))
    except (CrazyarenaError, KeyError, ValueError, IndexError) as error:
        return f"its recording cannot be judged again: {error}"
    wrong = [name for name in _CLAIMS if found[name] != episode[name]]
    if not abs(found["flight_time"] - episode["flight_time"]) <= _SAME_TIME:
        wrong.append("flight_time")
    return ", ".join(
        f"{name.replace('_', ' ')}: {episode[name]} said, {found[name]} recorded" for name in wrong
    )


def main() -> None:
    """Answer one question."""
    question = json.load(sys.stdin)
    with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
        file.write(question["level"])
        file.flush()
        level = load_level(file.name)
    print(json.dumps([_doubt(level, episode) for episode in question["episodes"]]))


def look_again(level: Level, folder: Path, recorded: list[EpisodeResult]) -> list[str]:
    """Note in episodes what their recordings do not bear out; returns it in words."""
    asked = [
        {
            "file": str(folder / episode.files["recording"]),
            "flight_time": float(episode.flight_time),
            "completed": bool(episode.completed),
            "gates_passed": int(episode.gates_passed),
            "collisions": int(episode.collisions),
            "violations": int(episode.violations),
        }
        for episode in recorded
    ]
    found = []
    for episode, doubt in zip(recorded, doubts(dump_level(level), asked), strict=True):
        episode.doubt = doubt
        if doubt:
            found.append(f"Episode {episode.index} is not borne out by its recording: {doubt}")
    return found


if __name__ == "__main__":
    main()
