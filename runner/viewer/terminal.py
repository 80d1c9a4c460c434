"""The operator's page in a terminal, for where there is no browser."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from html import unescape
from typing import Any

from rich.console import Group, RenderableType
from rich.live import Live as Screen
from rich.table import Table
from rich.text import Text

from crazyarena.clock import Clock, WallClock
from crazyarena.live import Watched
from crazyarena.plain_text import shown_line
from crazyarena.runner.viewer import operator_page as told

_STYLES = {told.GOOD: "green", told.FAIR: "yellow", told.BAD: "bold red"}
_SILENT = 1.0  # s
RATE = 5.0  # pictures a second


def _plain(cell: str) -> Text:
    """A cell of the page's table."""
    colour = re.search(r"color:(#\w+)", cell)
    words = unescape(re.sub(r"<[^>]*>", "", cell))
    return Text(shown_line(words), _STYLES.get(colour.group(1), "") if colour else "")


def picture(facts: Mapping[str, Any], silent: float, over: bool) -> RenderableType:
    """What the operator reads; ``silent`` s without news."""
    time = facts.get("time")
    when = f"  {time:.1f} s" if isinstance(time, int | float) else ""
    head = Text(f"{shown_line(str(facts.get('phase') or 'starting'))}{when}", "bold")
    parts: list[RenderableType] = [head]
    if not over and silent > _SILENT:
        parts.append(Text(f"NO NEWS for {silent:.1f} s: nothing below is of now", "bold red"))
    for name, style in (("taken", "bold red"), ("why", "")):
        if facts.get(name):
            parts.append(Text(str(facts[name]), style))
    question = facts.get("question")
    if isinstance(question, Mapping):
        parts.append(Text(str(question.get("text", "")), "bold yellow"))
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in told.rows(facts):
        table.add_row(name, _plain(value))
    parts.append(table)
    for line in facts.get("checklist") or ():
        name, ok, found, remedy, waived = line
        if not ok:
            mark = "waived" if waived else "x"
            text = f"{mark} {name}: {found}" + (f" ({remedy})" if remedy else "")
            parts.append(Text(shown_line(text), "yellow" if waived else "bold red"))
    for when, name, detail in reversed(facts.get("events") or []):
        stamp = f"{when:7.2f} s " if isinstance(when, int | float) else " " * 10
        parts.append(Text(shown_line(f"{stamp}{name} {detail}"), overflow="ellipsis", no_wrap=True))
    return Group(*parts)


def watch(watched: Watched, clock: Clock | None = None) -> None:
    """Show a flight until it is over; Ctrl-C ends that."""
    clock = clock if clock is not None else WallClock()
    version, facts, news = -1, {}, -math.inf
    with Screen(auto_refresh=False) as screen:
        while True:
            now, over = clock.now(), watched.over
            if watched.versions[1] != version:
                version = watched.versions[1]
                state = watched.state()
                if state is not None:
                    facts, news = state.facts, now
            screen.update(picture(facts, now - max(news, 0.0), over), refresh=True)
            if over:
                return
            clock.sleep_until(now + 1.0 / RATE)
