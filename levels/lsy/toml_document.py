"""TOML read into nodes that know their line.

``tomllib`` does the reading; it gives values without places, so a scan over the lines finds where
tables and keys begin. What stands inside an array or an inline table has the line of its key.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from crazyarena.errors import InputError
from crazyarena.levels.document import MAX_DEPTH, MAX_NODES, Node, read_text

_HEADER = re.compile(r"^\s*(\[\[?)\s*([^\]]+?)\s*\]\]?\s*(?:#.*)?$")
_BARE = re.compile(r"\s*(?:\"((?:[^\"\\]|\\.)*)\"|'([^']*)'|([A-Za-z0-9_-]+))\s*")
Path_ = tuple[str | int, ...]


def read_toml(path: Path, shown: str) -> Node:
    """Read a TOML file; ``shown`` is its name in messages.

    Raises
    ------
    InputError: the file cannot be read, is no text, too large, or no valid TOML.
    """
    return parse_toml(read_text(path, shown), shown)


def parse_toml(text: str, source: str) -> Node:
    """Parse TOML text; ``source`` is its name in messages. Raises InputError if it is none."""
    try:
        values = tomllib.loads(text.replace("\r\n", "\n"))
    except (tomllib.TOMLDecodeError, ValueError) as error:
        raise InputError(f"{source}: no valid TOML: {error}") from error
    except RecursionError as error:
        raise InputError(
            f"{source}: expected at most {MAX_DEPTH} levels of nesting, found more"
        ) from error
    return _Builder(source, _lines(text)).build(values, "", (), 1)


class _Builder:
    def __init__(self, source: str, lines: dict[Path_, int]) -> None:
        self._source = source
        self._lines = lines
        self._count = 0

    def build(self, value: Any, path: str, keys: Path_, line: int) -> Node:
        line = self._lines.get(keys, line)
        here = Node(value, path, f"{self._source}:{line}")
        self._count += 1
        if self._count > MAX_NODES:
            here.fail(f"expected at most {MAX_NODES} values, found more")
        if len(keys) > MAX_DEPTH:
            here.fail(f"expected at most {MAX_DEPTH} levels of nesting, found more")
        if isinstance(value, dict):
            return Node(
                {k: self.build(v, here.child(k), (*keys, k), line) for k, v in value.items()},
                path,
                here.source,
            )
        if isinstance(value, list):
            items = [self.build(v, here.child(i), (*keys, i), line) for i, v in enumerate(value)]
            return Node(items, path, here.source)
        return here


def _names(text: str) -> tuple[list[str], int] | None:
    """Dotted key at the beginning of ``text`` and where it ends; None if there is none."""
    names: list[str] = []
    at = 0
    while match := _BARE.match(text, at):
        names.append(next(part for part in match.groups() if part is not None))
        at = match.end()
        if not text.startswith(".", at):
            return names, at
        at += 1
    return None


def _lines(text: str) -> dict[Path_, int]:
    """Line of every table and key of a valid document, by its path."""
    found: dict[Path_, int] = {}
    counts: dict[Path_, int] = {}
    table: Path_ = ()
    open_until = ""  # what a string or array over several lines waits for
    depth = 0
    for number, line in enumerate(text.split("\n"), 1):
        if open_until or depth:
            open_until, depth = _after(line, open_until, depth)
            continue
        header = _HEADER.match(line)
        if header and (read := _names(header[2])) is not None:
            table = _resolved(read[0][:-1], counts)
            table = (*table, read[0][-1])
            if header[1] == "[[":
                found.setdefault(table, number)
                counts[table] = counts.get(table, -1) + 1
                table = (*table, counts[table])
            found.setdefault(table, number)
            continue
        read = _names(line)
        if read is None or not line.startswith("=", read[1]):
            continue
        keys = table
        for name in read[0]:
            keys = (*keys, name)
            found.setdefault(keys, number)
        open_until, depth = _after(line[read[1] + 1 :], "", 0)
    return found


def _resolved(names: list[str], counts: dict[Path_, int]) -> Path_:
    """Path of a table's parents: below an array of tables stands its last member."""
    path: Path_ = ()
    for name in names:
        path = (*path, name)
        if path in counts:
            path = (*path, counts[path])
    return path


def _after(text: str, quote: str, depth: int) -> tuple[str, int]:
    """What is still open behind a line: the quote of a multi-line string, and brackets."""
    at = 0
    while at < len(text):
        if quote:
            if quote == '"""' and text[at] == "\\":
                at += 2
                continue
            if text.startswith(quote, at):
                at += len(quote)
                quote = ""
                continue
            at += 1
            continue
        char = text[at]
        if char == "#":
            break
        if text.startswith(('"""', "'''"), at):
            quote = text[at : at + 3]
            at += 3
            continue
        if char in "\"'":
            at += 1
            while at < len(text) and text[at] != char:
                at += 2 if char == '"' and text[at] == "\\" else 1
        elif char in "[{":
            depth += 1
        elif char in "]}":
            depth -= 1
        at += 1
    return quote, max(0, depth)
