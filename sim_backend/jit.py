"""The decorator of every compiled kernel.

Numba's on-disk cache only looks at the file a function stands in. Our kernels call each other
across files and bake in layout constants, so the cache folder carries a digest of the kernel
libraries (``firmware/``, ``physics/``): an edit there starts a fresh folder instead of running
stale machine code. Kernels elsewhere may call those, but not each other across files.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core.types import unliteral

# Numba's annotations leave these options out.
_config: Any = numba.config
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
    package = Path(__file__).parent
    digest = hashlib.sha256(numba.__version__.encode())
    sources = [Path(__file__), *package.glob("firmware/*.py"), *package.glob("physics/*.py")]
    for source in sorted(sources):
        digest.update(source.name.encode())
        digest.update(source.read_bytes())
    folder = _cache_root() / f"kernels-{digest.hexdigest()[:16]}"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def is_cold() -> bool:
    """True when no kernel has been compiled yet, so that the first run can say why it waits."""
    return not any(cache_folder().rglob("*.nbi"))


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
        nonlocal options
        previous = _config.CACHE_DIR
        _config.CACHE_DIR = str(cache_folder())
        try:
            # Nobody takes a kernel's address: doing without that entry point saves a fifth of
            # the compile time.
            # Kernels allocate nothing: without Numba's reference counts they compile and run
            # faster. One that does allocate has to say _nrt=True.
            options = {"_nrt": False, **options}
            compiled = _njit(
                cache=True, nogil=True, error_model="numpy", no_cfunc_wrapper=True, **options
            )
            return _once_for_all_integers(compiled(py_function))
        finally:
            _config.CACHE_DIR = previous

    return decorate if function is None else decorate(function)
