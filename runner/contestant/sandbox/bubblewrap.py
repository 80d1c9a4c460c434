"""bubblewrap: a file system with nothing in it but what a contestant needs."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path


@cache
def program() -> str | None:
    """Path of ``bwrap`` if it is installed and this machine lets it work."""
    found = shutil.which("bwrap")
    if found is None:
        return None
    try:
        trial = subprocess.run(
            [found, "--unshare-all", "--ro-bind", "/", "/", "true"],
            capture_output=True,
            timeout=10,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return found if trial.returncode == 0 else None


@cache
def can_limit(bwrap: str) -> bool:
    """Whether it can make file systems of limited size (since 0.7)."""
    try:
        trial = subprocess.run(
            [bwrap, "--unshare-all", "--ro-bind", "/", "/", "--size", "4096", "--tmpfs", "/tmp"]
            + ["true"],
            capture_output=True,
            timeout=10,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return trial.returncode == 0


def prefix(
    bwrap: str,
    read: Sequence[Path],
    write: Path,
    work: Path,
    as_root: bool,
    given: Path,
    size: int | None,
) -> list[str]:
    """Command line that runs what follows with ``read`` visible and ``write`` writable.

    ``as_root``: started by the super-user; what follows may then become another user, which
    it could not inside a user namespace. ``size``: bytes of an empty file system to put at
    ``write`` instead; what is there can then be read at ``given``.
    """
    command = [bwrap]
    if as_root:
        command += ["--unshare-ipc", "--unshare-pid", "--unshare-net", "--unshare-uts"]
        command += ["--cap-add", "CAP_SETUID", "--cap-add", "CAP_SETGID"]
    else:
        command += ["--unshare-all"]
    command += ["--die-with-parent", "--proc", "/proc", "--dev", "/dev", "--tmpfs", "/tmp"]
    made: set[Path] = {Path("/tmp")}
    bound: set[Path] = set()
    for path in sorted(set(read), key=lambda p: len(p.parts)):
        command += [*_way_to(path, made, bound), "--ro-bind-try", str(path), str(path)]
        bound.add(path)
    command += _way_to(write, made, bound)
    if size is None:
        command += ["--bind", str(write), str(write)]
    else:
        command += [*_way_to(given, made, bound), "--ro-bind", str(write), str(given)]
        command += ["--perms", "1777", "--size", str(size), "--tmpfs", str(write)]
        command += ["--perms", "0777", "--dir", str(work)]
    # Its own files are all it may fill.
    for place in ("/tmp", "/dev", "/"):
        command += ["--remount-ro", place]
    return [*command, "--chdir", str(work)]


def _way_to(path: Path, made: set[Path], bound: set[Path]) -> list[str]:
    """Options that make the folders above ``path``, open to everybody, unless they are there."""
    options: list[str] = []
    for folder in reversed(path.parents):
        there = folder in made or any(b == folder or b in folder.parents for b in bound)
        if folder != Path("/") and not there:
            options += ["--perms", "0755", "--dir", str(folder)]
            made.add(folder)
    return options
