"""Dependencies point one way; this reads every import statement and holds them to it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
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


def violations(source: str, path: Path) -> list[str]:
    where = path.relative_to(ROOT).as_posix()
    folder = path.relative_to(ROOT).parts[0]
    names = imported(ast.parse(source), package_of(path))
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
        ("sim_backend/crtp/x.py", "from ..jit import kernel", 0),
        ("sim_backend/crtp/__init__.py", "from ...runner import main", 1),
        ("sim_backend/crtp/x.py", "import numpy, crazyarena.levels.draw", 0),
        ("safety/x.py", "from crazyarena.sim_backend import jit", 1),
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
