"""What the operator of a flight reads, as HTML, from the facts a flight publishes.

Facts come from another process of the same user and hold words of contestants: everything is text.
"""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping
from typing import Any

GOOD, FAIR, BAD = "#1a7f37", "#b35900", "#c62828"
_SILENT = 1.0  # s without news after which nothing that is shown may be believed
_LOW = 3.3  # V under load
_EMPTY = 3.1


def number(value: Any, unit: str, digits: int = 2) -> str:
    """A number for people; a dash where nobody knows it."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return "–"
    return f"{value:.{digits}f} {unit}".strip()


def _graded(text: str, colour: str | None = None) -> str:
    style = f' style="color:{colour}"' if colour else ""
    return f"<b{style}>{html.escape(text)}</b>"


def grade(value: Any, fair: float, bad: float) -> str | None:
    """Colour of a value that is worse the smaller it is."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return BAD if value < bad else FAIR if value < fair else GOOD


def headline(facts: Mapping[str, Any], silent: float, over: bool) -> str:
    """Phase, time and whatever must not be overlooked; ``silent`` s without news."""
    phase = str(facts.get("phase") or "starting")
    parts = [
        f'<div style="font-size:1.35em;font-weight:bold" id="phase">{html.escape(phase)} '
        f"{number(facts.get('time'), 's', 1) if facts.get('time') is not None else ''}</div>"
    ]
    if over and phase != "over":
        parts.append(_banner("The flight's process has ended without a word.", BAD))
    elif not over and silent > _SILENT:
        parts.append(_banner(f"NO NEWS for {silent:.1f} s: nothing below is of now", BAD))
    if facts.get("taken"):
        parts.append(_banner(str(facts["taken"]), BAD))
    if facts.get("why"):
        parts.append(f'<div id="why">{html.escape(str(facts["why"]))}</div>')
    question = facts.get("question")
    if isinstance(question, Mapping):
        parts.append(_banner(str(question.get("text", "")), FAIR))
    return "".join(parts)


def _banner(text: str, colour: str) -> str:
    return (
        f'<div class="banner" style="background:{colour};color:white;padding:0.4em 0.6em;'
        f'margin:0.3em 0;border-radius:4px;font-weight:bold">{html.escape(text)}</div>'
    )


def rows(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Name and value (HTML) of everything that is known."""
    found: list[tuple[str, str]] = []

    def add(name: str, text: str, colour: str | None = None) -> None:
        found.append((name, _graded(text, colour)))

    if facts.get("episodes"):
        add("episode", f"{facts.get('episode', 0)} ({facts['episodes']} in all)")
    gate, gates = facts.get("gate"), facts.get("gates")
    if isinstance(gate, int) and isinstance(gates, int) and gates:
        exact = "exact" if facts.get("exact") else "nominal"
        add(
            "next gate", f"all {gates} passed" if gate < 0 else f"{gate} of 0–{gates - 1} ({exact})"
        )
    if "room" in facts:
        now, rest = facts["room"], facts.get("room_at_rest")
        add("to the fence", number(now, "m"), grade(now, 0.15, 0.0))
        if rest is not None:
            add("if it stopped now", number(rest, "m"), grade(rest, 0.1, 0.0))
        add("speed", number(facts.get("speed"), "m/s"))
    if "battery" in facts:
        add("battery", number(facts["battery"], "V"), grade(facts["battery"], _LOW, _EMPTY))
    if "link" in facts:
        share, heard = _scaled(facts["link"], 100.0), facts.get("heard")
        late = isinstance(heard, int | float) and heard > 0.5
        add(
            "link",
            f"{number(share, '%', 0)}, last heard {number(_scaled(heard, 1000.0), 'ms', 0)} ago",
            BAD if late else grade(share, 80.0, 50.0),
        )
    if "supervisor" in facts:
        told = facts["supervisor"]
        words = list(map(str, told)) if isinstance(told, list) and told else ["–"]
        bad = {"locked", "crashed", "tumbled"} & set(words)
        add("supervisor", ", ".join(words), BAD if bad else None)
    cameras = facts.get("cameras")
    if isinstance(cameras, Mapping):
        age = cameras.get("age")
        old = isinstance(age, int | float) and age > 0.1
        add(
            "cameras",
            f"{number(cameras.get('rate'), 'Hz', 0)}, frame "
            f"{number(_scaled(age, 1000.0), 'ms', 0)} old, {cameras.get('bodies', 0)} bodies",
            BAD if old else None,
        )
    if "ladder" in facts:
        ladder = str(facts["ladder"])
        colour = GOOD if ladder == "NONE" else FAIR if ladder == "WARN" else BAD
        add("watchdog", ladder.lower(), colour)
    if "missed" in facts:
        add("missed ticks", str(facts["missed"]), FAIR if facts["missed"] else None)
    if isinstance(facts.get("contacts"), int) and facts["contacts"]:
        add("contacts", str(facts["contacts"]), BAD)
    return found


def _scaled(value: Any, factor: float) -> float | None:
    return factor * value if isinstance(value, int | float) else None


def checklist(lines: Iterable[Any]) -> str:
    """The pre-flight check, red lines first with what to do about them."""
    told = []
    for line in lines:
        try:
            name, ok, found, remedy, waived = line
        except (TypeError, ValueError):
            continue
        mark, colour = ("✓", GOOD) if ok else ("waived", FAIR) if waived else ("✗", BAD)
        text = f'<span style="color:{colour}">{mark} {html.escape(str(name))}</span>'
        if not ok:
            text += f": {html.escape(str(found))}"
            if remedy:
                text += f" <i>({html.escape(str(remedy))})</i>"
        told.append((bool(ok), f"<div>{text}</div>"))
    told.sort(key=lambda entry: entry[0])
    body = "".join(text for _, text in told)
    return f'<div id="checklist"><b>Pre-flight</b>{body}</div>' if body else ""


def events(entries: Iterable[Any]) -> str:
    """What happened, newest first."""
    told = []
    for entry in entries:
        try:
            time, name, detail = entry
        except (TypeError, ValueError):
            continue
        when = f"{time:.2f} s " if isinstance(time, int | float) else ""
        told.append(f"<div>{when}<b>{html.escape(str(name))}</b> {html.escape(str(detail))}</div>")
    return f'<div id="events">{"".join(reversed(told))}</div>'


def page(facts: Mapping[str, Any], silent: float, over: bool) -> str:
    """Everything the operator reads."""
    cells = "".join(
        f"<tr><td>{html.escape(name)}&ensp;</td><td>{v}</td></tr>" for name, v in rows(facts)
    )
    return (
        '<div style="font-size:0.9em;padding:0.3em 1em">'
        f"{headline(facts, silent, over)}"
        f'<table style="margin:0.4em 0" id="facts">{cells}</table>'
        f"{events(facts.get('events') or ())}"
        f"{checklist(facts.get('checklist') or ())}</div>"
    )
