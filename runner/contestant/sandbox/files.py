"""A root of its own for a contestant, with what it may read and nothing else, and a file system of
bounded size for what it writes. In a mount namespace of its own; needs privileges, those of a user
namespace will do.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from pathlib import Path

from crazyarena.runner.contestant.sandbox import kernel

_MODE = "1777"
_SMALL = "size=1m,nr_inodes=4096,mode=755"
_DEVICES = ("null", "zero", "full", "random", "urandom")


def own_root(
    read: Iterable[Path],
    files: Path,
    given: Path,
    size: int,
    inodes: int,
    own_processes: bool,
) -> bool:
    """Enter a root where only ``read`` is to be seen, read-only, and ``files``, empty.

    What was in ``files`` can be read at ``given``. Nothing outside can be changed any more, not
    even permissions, times and attributes, which Landlock does not cover.

    Parameters
    ----------
    size, inodes: bytes and files that ``files`` may hold.
    own_processes: this is the first process of a namespace of processes.

    Returns
    -------
    False where it is not allowed; then no path means anything else than before.
    """
    root = files.parent / "root"
    try:
        kernel.unshare(kernel.CLONE_NEWNS)
        kernel.mount(None, Path("/"), None, kernel.MS_REC | kernel.MS_PRIVATE)
        flags = kernel.MS_NOSUID | kernel.MS_NODEV
        kernel.mount("tmpfs", root, "tmpfs", flags, _SMALL)
        for path in sorted(set(read), key=lambda p: len(p.parts)):
            _show(root, path)
        _devices(root)
        _processes(root, own_processes)
        own, told = _inside(root, files), _inside(root, given)
        (root / "tmp").mkdir(mode=0o755, exist_ok=True)
        for place in (own, told):
            place.mkdir(parents=True, exist_ok=True)
        kernel.mount(str(files), told, None, kernel.MS_BIND)
        kernel.read_only(told)
        options = f"size={size},nr_inodes={inodes},mode={_MODE}"
        kernel.mount("tmpfs", own, "tmpfs", flags, options)
        bare = kernel.MS_REMOUNT | kernel.MS_BIND | kernel.MS_RDONLY
        kernel.mount(None, root, None, bare | flags)
        kernel.pivot_root(root)
    except OSError:
        return False
    return True


def _inside(root: Path, path: Path) -> Path:
    return root / path.relative_to("/")


def _show(root: Path, path: Path) -> None:
    """Make ``path``, if there is one, readable below ``root``."""
    place = _inside(root, path)
    if place.exists() or place.is_symlink():
        return  # with what lies above it
    if path.is_symlink():
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(os.readlink(path))
        return
    if path.is_dir():
        place.mkdir(parents=True)
    elif path.exists():
        place.parent.mkdir(parents=True, exist_ok=True)
        place.touch()
    else:
        return
    kernel.mount(str(path), place, None, kernel.MS_BIND | kernel.MS_REC)
    kernel.read_only(place)


def _devices(root: Path) -> None:
    (root / "dev").mkdir()
    for name in _DEVICES:
        place = root / "dev" / name
        place.touch()
        kernel.mount(f"/dev/{name}", place, None, kernel.MS_BIND)
    (root / "dev" / "fd").symlink_to("/proc/self/fd")


def _processes(root: Path, own: bool) -> None:
    place = root / "proc"
    place.mkdir()
    if own:
        try:
            kernel.mount("proc", place, "proc", kernel.MS_NOSUID | kernel.MS_NODEV)
            return
        except OSError:
            pass  # as in containers that hide parts of theirs
    kernel.mount("/proc", place, None, kernel.MS_BIND | kernel.MS_REC)
    kernel.read_only(place)


def fill(files: Path, given: Path) -> None:
    """Copy the contestant's folders from ``given`` into its own file system."""
    for entry in sorted(given.iterdir()):
        if not (files / entry.name).exists():  # as is the working directory, which is empty
            shutil.copytree(entry, files / entry.name)
