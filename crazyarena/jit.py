"""The decorator of every compiled kernel.

Numba's on-disk cache only looks at the file a function stands in. Our kernels call each other
across files and bake in layout constants, so the cache folder carries a digest of the kernel
libraries (``firmware/`` and ``physics/`` of ``sim_backend``): an edit there starts a fresh folder
instead of running stale machine code. Kernels elsewhere may call those, but not each other across
files.

Within the folder a kernel is found by its module's name and the contents of its file, not by
where that file stands: installations of the same sources share what one of them has compiled.
Numba itself keeps apart processors and their features.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.types import unliteral

# Numba's annotations leave its options out.
_njit: Any = numba.njit


def _cache_root() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    root = Path(base) / "crazyarena"
    try:
        root.mkdir(parents=True, exist_ok=True)
        if os.access(root, os.W_OK):
            return root
    except OSError:
        pass
    return Path(tempfile.gettempdir()) / f"crazyarena-{os.getuid()}"


@cache
def cache_folder() -> Path:
    """Folder of this version's compiled kernels (made on first use)."""
    simulator = Path(__file__).parent / "sim_backend"
    digest = hashlib.sha256(numba.__version__.encode())
    sources = [
        Path(__file__),
        *simulator.glob("firmware/*.py"),
        *simulator.glob("physics/*.py"),
    ]
    for source in sorted(sources):
        digest.update(source.name.encode())
        digest.update(source.read_bytes())
    folder = _cache_root() / f"kernels-{digest.hexdigest()[:16]}"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@cache
def _digest(file: str) -> str:
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()


class _Locator:
    """Where Numba keeps what it compiled of one function (its ``_CacheLocator``)."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._stamp = _digest(file)
        self._line = function.__code__.co_firstlineno
        self._folder = cache_folder() / function.__module__.removeprefix("crazyarena.")

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> _Locator:
        return cls(function, file)

    def ensure_cache_path(self) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._stamp

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Results(CompileResultCacheImpl):
    _locator_classes: list[type[object]] = [_Locator]  # noqa: RUF012


class _Cache(FunctionCache):
    """A cache that can be lost: what cannot be read is compiled again, what cannot be written
    (a full disk, a folder of somebody else) is compiled by the next process, too."""

    _impl_class = _Results

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:
            with contextlib.suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        with contextlib.suppress(OSError, EOFError):
            super().save_overload(sig, data)


def is_cold(*modules: str) -> bool:
    """True when kernels of one of these modules (``sim_backend.arena_kernel``) were never
    compiled, so that the first run can say why it waits."""
    folder = cache_folder()
    return any(not any((folder / module).glob("*.nbi")) for module in modules)


def _once_for_all_integers(dispatcher: Any) -> Any:
    """Keep Numba from compiling a kernel anew for every integer constant it is called with."""
    template = dispatcher.get_call_template

    def general(args: Any, kws: dict[str, Any]) -> Any:
        plain = {name: unliteral(kind) for name, kind in kws.items()}
        return template([unliteral(kind) for kind in args], plain)

    dispatcher.get_call_template = general
    return dispatcher


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile with Numba: cached on disk, no GIL, IEEE arithmetic (no fast-math)."""

    def decorate(py_function: Callable[..., Any]) -> Any:
        # Nobody takes a kernel's address: doing without that entry point saves a fifth of the
        # compile time. Kernels allocate nothing: without Numba's reference counts they compile
        # and run faster. One that does allocate has to say _nrt=True.
        compiled = _njit(
            nogil=True, error_model="numpy", no_cfunc_wrapper=True, **{"_nrt": False, **options}
        )(py_function)
        compiled._cache = _Cache(py_function)
        return _once_for_all_integers(compiled)

    return decorate if function is None else decorate(function)
