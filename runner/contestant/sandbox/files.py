"""A file system of bounded size for what a contestant writes, in a namespace of its own."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from crazyarena.runner.contestant.sandbox import kernel

_MODE = "1777"


def mount_own(files: Path, given: Path, size: int, inodes: int) -> bool:
    """Put an empty file system at ``files``, for this process and its descendants alone.

    What was there can be read at ``given``. Needs privileges, those of a user namespace will do;
    False where they are missing, with nothing changed.
    """
    try:
        kernel.unshare(kernel.CLONE_NEWNS)
        kernel.mount(None, Path("/"), None, kernel.MS_REC | kernel.MS_PRIVATE)
        kernel.mount(str(files), given, None, kernel.MS_BIND)
        # Flags that the place has already cannot be taken off again; the numbers are the same.
        there = os.statvfs(given).f_flag
        kept = there & (kernel.MS_NOSUID | kernel.MS_NODEV | kernel.MS_NOEXEC)
        read_only = kernel.MS_BIND | kernel.MS_REMOUNT | kernel.MS_RDONLY | kept
        kernel.mount(None, given, None, read_only)
        options = f"size={size},nr_inodes={inodes},mode={_MODE}"
        kernel.mount("tmpfs", files, "tmpfs", kernel.MS_NOSUID | kernel.MS_NODEV, options)
    except OSError:
        return False
    return True


def fill(files: Path, given: Path) -> None:
    """Copy the contestant's folders from ``given`` into its own file system."""
    for entry in sorted(given.iterdir()):
        if not (files / entry.name).exists():  # as is the working directory, which is empty
            shutil.copytree(entry, files / entry.name)
