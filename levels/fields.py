"""Fields of a file: overridden one by one, validated, complained of by file, line and name."""

from __future__ import annotations

import re
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from crazyarena.errors import InputError
from crazyarena.levels.document import MAX_DEPTH, Node, found, parse

_File = TypeVar("_File", bound=BaseModel)
_SEGMENT = re.compile(r"([^.\[\]]+)((?:\[\d{1,6}\])*)")


def assignment(override: str) -> tuple[list[str | int], Node]:
    """``a.b=value`` as the path of the field and its value, parsed as YAML; list members are
    ``a[2].b`` or ``a.2.b``.

    Raises
    ------
    InputError: it is none.
    """
    shown = override if len(override) <= 80 else override[:77] + "..."
    source = f"override {shown!r}"
    path, equals, value = override.partition("=")
    path = path.strip()
    if not equals or not path:
        raise InputError(f"{source}: expected field=value, e.g. disturbances.action.std=0.002")
    keys: list[str | int] = []
    for part in path.split("."):
        match = _SEGMENT.fullmatch(part)
        if match is None:
            raise InputError(
                f"{source}: expected a field such as track.gates[0].yaw, found '{path}'"
            )
        name = match[1]
        is_index = bool(keys) and re.fullmatch(r"\d{1,6}", name) is not None
        keys.append(int(name) if is_index else name)
        keys.extend(int(index) for index in re.findall(r"\d+", match[2]))
    if len(keys) > MAX_DEPTH:
        raise InputError(f"{source}: expected at most {MAX_DEPTH} fields in a path, found more")
    return keys, parse(value, source, lines=False, path=_joined(keys))


def _joined(keys: list[str | int]) -> str:
    node = Node(None, "", "")
    for key in keys:
        node = Node(None, node.child(key), "")
    return node.path


def assign(node: Node, keys: list[str | int], value: Node) -> Node:
    """The tree with ``value`` at ``keys``; mappings on the way are made where none is."""
    if not keys:
        return value
    key, rest = keys[0], keys[1:]
    here = Node(node.value, node.path, value.source)
    if isinstance(node.value, list):
        if isinstance(key, int) and key < len(node.value):
            items = list(node.value)
            items[key] = assign(items[key], rest, value)
            return Node(items, node.path, node.source)
        here.fail(f"expected an index below {len(node.value)}, found '{key}'")
    if node.value is not None and not isinstance(node.value, dict):
        here.fail(f"has no field '{key}'; it is {found(node.value)}")
    members = dict(node.value or {})
    # An index on something that is no list is a field with a number for a name: unknown, and
    # reported as such by the validation.
    name = str(key)
    members[name] = assign(
        members.get(name, Node(None, node.child(name), value.source)), rest, value
    )
    return Node(members, node.path, node.source)


def validate(root: Node, model: type[_File]) -> _File:
    """What a document says, as a model.

    Raises
    ------
    InputError: naming file, line, column, field, what was found and what is allowed.
    """
    try:
        return model.model_validate(root.plain())
    except ValidationError as error:
        items = error.errors(include_url=False)
    # A bad member also makes pydantic find its list too short: that is one problem, not two.
    inner = {item["loc"][:depth] for item in items for depth in range(len(item["loc"]))}
    problems = [_describe(root, item) for item in items if item["loc"] not in inner]
    more = f" (and {len(problems) - 1} more in this file)" if len(problems) > 1 else ""
    raise InputError(problems[0] + more)


def _describe(root: Node, error: Any) -> str:
    keys = list(error["loc"])
    if error["type"] == "level" and error["ctx"]["key"]:
        for part in str(error["ctx"]["key"]).split("."):
            keys.append(int(part) if part.isdecimal() else part)
    node, rest = root, keys
    while rest:
        members = node.value
        if isinstance(members, dict) and str(rest[0]) in members:
            node = members[str(rest[0])]
        elif isinstance(members, list) and isinstance(rest[0], int) and rest[0] < len(members):
            node = members[rest[0]]
        elif not (isinstance(members, dict) and rest[0] == 0):
            break  # else: a table that stands for a list of one
        rest = rest[1:]
    if not isinstance(node.value, dict | list):
        rest = []  # one number that stands for several: no member of it was written
    path = Node(None, node.path, "")
    for key in rest:
        path = Node(None, path.child(key), "")
    where = f"{node.source}: {path.path}: " if path.path else f"{node.source}: "
    return where + _message(error)


_EXPECTED = {
    "float_type": "a finite number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "string_type": "text",
    "model_type": "a mapping of fields",
    "model_attributes_type": "a mapping of fields",
    "tuple_type": "a list",
    "enum": "{expected}",
    "literal_error": "{expected}",
    "greater_than": "a number > {gt}",
    "greater_than_equal": "a number >= {ge}",
    "less_than": "a number < {lt}",
    "less_than_equal": "a number <= {le}",
    "string_pattern_mismatch": "text matching {pattern}",
}


def _message(error: Any) -> str:
    kind, context = error["type"], error.get("ctx", {})
    if kind == "level":
        return context["text"]
    if kind == "missing":
        return "missing; this field is required"
    if kind in ("too_short", "too_long"):
        count = context.get("min_length", context.get("max_length"))
        at_most = "at most " if kind == "too_long" and count == 100 else ""
        return f"expected {at_most}{count} values, found {context['actual_length']}"
    if kind in _EXPECTED:
        return f"expected {_EXPECTED[kind].format(**context)}, found {found(error['input'])}"
    return f"{error['msg']}, found {found(error['input'])}"
