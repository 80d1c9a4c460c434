"""What can be told of a submission without running it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from crazyarena.errors import InputError
from crazyarena.plain_text import shown_line
from crazyarena.runner.contestant.contract_lsy.submission import controller_class, find_controller
from crazyarena.runner.contestant.submission import entry_file

_METHODS = {
    "2022": {
        "__init__": ("initial_obs", "initial_info", "use_firmware", "verbose"),
        "cmdFirmware": ("time", "obs", "reward", "done", "info"),
    },
    "lsy": {
        "__init__": ("obs", "info", "config"),
        "compute_control": ("obs", "info"),
        "step_callback": ("action", "obs", "reward", "terminated", "truncated", "info"),
    },
}
_NEEDED = {"2022": ("__init__", "cmdFirmware"), "lsy": ("compute_control",)}
_IN_FLIGHT = ("cmdFirmware", "interStepLearn", "compute_control", "step_callback")
_CLOCKS = {
    "time": {"time", "monotonic", "perf_counter", "sleep", "time_ns", "monotonic_ns"},
    "datetime": {"now", "today", "utcnow"},
}
# A folder of one person's computer; what it ends with says nothing.
_ELSEWHERE = re.compile(r"^(/home/|/Users/|/root/|/mnt/|~/|[A-Za-z]:[\\/])")


@dataclass(frozen=True, slots=True)
class Finding:
    """works: True, False, or None for what is worth a thought; found in plain words; remedy."""

    name: str
    works: bool | None
    found: str
    remedy: str = ""


def findings(path: Path, contract: str) -> Iterator[Finding]:
    """Contract first, then common mistakes; raises InputError for what is no Python."""
    entry = entry_file(path) if contract == "2022" else find_controller(path)
    assert entry is not None
    tree = _parsed(entry)
    controller = _controller(tree, contract)
    if controller is None and contract == "lsy":
        # It inherits compute_control from a class in a file beside it.
        name = controller_class(entry)
        controller = next(
            n for n in ast.walk(tree) if isinstance(n, ast.ClassDef) and n.name == name
        )
    if controller is None:
        raise InputError(f"{entry}: no class Controller in this file")
    yield _contract(entry, controller, contract)
    files = sorted(entry.parent.glob("*.py")) if path.is_dir() else [entry]
    for file in files:
        if not file.name.startswith("test_"):
            parsed = tree if file == entry else _parsed(file)
            yield from _clock(file, parsed)
            yield from _paths(file, parsed)


def _parsed(file: Path) -> ast.Module:
    try:
        return ast.parse(file.read_bytes(), filename=str(file))
    except (SyntaxError, ValueError) as error:
        raise InputError(f"{file}: not valid Python: {error}") from None


def _controller(tree: ast.Module, contract: str) -> ast.ClassDef | None:
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    if contract == "2022":
        return next((node for node in classes if node.name == "Controller"), None)
    needed = _NEEDED[contract][0]
    return next((node for node in classes if needed in _functions(node)), None)


def _functions(node: ast.ClassDef) -> dict[str, ast.FunctionDef]:
    return {f.name: f for f in node.body if isinstance(f, ast.FunctionDef)}


def _contract(entry: Path, controller: ast.ClassDef, contract: str) -> Finding:
    functions = _functions(controller)
    troubles = []
    if not controller.bases:
        lacking = [name for name in _NEEDED[contract] if name not in functions]
        troubles += [f"no method {name}" for name in lacking]
    for name, given in _METHODS[contract].items():
        if name in functions and (trouble := _cannot_take(functions[name], len(given))):
            troubles.append(f"line {functions[name].lineno}: {name} {trouble}")
    says = ", ".join(f"{name}({', '.join(a)})" for name, a in _METHODS[contract].items())
    known = {"2022": "Safe Robot Learning Competition, 2022", "lsy": "lsy_drone_racing"}[contract]
    if troubles:
        return Finding("contract", False, "; ".join(troubles), f"It is called as {says}.")
    return Finding("contract", True, f"{known}; class {controller.name} in {entry.name}")


def _cannot_take(function: ast.FunctionDef, given: int) -> str | None:
    """Why a method cannot be called with so many arguments; ``verbose`` comes by its name."""
    a = function.args
    places = len(a.posonlyargs) + len(a.args) - 1
    names = {argument.arg for argument in (*a.args, *a.kwonlyargs)}
    if function.name == "__init__" and given == 4:
        given = 3
        if "verbose" not in names and a.kwarg is None:
            return "does not take verbose="
    if places < given and a.vararg is None:
        return f"takes {places} arguments, {given} are given"
    required = places - len(a.defaults)
    if required - ("verbose" in names and given == 3) > given:
        return f"needs {required} arguments, {given} are given"
    return None


def _clock(file: Path, tree: ast.Module) -> Iterator[Finding]:
    modules: dict[str, str] = {}
    direct: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name in _CLOCKS:
                    modules[alias.asname or alias.name] = alias.name
        elif isinstance(node, ast.ImportFrom) and node.module in _CLOCKS:
            for alias in node.names:
                direct[alias.asname or alias.name] = alias.name
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef) or function.name not in _IN_FLIGHT:
            continue
        for node in ast.walk(function):
            if isinstance(node, ast.Call) and (name := _clock_called(node, modules, direct)):
                yield Finding(
                    "clock",
                    None,
                    f"{file.name}:{node.lineno}: {name}() in {function.name}",
                    "In a dry run the computer's clock has nothing to do with the flight; count "
                    "steps, or use the time that is handed over.",
                )
                return


def _clock_called(node: ast.Call, modules: dict[str, str], direct: dict[str, str]) -> str | None:
    f = node.func
    if isinstance(f, ast.Name):
        original = direct.get(f.id)
        return f.id if original in _CLOCKS["time"] else None
    if isinstance(f, ast.Attribute):
        root: ast.expr = f.value
        while isinstance(root, ast.Attribute):
            root = root.value
        if isinstance(root, ast.Name):
            module = modules.get(root.id) or ("datetime" if root.id in direct else None)
            if module is not None and f.attr in _CLOCKS[module]:
                return f"{root.id}.{f.attr}"
    return None


def _paths(file: Path, tree: ast.Module) -> Iterator[Finding]:
    for node in ast.walk(tree):
        if not isinstance(node, ast.Constant):
            continue
        text = node.value
        if isinstance(text, str) and "\n" not in text and _ELSEWHERE.match(text):
            yield Finding(
                "paths",
                False,
                f"{file.name}:{node.lineno}: {shown_line(text, 60)}",
                "Nobody else has this folder. Put the file beside the controller, and open "
                "Path(__file__).parent / NAME.",
            )
            return
