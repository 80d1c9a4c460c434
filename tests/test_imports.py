"""Dependencies point one way; this reads every import statement and holds them to it."""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

# What the modules of a folder may import, besides their own folder and the core.
ALLOWED: dict[str, set[str]] = {
    "crazyarena": set(),
    "levels": set(),
    "mocap": set(),
    "crazyswarm_compat": set(),
    "sim_backend": {"crazyswarm_compat", "levels", "mocap"},
    "safety": {"crazyswarm_compat", "levels", "mocap"},
    "runner": {"crazyswarm_compat", "levels", "mocap", "sim_backend", "safety"},
}
# The command line starts in the core's __main__, which hands over to the runner.
EXCEPTIONS = {("crazyarena/__main__.py", "runner")}
CORE = "crazyarena"


def package_of(path: Path) -> list[str]:
    """Dotted name, split, of the package whose members a relative import in ``path`` names."""
    folders = list(path.relative_to(ROOT).parent.parts)
    return folders if folders[0] == CORE else [CORE, *folders]


def imported(tree: ast.AST, package: list[str]) -> Iterator[tuple[int, str]]:
    """Line and absolute dotted name of everything imported, also inside functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else []
            if node.module:
                base = [*base, *node.module.split(".")]
            for alias in node.names:
                yield node.lineno, ".".join([*base, alias.name])
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if name in ("import_module", "__import__") and isinstance(node.args[0].value, str):
                yield node.lineno, node.args[0].value


def folder_of(name: str) -> str | None:
    """The folder a dotted name belongs to; None for packages that are not ours."""
    first, _, rest = name.partition(".")
    if first == CORE:
        second = rest.partition(".")[0]
        return second if second in ALLOWED else CORE
    # The folder names are no packages of their own: importing one bare would only work in the
    # checkout, and would be a second copy of the module.
    return f"bare {first}" if first in ALLOWED else None


@functools.cache
def imports_of(source: str, package: tuple[str, ...]) -> tuple[tuple[int, str], ...]:
    """As :func:`imported`; every file is looked at by several tests, and parsed once."""
    return tuple(imported(ast.parse(source), list(package)))


def violations(source: str, path: Path) -> list[str]:
    where = path.relative_to(ROOT).as_posix()
    folder = path.relative_to(ROOT).parts[0]
    names = imports_of(source, tuple(package_of(path)))
    return [
        f"{where}:{line} imports {name}"
        for line, name in names
        if (target := folder_of(name)) not in (None, folder, CORE)
        and target not in ALLOWED[folder]
        and (where, target) not in EXCEPTIONS
    ]


def test_every_folder_of_the_package_has_a_rule():
    packages = {
        path.parent.relative_to(ROOT).parts[0]
        for path in ROOT.glob("*/__init__.py")
        if path.parent.name != "tests"
    }
    assert packages == set(ALLOWED)


@pytest.mark.parametrize("folder", sorted(ALLOWED))
def test_imports_point_one_way(folder):
    found = []
    for path in sorted((ROOT / folder).rglob("*.py")):
        found += violations(path.read_text(encoding="utf-8"), path)
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("path", "source", "count"),
    [
        ("levels/x.py", "import crazyarena.runner", 1),
        ("levels/x.py", "from crazyarena import sim_backend, errors", 1),
        ("levels/x.py", "def f():\n    from crazyarena.mocap import x", 1),
        ("levels/x.py", "from ..runner import main", 1),
        ("levels/x.py", "from . import load", 0),
        ("levels/__init__.py", "from .load import load_level", 0),
        ("levels/__init__.py", "from ..safety import gate", 1),
        ("sim_backend/crtp/x.py", "from ..trace import TRACE_SIZE", 0),
        ("sim_backend/crtp/__init__.py", "from ...runner import main", 1),
        ("sim_backend/crtp/x.py", "import numpy, crazyarena.levels.draw", 0),
        ("safety/x.py", "from crazyarena.sim_backend import trace", 1),
        ("runner/x.py", "import importlib\nimportlib.import_module('runner.cli')", 1),
        ("levels/x.py", "from runner import cli", 1),
        ("crazyarena/clock.py", "from crazyarena.levels import Level", 1),
        ("crazyarena/clock.py", "from crazyarena.errors import InputError", 0),
        ("crazyarena/__main__.py", "from crazyarena.runner.cli import main", 0),
        ("crazyarena/__main__.py", "from crazyarena.safety import gate", 1),
    ],
)
def test_the_check_itself(path, source, count):
    assert len(violations(source, ROOT / path)) == count


# Rooms of the runner, each of which may import those below it and none above.
ROOMS = (
    ("cli",),
    ("cli.options",),
    ("check",),
    ("tournament",),
    ("",),  # whole commands as programs
    ("campaign.udp",),
    ("campaign",),
    ("campaign.strikes", "viewer"),
    ("trial",),
    ("rig.flight_process", "records.pages"),
    ("rig", "records"),
    ("contestant.sandbox",),
    ("contestant",),
    ("contestant.contract_lsy.names",),
    ("contestant.contract_2022", "contestant.contract_2022.names", "contestant.contract_lsy"),
    ("judging", "timing"),
)
STAND_INS = "contestant.contract_lsy.names"


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts if parts[0] == CORE else (CORE, *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def graph() -> dict[str, set[str]]:
    """What every module of ours imports of ours, also inside functions and for types alone."""
    files = {
        module_name(path): path
        for folder in ALLOWED
        for path in (ROOT / folder).rglob("*.py")
        if "dropin" not in path.parts and not path.is_relative_to(ROOT / CORE / folder)
    }
    found: dict[str, set[str]] = {}
    for name, path in files.items():
        wanted = found[name] = set()
        for _, target in imports_of(path.read_text("utf-8"), tuple(package_of(path))):
            module = target if target in files else target.rpartition(".")[0]
            if module in files and module != name:
                wanted.add(module)
    return found


def circles(edges: Mapping[str, set[str]]) -> list[list[str]]:
    """One circle for every knot of modules that import each other (depth first)."""
    state: dict[str, int] = {}
    found: list[list[str]] = []

    def visit(name: str, path: list[str]) -> None:
        state[name] = 1
        for target in sorted(edges.get(name, ())):
            if state.get(target) == 1:
                found.append([*path[path.index(target) :], target])
            elif target not in state:
                visit(target, [*path, target])
        state[name] = 2

    for name in sorted(edges):
        if name not in state:
            visit(name, [name])
    return found


def room_of(name: str) -> str | None:
    """Room of a module of the runner, ``""`` for those directly in it; None for others."""
    prefix = f"{CORE}.runner"
    if name != prefix and not name.startswith(prefix + "."):
        return None
    inner = name[len(prefix) + 1 :]
    # Whole packages stand in there, however deep: one room.
    if inner.startswith(f"{STAND_INS}."):
        return STAND_INS
    is_room = any(inner == room for level in ROOMS for room in level)
    return inner if is_room else inner.rpartition(".")[0]


def climbs(edges: Mapping[str, set[str]]) -> list[str]:
    heights = {room: -level for level, rooms in enumerate(ROOMS) for room in rooms}
    found = []
    for name, targets in sorted(edges.items()):
        room = room_of(name)
        for target in sorted(targets):
            other = room_of(target)
            if room is None or other is None or room == other:
                continue
            assert room in heights, f"{name}: the room {room!r} has no place in ROOMS"
            assert other in heights, f"{target}: the room {other!r} has no place in ROOMS"
            if heights[other] >= heights[room]:
                found.append(f"{name} climbs to {target}")
    return found


def test_nothing_imports_in_circles():
    assert not circles(graph()), "\n".join(" -> ".join(circle) for circle in circles(graph()))


def test_no_room_of_the_runner_imports_one_above():
    assert not climbs(graph()), "\n".join(climbs(graph()))


def test_rooms_are_few_deep_and_small():
    edges = graph()
    rooms: dict[str, set[str]] = {}
    for name, targets in edges.items():
        room = room_of(name)
        if room is not None:
            others = {room_of(target) for target in targets} - {None, room}
            rooms.setdefault(room, set()).update(other for other in others if other is not None)

    @functools.cache
    def depth(room: str) -> int:
        return 1 + max((depth(other) for other in rooms[room]), default=0)

    assert max(map(depth, rooms)) <= 8
    top = {name for name in edges if room_of(name) == ""}
    assert len(top) <= 8 + 1, "and the package itself"


def test_the_checks_of_rooms_themselves():
    runner = f"{CORE}.runner"
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == [["b", "c", "b"]]
    assert not circles({"a": {"b", "c"}, "b": {"c"}, "c": set()})
    assert climbs({f"{runner}.rig.rig": {f"{runner}.trial.trial"}}) == [
        f"{runner}.rig.rig climbs to {runner}.trial.trial"
    ]
    assert climbs({f"{runner}.rig.rig": {f"{runner}.records.export"}})
    assert not climbs({f"{runner}.trial.trial": {f"{runner}.rig.rig", f"{CORE}.clock"}})


def test_long_files_say_why():
    for folder in ALLOWED:
        for path in (ROOT / folder).rglob("*.py"):
            lines = path.read_text("utf-8").splitlines()
            if len(lines) > 500:
                assert "Long because" in "\n".join(lines[:20]), f"{path}: {len(lines)} lines"
