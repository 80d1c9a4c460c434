"""Finds and loads a controller of lsy_drone_racing, and leaves no trace of it afterwards.

It is a file with exactly one class that derives from ``Controller``, or a folder with exactly one
such file. Its neighbours import directly and as ``lsy_drone_racing.control.<name>``.
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import inspect
import os
import sys
import types
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crazyarena.bounded_read import check_code
from crazyarena.errors import InputError
from crazyarena.import_failure import missing, told
from crazyarena.no_python import no_python

NAMES = Path(__file__).parent / "names"
_PACKAGE = "lsy_drone_racing"
_MOST_TEXT = 48 * 1024  # characters of a traceback
# Ours even where the originals are installed: those want a simulation that is not there.
_OURS = (_PACKAGE, "crazyflow")
_STAND_INS = ("drone_models", "gymnasium")
_IGNORED = {"__pycache__", ".git", "results", "runs", "c_generated_code", ".venv", "saves"}
_MODEL = "CRAZYARENA_DRONE_MODEL"


_Trees = dict[Path, ast.Module | None]


@dataclass(frozen=True)
class _Kinds:
    """Of one file: its own classes that derive from Controller, every name by which it knows such
    a class, and the files that those of others come from."""

    own: frozenset[str] = frozenset()
    known: frozenset[str] = frozenset()
    bases: frozenset[Path] = frozenset()


def _tree(file: Path) -> ast.Module | None:
    try:
        check_code(file)
        return ast.parse(file.read_bytes(), filename=str(file))
    except (OSError, SyntaxError, ValueError, RecursionError):
        return None


def _neighbour(module: str, folder: Path) -> Path | None:
    """File in a controller's folder, or in its package, that a module's name stands for."""
    parts = module.split(".")
    if parts[0] != _PACKAGE:
        places = [folder.joinpath(*parts)]
    else:
        places = [bundle_root(folder / "x.py").joinpath(*parts[1:])]
        if parts[1:2] == ["control"]:
            places.insert(0, folder.joinpath(*parts[2:]))
    files = (file for place in places for file in (Path(f"{place}.py"), place / "__init__.py"))
    return next((file for file in files if file.is_file()), None)


def _kinds(file: Path, folder: Path, seen: dict[Path, _Kinds], trees: _Trees) -> _Kinds:
    """What a file beside a controller says of its classes; bases may stand in its neighbours."""
    if file in seen:
        return seen[file]
    seen[file] = _Kinds()  # while it is read: imports may go in a circle
    if file not in trees:
        trees[file] = _tree(file)
    tree = trees[file]
    if tree is None:
        return seen[file]
    known: set[str] = set()
    sources: dict[str, Path] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            wanted = [(alias.name, "", "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            wanted = [(node.module or "", a.name, a.asname or a.name) for a in node.names]
        else:
            continue
        for module, name, alias in wanted:
            if module.partition(".")[0] == _PACKAGE:
                known |= {"Controller", alias} if name == "Controller" else {"Controller"}
            beside = _neighbour(module, folder)
            theirs = _Kinds() if beside is None else _kinds(beside, folder, seen, trees)
            found = {name: alias} if name in theirs.known else {}
            if not found:
                # A module's classes are named as its attributes, or all at once with a star.
                if name not in ("", "*"):
                    beside = _neighbour(f"{module}.{name}", folder)
                    theirs = _Kinds() if beside is None else _kinds(beside, folder, seen, trees)
                found = {kind: kind for kind in theirs.known}
            known |= set(found.values())
            if beside is not None:
                sources |= {alias: beside for kind, alias in found.items() if kind in theirs.own}
    own: set[str] = set()
    bases: set[Path] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            names = {
                base.id if isinstance(base, ast.Name) else getattr(base, "attr", "")
                for base in node.bases
            }
            if names & known:
                own.add(node.name)
                bases |= {sources[name] for name in names & sources.keys()}
                known.add(node.name)
    seen[file] = _Kinds(frozenset(own), frozenset(known), frozenset(bases))
    return seen[file]


def find_controller(path: Path) -> Path | None:
    """The file of a controller of lsy_drone_racing, or None if this is none.

    In a folder a file whose classes another one there derives from is no controller itself.

    Raises
    ------
    InputError: a folder with several of them.
    """
    if path.is_file():
        return path if path.suffix == ".py" and _kinds(path, path.parent, {}, {}).own else None
    if not path.is_dir() or (path / "edit_this.py").is_file():
        return None
    # Each from its own point of view: where imports go in a circle it matters who begins.
    trees: _Trees = {}
    kinds = {file: _kinds(file, path, {}, trees) for file in sorted(path.glob("*.py"))}
    bases = {base for kind in kinds.values() for base in kind.bases}
    found = [file for file, kind in kinds.items() if kind.own and file not in bases]
    if len(found) > 1:
        names = ", ".join(file.name for file in found[:6])
        raise InputError(f"{path}: several controllers ({names}). Pass the file of one")
    return found[0] if found else None


def controller_class(file: Path) -> str:
    """Name of the last class in a controller's file that derives from Controller."""
    trees: _Trees = {}
    own = _kinds(file, file.parent, {}, trees).own
    tree = trees[file]
    nodes = ast.walk(tree) if tree is not None else ()
    return [n.name for n in nodes if isinstance(n, ast.ClassDef) and n.name in own][-1]


def controller_file(submission: Path, level: str) -> Path:
    """The file, resolved, of a controller that ``level`` needs.

    Raises
    ------
    InputError: there is nothing, or nothing that is one.
    """
    path = submission.expanduser()
    if not path.exists():
        raise InputError(f"{path}: no such file or folder. Pass the file of a controller")
    file = find_controller(path)
    if file is None:
        raise InputError(
            f"{path}: no class here derives from lsy_drone_racing.control.Controller, which level "
            f"{level} needs. Pass the file of such a controller{no_python(path)}"
        )
    return file.resolve()


def bundle_root(file: Path) -> Path:
    """Folder of what belongs to a controller: its package where it is in one, else its own."""
    parent = file.parent
    if parent.name == "control" and parent.parent.name == _PACKAGE:
        return parent.parent
    return parent


def controller_hash(file: Path) -> str:
    """SHA-256 over the Python files beside a controller, and itself.

    Raises InputError for one that is too large to be code.
    """
    for code in (file, *file.parent.glob("*.py")):
        check_code(code)
    digest = hashlib.sha256(file.read_bytes())
    for other in sorted(file.parent.glob("*.py")):
        digest.update(other.name.encode() + b"\0" + hashlib.sha256(other.read_bytes()).digest())
    return digest.hexdigest()


class _Finder(importlib.abc.MetaPathFinder):
    """Looks for names in our folder of stand-ins."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        top = name.partition(".")[0]
        if top not in self._names:
            return None
        places = [str(NAMES)] if path is None else [str(p) for p in path]
        return importlib.machinery.PathFinder.find_spec(name, places)


class LsySubmission:
    """A loaded controller; close it to unload it. Raises InputError for what cannot be loaded.

    drone_model: the vehicle whose constants ``crazyflow.constants`` gives.
    """

    def __init__(self, file: Path, workdir: Path, drone_model: str) -> None:
        self.file = file.resolve()
        self.digest = controller_hash(self.file)
        self.workdir = workdir.resolve()
        self.workdir.mkdir(parents=True, exist_ok=True)
        self._undo = contextlib.ExitStack()
        try:
            self._enter(drone_model)
            self.controller_class = self._load()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Unload: modules, paths and working directory are as before. Idempotent."""
        self._undo.close()

    def _enter(self, drone_model: str) -> None:
        folder = self.file.parent
        mine = {*_OURS, *_STAND_INS, "controller"}
        mine |= {p.stem for p in folder.glob("*.py")} - set(sys.stdlib_module_names)
        aside = {
            name: module
            for name, module in sys.modules.items()
            if name.partition(".")[0] in mine and not name.startswith("crazyarena")
        }
        for name in aside:
            del sys.modules[name]
        before, path, cwd = set(sys.modules), list(sys.path), os.getcwd()
        bytecode, environ = sys.dont_write_bytecode, os.environ.get(_MODEL)
        ours, stand_ins = _Finder(_OURS), _Finder(_STAND_INS)

        def restore() -> None:
            os.chdir(cwd)
            sys.path[:] = path
            sys.dont_write_bytecode = bytecode
            sys.meta_path.remove(ours)
            sys.meta_path.remove(stand_ins)
            if environ is None:
                os.environ.pop(_MODEL, None)
            else:
                os.environ[_MODEL] = environ
            for name in set(sys.modules) - before:
                module = sys.modules[name]
                file = getattr(module, "__file__", None) or ""
                own = file.startswith((str(NAMES), str(bundle_root(self.file)) + os.sep))
                own &= "-packages" not in file
                if name.partition(".")[0] in _OURS or name == "controller" or own:
                    del sys.modules[name]
            sys.modules.update(aside)

        self._undo.callback(restore)
        sys.meta_path.insert(0, ours)
        sys.meta_path.append(stand_ins)
        os.environ[_MODEL] = drone_model
        sys.dont_write_bytecode = True
        sys.path.insert(0, str(folder))
        importlib.invalidate_caches()
        package = importlib.import_module(_PACKAGE)
        control = importlib.import_module(f"{_PACKAGE}.control")
        control.__path__.append(str(folder))
        root = bundle_root(self.file)
        if root != folder:
            package.__path__.append(str(root))
        os.chdir(self.workdir)

    def _load(self) -> type:
        spec = importlib.util.spec_from_file_location("controller", self.file)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules["controller"] = module
        try:
            spec.loader.exec_module(module)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            raise InputError(
                f"{self.file}: importing the controller failed: "
                f"{type(error).__name__}: {error}{missing(error)}\n{controller_traceback(error)}"
            ) from error
        base = sys.modules[f"{_PACKAGE}.control"].Controller
        found = [
            kind
            for kind in vars(module).values()
            if inspect.isclass(kind) and issubclass(kind, base) and kind.__module__ == "controller"
        ]
        if len(found) != 1:
            names = ", ".join(kind.__name__ for kind in found) or "none"
            raise InputError(
                f"{self.file}: expected exactly one class that derives from "
                f"lsy_drone_racing.control.Controller, found {names}"
            )
        return found[0]

    def make(self, obs: dict[str, Any], info: dict[str, Any], config: Any) -> Any:
        """Construct the controller; raises InputError with its traceback if it raises."""
        try:
            return self.controller_class(obs, info, config)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            raise InputError(
                f"{self.file}: {self.controller_class.__name__}(...) raised "
                f"{type(error).__name__}: {error}{missing(error)}\n{controller_traceback(error)}"
            ) from error

    def canvas(self) -> Any:
        """Something to draw into, for ``render_callback``."""
        return importlib.import_module("crazyflow.sim").Sim()


def controller_traceback(error: BaseException) -> str:
    """Traceback without the frames of this package and of the import system."""
    return told(error, str(Path(__file__).parent), str(NAMES), _MOST_TEXT)
