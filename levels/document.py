"""YAML read into nodes that remember where they stand, so that errors can say so.

The dialect is that of PyYAML (YAML 1.1) with these differences: ``1e-6`` is a number, as its
writers mean it; a key may occur once; dates stay text; merge keys and tags such as
``!!python/object`` are refused; size, nesting and alias expansion are bounded.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import yaml

from crazyarena.errors import InputError

MAX_BYTES = 256 * 1024
MAX_NODES = 50_000
MAX_DEPTH = 32


@dataclass(frozen=True, slots=True)
class Node:
    """One value of a document.

    Attributes
    ----------
    value: text, number, bool, None, a list of nodes, or a dict of nodes by key.
    path: how a user would name it, e.g. ``track.gates[2].yaw``; empty for the whole document.
    source: the file or override it came from, with line and column where there are any.
    """

    value: Any
    path: str
    source: str

    def child(self, key: str | int) -> str:
        """Path of a member, present or not."""
        if isinstance(key, int):
            return f"{self.path}[{key}]"
        return f"{self.path}.{key}" if self.path else key

    def plain(self) -> Any:
        """The value with all nodes replaced by theirs; lists stay lists."""
        if isinstance(self.value, dict):
            return {key: node.plain() for key, node in self.value.items()}
        if isinstance(self.value, list):
            return [node.plain() for node in self.value]
        return self.value

    def fail(self, message: str, key: str | int | None = None) -> NoReturn:
        """Raise :class:`InputError` about this value, or about its (missing) member ``key``."""
        path = self.path if key is None else self.child(key)
        raise InputError(
            f"{self.source}: {path}: {message}" if path else f"{self.source}: {message}"
        )

    def expected(self, what: str) -> NoReturn:
        """Raise :class:`InputError` saying what was expected here and what was found."""
        self.fail(f"expected {what}, found {found(self.plain())}")


def found(value: Any) -> str:
    """Short description of a value for an error message."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "a mapping" if value else "an empty mapping"
    if isinstance(value, list | tuple):
        return f"a list of {len(value)}"
    try:
        text = repr(value)
    except ValueError:  # an integer with more digits than Python is willing to print
        return "a number with thousands of digits"
    return text if len(text) <= 60 else text[:57] + "..."


class _Loader(yaml.SafeLoader):
    """Composes nodes; adds numbers like ``1e-6`` and leaves dates alone."""


_Loader.yaml_implicit_resolvers = {
    first: [pair for pair in pairs if not pair[0].endswith((":timestamp", ":value"))]
    for first, pairs in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$"),
    list("-+.0123456789"),
)

_SCALARS = {f"tag:yaml.org,2002:{name}" for name in ("str", "int", "float", "bool", "null")}


def read_text(path: Path, shown: str) -> str:
    """Text of a file; ``shown`` is its name in messages.

    Raises
    ------
    InputError: the file cannot be read, is no text, or too large.
    """
    try:
        if not path.is_file():
            raise InputError(f"{shown}: expected a file, found a folder or device")
        with path.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(f"{shown}: cannot read the file: {reason}") from error
    if len(data) > MAX_BYTES:
        raise InputError(f"{shown}: expected at most {MAX_BYTES // 1024} KiB, found a larger file")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{shown}: expected UTF-8 text, found byte {error.start} to be something else"
        ) from error


def read(path: Path, shown: str) -> Node:
    """Read a YAML file; ``shown`` is its name in messages.

    Raises
    ------
    InputError: the file cannot be read, is no text, too large, or no valid YAML.
    """
    return parse(read_text(path, shown), shown)


def parse(text: str, source: str, *, lines: bool = True, path: str = "") -> Node:
    """Parse YAML text. ``lines`` False leaves line and column out of messages (for overrides).

    Raises
    ------
    InputError: the text is no valid YAML of the dialect above.
    """
    builder = _Builder(source, lines)
    try:
        loader = _Loader(text)
        try:
            root = loader.get_single_node()
            if root is None:
                return Node(None, path, builder.where(None))
            return builder.build(loader, root, path, 0)
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        problem = " ".join(part for part in (error.context, error.problem) if part)
        raise InputError(f"{builder.where(mark)}: no valid YAML: {problem}") from error
    except yaml.YAMLError as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{source}: no valid YAML: {reason}") from error
    except RecursionError as error:
        raise InputError(
            f"{source}: expected at most {MAX_DEPTH} levels of nesting, found more"
        ) from error


class _Builder:
    def __init__(self, source: str, lines: bool) -> None:
        self._source = source
        self._lines = lines
        self._count = 0

    def where(self, mark: Any) -> str:
        if mark is None or not self._lines:
            return self._source
        return f"{self._source}:{mark.line + 1}:{mark.column + 1}"

    def build(
        self, loader: _Loader, node: yaml.Node, path: str, depth: int, key: Any = None
    ) -> Node:
        # A block below its key starts a line later; its name is where people look for it.
        scalar = isinstance(node, yaml.ScalarNode)
        here = Node(None, path, self.where(node.start_mark if scalar or not key else key))
        self._count += 1
        # Aliases can make a small text expand without end, or contain itself.
        if self._count > MAX_NODES:
            here.fail(f"expected at most {MAX_NODES} values, found more")
        if depth > MAX_DEPTH:
            here.fail(f"expected at most {MAX_DEPTH} levels of nesting, found more")
        if isinstance(node, yaml.ScalarNode):
            return Node(self._scalar(loader, node, here), path, here.source)
        if isinstance(node, yaml.SequenceNode) and node.tag == "tag:yaml.org,2002:seq":
            items = [
                self.build(loader, item, here.child(index), depth + 1)
                for index, item in enumerate(node.value)
            ]
            return Node(items, path, here.source)
        if isinstance(node, yaml.MappingNode) and node.tag == "tag:yaml.org,2002:map":
            return Node(self._members(loader, node, here, depth), path, here.source)
        here.fail(f"the tag '{node.tag}' is not allowed; write plain YAML")

    def _members(
        self, loader: _Loader, node: yaml.MappingNode, here: Node, depth: int
    ) -> dict[str, Node]:
        members: dict[str, Node] = {}
        for key_node, value_node in node.value:
            key = Node(None, here.path, self.where(key_node.start_mark))
            if key_node.tag == "tag:yaml.org,2002:merge":
                key.fail("merge keys ('<<') are not supported; write the fields out")
            # Bare words that YAML 1.1 takes for booleans or null (y, n, on, ...) are names here.
            if not isinstance(key_node, yaml.ScalarNode) or not key_node.value:
                key.fail("expected the name of a field, found something else as key")
            name = key_node.value
            if name in members:
                key.fail(f"duplicate field, first given at {members[name].source}", name)
            child = here.child(name)
            members[name] = self.build(loader, value_node, child, depth + 1, key_node.start_mark)
        return members

    def _scalar(self, loader: _Loader, node: yaml.ScalarNode, here: Node) -> Any:
        if node.tag == "tag:yaml.org,2002:merge":
            return node.value
        if node.tag not in _SCALARS:
            here.fail(f"the tag '{node.tag}' is not allowed; write plain YAML")
        try:
            return loader.construct_object(node)
        except (ValueError, OverflowError, KeyError, IndexError):
            kind = node.tag.rsplit(":", 1)[-1]
            here.fail(f"expected a valid {kind}, found {found(node.value)}")
