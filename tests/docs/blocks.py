"""Fenced blocks of a page, in the order in which they stand there."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_FENCE = re.compile(r"^```(\w+)([^\n]*)\n(.*?)^```[ \t]*$", re.MULTILINE | re.DOTALL)
_OPTION = re.compile(r"""(\w+)=(?:"([^"]*)"|(\S+))""")


@dataclass(frozen=True)
class Block:
    """language; options behind it (``exit=1``, ``title="file"``) and marks (``no-run``); text;
    line in its page."""

    language: str
    options: dict[str, str]
    text: str
    line: int
    page: Path = field(compare=False)
    marks: frozenset[str] = frozenset()

    def __str__(self) -> str:
        return f"{self.page.name}:{self.line}"


def blocks(page: Path) -> Iterator[Block]:
    """All fenced blocks with a language."""
    text = page.read_text(encoding="utf-8")
    for match in _FENCE.finditer(text):
        options = {m[1]: m[2] if m[2] is not None else m[3] for m in _OPTION.finditer(match[2])}
        line = text.count("\n", 0, match.start()) + 1
        marks = frozenset(_OPTION.sub("", match[2]).split())
        yield Block(match[1], options, match[3], line, page, marks)


def shell(text: str, folder: Path, timeout: float = 500.0) -> subprocess.CompletedProcess[str]:
    """Run a block as it stands; ``crazyarena``, ``python`` and ``pip`` are those of the tests."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    # Of a name of its own: sockets are made in it, and their paths end at 107 bytes.
    with tempfile.TemporaryDirectory(prefix="blk") as runtime:
        return subprocess.run(
            ["bash", "-e", "-u", "-o", "pipefail", "-c", text], cwd=folder, timeout=timeout,
            env={**os.environ, "PATH": path, "CRAZYARENA_RUNTIME_DIR": runtime},
            stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False,
        )  # fmt: skip
