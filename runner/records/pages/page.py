"""The frame of a page: everything it needs is in it, and whatever it shows is escaped."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Iterable, Sequence
from importlib import resources
from typing import Any

from crazyarena.plain_text import shown

_MOST_TEXT = 4000  # characters of one cell


def text(value: Any) -> str:
    """Anything as text of a page: what strangers wrote is read, and never obeyed."""
    if isinstance(value, float):
        value = _number(value)
    elif isinstance(value, list | tuple) and value and all(isinstance(v, float) for v in value):
        value = ", ".join(map(_number, value))
    elif value is None:
        value = "–"
    elif isinstance(value, bool):
        value = "yes" if value else "no"
    elif isinstance(value, dict | list | tuple):
        value = json.dumps(value, ensure_ascii=False, default=str)
    return html.escape(shown(str(value), _MOST_TEXT))


def _number(value: float) -> str:
    if not math.isfinite(value):
        return "–"
    return "0" if abs(value) < 1e-12 else f"{value:.4g}"


def data(name: str, value: Any) -> str:
    """Plain data for the page's script; numbers that are none become null."""
    words = json.dumps(_finite(value), separators=(",", ":")).replace("<", "\\u003c")
    return f'<script type="application/json" class="{html.escape(name)}">{words}</script>'


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return value


def table(
    head: Sequence[str], rows: Iterable[Sequence[Any]], state: Sequence[str] = (), kind: str = ""
) -> str:
    """A table; ``state``: class of each row (``good``, ``bad`` or nothing); ``kind``: ``outcomes``
    or ``facts``, whose second column holds sentences or long words."""
    found = [f"<tr>{''.join(f'<th>{text(name)}</th>' for name in head)}</tr>"] if head else []
    for index, row in enumerate(rows):
        style = f' class="{state[index]}"' if index < len(state) and state[index] else ""
        found.append(f"<tr{style}>{''.join(f'<td>{text(cell)}</td>' for cell in row)}</tr>")
    return f'<div class="wide {kind}"><table>{"".join(found)}</table></div>'


def wide(*charts: str) -> str:
    """Charts, of which a narrow screen shows a part at a time: all of them the same part."""
    return f'<div class="wide charts"><div>{"".join(charts)}</div></div>' if charts else ""


def section(title: str, *parts: str) -> str:
    """A part of the page under a heading of its own; nothing if it is empty."""
    inner = "".join(parts)
    return f"<section><h2>{text(title)}</h2>{inner}</section>" if inner else ""


def folded(title: str, *parts: str, shut: bool = True) -> str:
    """Something that unfolds when its title is clicked."""
    state = "" if shut else " open"
    return f"<details{state}><summary>{text(title)}</summary>{''.join(parts)}</details>"


def page(title: str, *parts: str) -> str:
    """The whole page."""
    folder = resources.files(__package__)
    style, script = ((folder / name).read_text("utf-8") for name in ("page.css", "page.js"))
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        # Nothing is fetched, and nothing but the page's own script runs.
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; '
        "style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:\">"
        f"<title>{text(title)}</title><style>{style}</style></head><body>"
        f"<header><h1>{text(title)}</h1></header><main>{''.join(parts)}</main>"
        f"<script>{script}</script></body></html>\n"
    )
