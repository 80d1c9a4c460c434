"""Values of a YAML document that know where they stand, for complaints that name the place."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from crazyarena.bounded_read import parse_yaml, read_text
from crazyarena.errors import InputError


class Node:
    """A value of a YAML document that knows where it stands."""

    def __init__(self, value: Any, source: str, path: str = "") -> None:
        self.value = value
        self.source = source
        self.path = path

    def fail(self, wanted: str) -> InputError:
        found = "nothing" if self.value is None else repr(self.value)
        if len(found) > 80:
            found = found[:77] + "..."
        where = f"{self.source}: {self.path}" if self.path else self.source
        return InputError(f"{where}: found {found}; expected {wanted}")

    def get(self, key: object) -> Node:
        """Child by key (or list index); its value is None when absent."""
        if isinstance(self.value, Mapping):
            child = self.value.get(key)
            path = f"{self.path}.{key}" if self.path else str(key)
        elif isinstance(self.value, list) and isinstance(key, int):
            child = self.value[key]
            path = f"{self.path}[{key}]"
        else:
            raise self.fail(f"a mapping with the key '{key}'")
        return Node(child, self.source, path)

    @property
    def absent(self) -> bool:
        return self.value is None

    def mapping(self) -> dict[str, Node]:
        if not isinstance(self.value, Mapping):
            raise self.fail("a mapping")
        return {str(key): self.get(key) for key in self.value}

    def mapping_or_empty(self) -> dict[str, Node]:
        return {} if self.absent else self.mapping()

    def items(self) -> list[Node]:
        if not isinstance(self.value, list):
            raise self.fail("a list")
        return [self.get(index) for index in range(len(self.value))]

    def number(self, default: float | None = None) -> float:
        if self.absent and default is not None:
            return default
        value = self.value
        if isinstance(value, str):
            # YAML 1.1 reads 1e-3 (no dot) as text; configuration files in the field rely on it.
            try:
                value = float(value)
            except ValueError:
                raise self.fail("a number") from None
        if isinstance(value, bool):
            value = float(value)
        if not isinstance(value, (int, float)) or not math.isfinite(value):
            raise self.fail("a finite number")
        return float(value)

    def integer(self, low: int, high: int) -> int:
        value = self.value
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.fail(f"a whole number {low}..{high}")
        return value

    def vector(self) -> tuple[float, float, float]:
        if not isinstance(self.value, list) or len(self.value) != 3:
            raise self.fail("three numbers [x, y, z] in metres")
        x, y, z = (item.number() for item in self.items())
        return x, y, z

    def text(self) -> str:
        if not isinstance(self.value, str) or not self.value:
            raise self.fail("a text")
        return self.value

    def flag(self, default: bool) -> bool:
        if self.absent:
            return default
        if not isinstance(self.value, bool):
            raise self.fail("true or false")
        return self.value


def load_yaml(given: str | os.PathLike[str], what: str) -> Node:
    """Read a ``.yaml`` path (or any path object), else take the text itself as YAML."""
    if isinstance(given, os.PathLike) or given.rstrip().endswith((".yaml", ".yml")):
        source, text = os.fspath(given), read_text(Path(given), what)
    else:
        source, text = f"{what} (given as text)", given
    value = parse_yaml(text, source)
    node = Node(value, source)
    if not isinstance(value, Mapping):
        raise node.fail(f"a mapping, as in a {what}")
    return node
