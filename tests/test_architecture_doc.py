"""The pictures of docs/architecture.md show the imports as they are."""

from __future__ import annotations

import re
from collections.abc import Callable

from tests.test_imports import EXCEPTIONS, ROOT, folder_of, graph, module_name, room_of

Edges = set[tuple[str, str]]


def drawn(number: int) -> Edges:
    """Arrows of one of the page's diagrams."""
    page = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    diagram = re.findall(r"```mermaid\n(.*?)```", page, re.DOTALL)[number]
    return {(a, b) for a, b in re.findall(r"^ *([\w.]+) --> ([\w.]+)$", diagram, re.MULTILINE)}


def arrows(place: Callable[[str], str | None]) -> Edges:
    """Imports between places, without those that follow from others."""
    exceptions = {(module_name(ROOT / file), folder) for file, folder in EXCEPTIONS}
    edges = {
        (a, b)
        for name, targets in graph().items()
        for target in targets
        if (a := place(name)) is not None
        and (b := place(target)) is not None
        and a != b
        and (name, b) not in exceptions
    }

    def reaches(start: str, end: str, left_out: tuple[str, str]) -> bool:
        seen, ahead = set(), [start]
        while ahead:
            here = ahead.pop()
            nexts = {b for a, b in edges if a == here and (a, b) != left_out} - seen
            seen |= nexts
            ahead += nexts
        return end in seen

    return {edge for edge in edges if not reaches(*edge, edge)}


def test_folders_are_drawn_as_they_import():
    assert drawn(0) == arrows(folder_of)


def test_rooms_of_the_runner_are_drawn_as_they_import():
    def room(name: str) -> str | None:
        found = room_of(name)
        return "runner" if found == "" else found

    assert drawn(1) == arrows(room)
