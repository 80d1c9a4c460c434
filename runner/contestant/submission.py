"""Loads a submission the way the competition did, and leaves no trace of it afterwards.

A submission is a folder with ``edit_this.py`` or a single ``.py`` file, with a class
``Controller``. Its folder is importable both directly (``import custom_utils``) and as the
package ``competition`` (``from competition.custom_utils import ...``).
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import importlib
import importlib.machinery
import importlib.util
import os
import sys
import types
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from crazyarena.bounded_read import check_code, size_words
from crazyarena.errors import InputError
from crazyarena.import_failure import missing, told
from crazyarena.no_python import no_python
from crazyarena.runner.contestant.contract_2022 import shims
from crazyarena.runner.timing.step_limit import TimeIsUp, bounded

_ENTRY = "edit_this"
MOST_BYTES = 1024 * 2**20  # of a submission
MOST_FILES = 20_000
MOST_TEXT = 48 * 1024  # characters of a traceback
_IMPORT = 120.0  # s of wall time
_IGNORED = {"__pycache__", ".git", "results", "runs"}


class ControllerError(Exception):
    """The submission's own code raised while it flew; ``details`` holds its traceback."""

    def __init__(self, message: str, details: str) -> None:
        super().__init__(message)
        self.details = details


def entry_file(path: Path) -> Path:
    """Return the file that holds ``class Controller``; raises InputError if there is none."""
    if path.is_dir():
        file = path / f"{_ENTRY}.py"
        if not file.is_file():
            others = sorted(p.name for p in path.glob("*.py"))
            hint = f"; it holds {', '.join(others[:6])}" if others else "; it holds no .py file"
            raise InputError(
                f"{path}: no {_ENTRY}.py in this folder{hint}. "
                "Pass the file with class Controller, or a folder with edit_this.py; a controller "
                "of lsy_drone_racing derives from lsy_drone_racing.control.Controller"
                f"{no_python(path)}"
            )
        return file
    if not path.exists():
        raise InputError(f"{path}: no such file or folder. Pass a submission's folder or .py file")
    if path.suffix != ".py" or not path.is_file():
        raise InputError(f"{path}: not a Python file. Pass a submission's folder or .py file")
    return path


def submission_files(path: Path) -> Iterator[Path]:
    """What belongs to a submission: its one file, or all files of its folder, in order.

    Compiled files, results, version control and what is no regular file do not.
    """
    if path.is_file():
        yield path
        return
    for root, folders, files in os.walk(path):
        folders[:] = sorted(f for f in folders if f not in _IGNORED and not f.startswith("."))
        for name in sorted(files):
            file = Path(root) / name
            if not name.startswith(".") and file.is_file():
                yield file


def check_size(path: Path, most: int = MOST_BYTES, most_files: int = MOST_FILES) -> None:
    """Raise InputError for a submission of more than ``most`` bytes or ``most_files`` files.

    By what the file system says of them; nothing is read.
    """
    remedy = "Leave out what a controller does not need (data, videos, results)"
    check_code(entry_file(path))
    total = 0
    for count, file in enumerate(submission_files(path), 1):
        length = file.stat().st_size
        total += length
        if length > most:
            raise InputError(
                f"{file}: {size_words(length)}; a submission may have {size_words(most)}. {remedy}"
            )
        if total > most:
            raise InputError(f"{path}: more than the {size_words(most)} of a submission. {remedy}")
        if count > most_files:
            raise InputError(f"{path}: more than the {most_files} files of a submission. {remedy}")


def submission_hash(path: Path) -> str:
    """SHA-256 over the submission's entry file, or over all :func:`submission_files`."""
    digest = hashlib.sha256()
    if path.is_file():
        with open(path, "rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    for file in submission_files(path):
        digest.update(file.relative_to(path).as_posix().encode("utf-8", "surrogateescape") + b"\0")
        with open(file, "rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()


def _imports_relatively(file: Path) -> bool:
    """True when the file needs a parent package: ``from .x import y`` outside of any ``try``."""
    try:
        tree = ast.parse(file.read_bytes(), filename=str(file))
    except (SyntaxError, ValueError) as error:
        raise InputError(f"{file}: not valid Python: {error}") from error
    return any(isinstance(node, ast.ImportFrom) and node.level > 0 for node in tree.body)


def _own_names(folder: Path) -> set[str]:
    """Top-level names that ``import`` would find in the submission's folder."""
    names = set()
    for item in folder.iterdir():
        if item.suffix == ".py":
            names.add(item.stem)
        elif item.is_dir() and item.name.isidentifier() and item.name not in _IGNORED:
            names.add(item.name)
    return names - set(sys.stdlib_module_names)


def _is_installed(module: types.ModuleType) -> bool:
    file = getattr(module, "__file__", None) or ""
    return "site-packages" in file or "dist-packages" in file


class Submission:
    """A loaded submission; close it (or leave its ``with`` block) to unload it.

    While it is open, the working directory is ``workdir``, the submission's folder is on
    ``sys.path``, and the shims of :mod:`.contract_2022.shims` are in place.

    Raises
    ------
    InputError: no such file, no ``Controller``, or an error while it was imported.
    """

    def __init__(self, path: str | os.PathLike[str], workdir: str | os.PathLike[str]) -> None:
        self.path = Path(path).expanduser().resolve()
        self.file = entry_file(self.path)
        self.folder = self.file.parent
        check_size(self.path)
        self.digest = submission_hash(self.path)
        needs_package = _imports_relatively(self.file)
        self.workdir = Path(workdir).resolve()
        self.workdir.mkdir(parents=True, exist_ok=True)
        self._undo = contextlib.ExitStack()
        try:
            self._enter()
            self.controller_class = self._load(needs_package)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Submission:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Unload: modules, paths, shims and working directory are as before. Idempotent."""
        self._undo.close()

    def _enter(self) -> None:
        names = {_ENTRY, "competition", "competition_utils", "safe_control_gym"}
        names |= _own_names(self.folder)
        names -= {"crazyarena"}
        aside = {
            name: module
            for name, module in sys.modules.items()
            if name.partition(".")[0] in names and not _is_installed(module)
        }
        for name in aside:
            del sys.modules[name]
        before = set(sys.modules)
        path_before = list(sys.path)
        cwd = os.getcwd()
        write_bytecode = sys.dont_write_bytecode

        def restore() -> None:
            os.chdir(cwd)
            sys.path[:] = path_before
            sys.dont_write_bytecode = write_bytecode
            for name in set(sys.modules) - before:
                if self._is_mine(name, sys.modules[name], names):
                    del sys.modules[name]
            for entry in list(sys.path_importer_cache):
                if Path(entry).is_relative_to(self.folder):
                    del sys.path_importer_cache[entry]
            sys.modules.update(aside)

        self._undo.callback(restore)
        self._undo.enter_context(shims.installed())
        # Compiled files beside the submission would change it, and its folder may be read-only.
        sys.dont_write_bytecode = True
        sys.path.insert(0, str(self.folder))
        importlib.invalidate_caches()
        aliases = ["competition"]
        if (
            self.folder.name.isidentifier()
            and self.folder.name not in sys.modules
            and self.folder.name not in sys.stdlib_module_names
            and self.folder.name not in names
        ):
            aliases.append(self.folder.name)
        for alias in aliases:
            spec = importlib.machinery.ModuleSpec(alias, None, is_package=True)
            package = importlib.util.module_from_spec(spec)
            package.__path__ = [str(self.folder)]
            sys.modules[alias] = package
        os.chdir(self.workdir)

    def _is_mine(self, name: str, module: types.ModuleType, names: set[str]) -> bool:
        if name.partition(".")[0] in names or name == self.folder.name:
            return not _is_installed(module)
        file = getattr(module, "__file__", None)
        if file is None:
            paths: Sequence[str] = list(getattr(module, "__path__", ()))
            return any(Path(p).is_relative_to(self.folder) for p in paths)
        path = Path(file)
        inside = path.is_relative_to(self.folder) or path.is_relative_to(shims.CONTRACT)
        return inside and not _is_installed(module) and not name.startswith("crazyarena")

    def _load(self, needs_package: bool) -> type:
        name = self.file.stem
        taken = name in sys.modules or name in sys.stdlib_module_names
        if not name.isidentifier() or taken:
            name = _ENTRY
        if needs_package:
            name = f"competition.{name}"
        spec = importlib.util.spec_from_file_location(name, self.file)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        try:
            with bounded(_IMPORT):
                spec.loader.exec_module(module)
        except KeyboardInterrupt:
            raise
        except TimeIsUp as late:
            raise InputError(
                f"{self.file}: importing the submission did not end within {_IMPORT:g} s\n"
                f"{own_traceback(late)}"
            ) from None
        except BaseException as error:
            raise InputError(
                f"{self.file}: importing the submission failed: "
                f"{type(error).__name__}: {error}{missing(error, _own_names(self.folder))}\n"
                f"{own_traceback(error)}"
            ) from error
        controller = getattr(module, "Controller", None)
        if not isinstance(controller, type):
            classes = [k for k, v in vars(module).items() if isinstance(v, type)]
            found = f"classes found: {', '.join(classes)}" if classes else "no class found"
            raise InputError(f"{self.file}: no class Controller ({found}). Add `class Controller`")
        if not callable(getattr(controller, "cmdFirmware", None)):
            raise InputError(
                f"{self.file}: class Controller has no method "
                "cmdFirmware(time, obs, reward, done, info). Add it"
            )
        return controller

    def make(
        self,
        initial_obs: list[float],
        initial_info: dict[str, Any],
        use_firmware: bool = True,
        verbose: bool = False,
    ) -> Any:
        """Construct the controller; raises InputError with its traceback if it raises."""
        try:
            return self.controller_class(initial_obs, initial_info, use_firmware, verbose=verbose)
        except (KeyboardInterrupt, TimeIsUp):
            raise
        except BaseException as error:
            raise InputError(
                f"{self.file}: Controller(...) raised {type(error).__name__}: {error}"
                f"{missing(error, _own_names(self.folder))}\n{own_traceback(error)}"
            ) from error


def own_traceback(error: BaseException) -> str:
    """Traceback without the frames of this package and of the import system.

    Errors behind it come first, as Python shows them.
    """
    return told(error, str(Path(__file__).parents[1]), str(shims.CONTRACT), MOST_TEXT)
