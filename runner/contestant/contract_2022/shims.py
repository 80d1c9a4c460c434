"""Makes today's packages answer to what controllers of 2022 expect of them.

Everything is put in place by :func:`installed` and taken away when it exits, so that neither
the runner nor the next submission sees it.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.abc
import importlib.machinery
import importlib.util
import os
import sys
import types
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from crazyarena.runner.contestant.contract_2022 import drawn

CONTRACT = Path(__file__).parent / "names"

# Names that NumPy 1.22 still had.
_NUMPY_NAMES: dict[str, Any] = {
    "Inf": np.inf,
    "Infinity": np.inf,
    "PINF": np.inf,
    "NINF": -np.inf,
    "NaN": np.nan,
    "float": float,
    "int": int,
    "object": object,
    "float_": np.float64,
    "complex_": np.complex128,
    "round_": np.round,
    "product": np.prod,
    "cumproduct": np.cumprod,
    "alltrue": np.all,
    "sometrue": np.any,
}

# Modules of ours that stand in when nothing of that name can be imported.
_STAND_INS = {
    "competition_utils": CONTRACT / "competition_utils.py",
    "pybullet": CONTRACT / "pybullet_stub.py",
    "safe_control_gym": None,
    "safe_control_gym.math_and_models": None,
    "safe_control_gym.math_and_models.transformations": CONTRACT / "transformations_stub.py",
}


class _StandIns(importlib.abc.MetaPathFinder):
    """Last finder on the path, asked only for what nobody else has."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name == "competition.competition_utils":
            return importlib.util.spec_from_file_location(name, _STAND_INS["competition_utils"])
        if name not in _STAND_INS:
            return None
        file = _STAND_INS[name]
        if file is None:
            return importlib.machinery.ModuleSpec(name, None, is_package=True)
        return importlib.util.spec_from_file_location(name, file)


class _PatchOnImport(importlib.abc.MetaPathFinder):
    """Patches a module right after whoever imports it first has executed it."""

    def __init__(self, name: str, patch: Callable[[Any], None]) -> None:
        self._name = name
        self._patch = patch
        self._searching = False

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name != self._name or self._searching:
            return None
        self._searching = True
        try:
            spec = importlib.util.find_spec(name)
        finally:
            self._searching = False
        if spec is None or spec.loader is None:
            return spec
        loader: Any = spec.loader
        execute = loader.exec_module

        def exec_module(module: types.ModuleType) -> None:
            execute(module)
            self._patch(module)

        loader.exec_module = exec_module
        return spec


def _retry_with_duplicate_names(method: Callable[..., Any], is_expand: bool) -> Callable[..., Any]:
    @functools.wraps(method)
    def wrapper(self: Any, *args: Any) -> Any:
        try:
            return method(self, *args)
        except RuntimeError as error:
            if "duplicate io name" not in str(error).lower():
                raise
            if is_expand and not args:
                args = (self.name(),)
            options = dict(args[-1]) if args and isinstance(args[-1], dict) else {}
            kept = args[:-1] if args and isinstance(args[-1], dict) else args
            return method(self, *kept, {**options, "allow_duplicate_io_names": True})

    wrapper.__crazyarena_original__ = method  # type: ignore[attr-defined]
    return wrapper


def _patch_casadi(casadi: Any) -> None:
    """Let an input and an output share a name, as CasADi 3.5 did."""
    for name, is_expand in (("__init__", False), ("expand", True)):
        method = getattr(casadi.Function, name)
        if not hasattr(method, "__crazyarena_original__"):
            setattr(casadi.Function, name, _retry_with_duplicate_names(method, is_expand))


def _unpatch_casadi(casadi: Any) -> None:
    for name in ("__init__", "expand"):
        method = getattr(casadi.Function, name)
        if hasattr(method, "__crazyarena_original__"):
            setattr(casadi.Function, name, method.__crazyarena_original__)


_PATCHES = (
    ("casadi", _patch_casadi, _unpatch_casadi),
    ("pybullet", drawn.patch, drawn.unpatch),
)


@contextlib.contextmanager
def installed() -> Iterator[None]:
    """Put all shims in place for the time of the ``with`` block."""
    added = [name for name in _NUMPY_NAMES if name not in vars(np)]
    for name in added:
        setattr(np, name, _NUMPY_NAMES[name])
    stand_ins = _StandIns()
    hooks = [_PatchOnImport(name, patch) for name, patch, _ in _PATCHES]
    sys.meta_path[:0] = hooks
    sys.meta_path.append(stand_ins)
    for name, patch, _ in _PATCHES:
        if name in sys.modules:
            patch(sys.modules[name])
    backend = os.environ.get("MPLBACKEND")
    os.environ["MPLBACKEND"] = "Agg"
    if "matplotlib" in sys.modules:
        sys.modules["matplotlib"].use("Agg", force=True)
    try:
        yield
    finally:
        if backend is None:
            os.environ.pop("MPLBACKEND", None)
        else:
            os.environ["MPLBACKEND"] = backend
        for hook in hooks:
            sys.meta_path.remove(hook)
        sys.meta_path.remove(stand_ins)
        for name, _, unpatch in _PATCHES:
            if name in sys.modules:
                unpatch(sys.modules[name])
        for name in added:
            delattr(np, name)
