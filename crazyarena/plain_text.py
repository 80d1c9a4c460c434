"""Text of strangers, made fit to be shown: a contestant's words, names, messages from a socket.

A terminal obeys control characters, a figure or a page what looks like markup, an encoder chokes
on lone surrogates, and a reader is fooled by letters that turn the direction of writing. All of
them are shown as their escapes (``\\x1b``, ``\\u202e``, ``\\ud800``) instead.
"""

from __future__ import annotations

import re
import unicodedata
from typing import Any

_KEPT = "\n\t"
_UNNAMED = re.compile(r"[^\w.+-]+")
# What may have to be escaped at all; almost all text holds nothing of it.
_ODD = re.compile(r"[^\x20-\x7e\n\t]")
# Control, format (directions of writing, zero width), surrogates, private use, unassigned, and
# the separators that end a line where nobody expects it.
_HIDDEN = frozenset(("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"))


def shown(text: str, limit: int | None = None) -> str:
    """Return ``text`` with nothing in it that does more than be read; lines stay lines.

    ``limit``: characters, of which the end is kept, as of a traceback. Idempotent.
    """
    if limit is not None and len(text) > limit:
        text = "[...] " + text[-limit:]
    return _ODD.sub(_escaped, text)


def shown_line(text: str, limit: int = 200) -> str:
    """As :func:`shown`, on one line, of which the beginning is kept."""
    if len(text) > limit:
        text = text[:limit] + " [...]"
    return _ODD.sub(_escaped, text).replace("\n", "\\n").replace("\t", "\\t")


def file_name(text: str, limit: int = 64) -> str:
    """As a part of a file's name that no shell, terminal or file system reads as anything else."""
    name = _UNNAMED.sub("_", text)[:limit].lstrip("_.-")
    return name or "unnamed"


def shown_in(value: Any) -> Any:
    """Plain data (of JSON) with every text in it as :func:`shown`."""
    if isinstance(value, str):
        return shown(value)
    if isinstance(value, dict):
        return {shown_in(key): shown_in(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [shown_in(entry) for entry in value]
    return value


def unmarked(text: str) -> str:
    """As :func:`shown_line`, for matplotlib, which reads what stands between dollars as a formula.

    Terminals with markup of their own are told ``markup=False``, or get ``rich.text.Text``.
    """
    return shown_line(text).replace("$", r"\$")


def _escaped(match: re.Match[str]) -> str:
    letter = match[0]
    if letter in _KEPT or unicodedata.category(letter) not in _HIDDEN:
        return letter
    code = ord(letter)
    return (
        f"\\x{code:02x}"
        if code < 0x100
        else f"\\u{code:04x}"
        if code < 1 << 16
        else (f"\\U{code:08x}")
    )
