"""Races in a report: all drones of one in one view."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from crazyarena.runner.records.pages.flown import NothingFlown, read_flown, scene
from crazyarena.runner.records.pages.page import section, text

MOST_RACES = 6
"""That are shown in a view; all are in the table."""
_COLOURS = ("c0", "c2", "c4", "c3", "c1")


def named(episode: dict[str, Any], number: int) -> Any:
    """What an episode is called in tables: its number, in a race with the drone's."""
    index = episode.get("index", number)
    if "drone" not in episode:
        return index
    return f"{index}, drone {episode['drone']} ({episode.get('controller', '')})"


def races(episodes: Sequence[dict[str, Any]], files: Sequence[Path | None]) -> str:
    """A view for each race: the ways of all its drones; nothing where there are none.

    files: the recording of each episode, if it has one.
    """
    found: dict[str, list[tuple[dict[str, Any], Path]]] = {}
    for number, (episode, file) in enumerate(zip(episodes, files, strict=True)):
        if "drone" in episode and file is not None:
            found.setdefault(str(episode.get("index", number)), []).append((episode, file))
    parts = []
    for index, flights in list(found.items())[:MOST_RACES]:
        paths, told = [], []
        for number, (episode, file) in enumerate(flights):
            colour = _COLOURS[number % len(_COLOURS)]
            with contextlib.suppress(NothingFlown):
                paths.append((read_flown(file), colour))
            name = f"drone {episode['drone']} ({episode.get('controller', '')})"
            told.append(f'<span style="color:var(--{colour})">{text(name)}</span>')
        parts.append(f"<p>Race {text(index)}: {', '.join(told)}</p>{scene(paths)}")
    return section("Races", "".join(parts)) if parts else ""
