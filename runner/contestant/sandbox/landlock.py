"""Landlock: from now on only the named files exist for this process and its descendants.

Kernel documentation: Documentation/userspace-api/landlock.rst.
"""

from __future__ import annotations

import ctypes
import os
import stat
from collections.abc import Iterable
from pathlib import Path

from crazyarena.runner.contestant.sandbox import kernel

_CREATE, _ADD, _RESTRICT = 444, 445, 446
_VERSION_FLAG = 1
_PATH_BENEATH = 1

_EXECUTE, _WRITE, _READ, _READ_DIR = 1 << 0, 1 << 1, 1 << 2, 1 << 3
_TRUNCATE, _IOCTL = 1 << 14, 1 << 15
_FILE_RIGHTS = _EXECUTE | _WRITE | _READ | _TRUNCATE | _IOCTL
_LAST_RIGHT = {1: 12, 2: 13, 3: 14, 4: 14}  # by ABI; from 5 on it is 15
_TCP = 0b11  # bind, connect
_SCOPES = 0b11  # abstract sockets, signals

READ_ONLY = _READ | _READ_DIR
READ_AND_RUN = _EXECUTE | READ_ONLY


class _Ruleset(ctypes.Structure):
    _fields_ = [
        ("fs", ctypes.c_uint64), ("net", ctypes.c_uint64), ("scoped", ctypes.c_uint64),
    ]  # fmt: skip


class _PathRule(ctypes.Structure):
    _pack_ = 1
    _fields_ = [("allowed", ctypes.c_uint64), ("fd", ctypes.c_int32)]


def abi() -> int:
    """Version of the kernel's Landlock, 0 if it has none."""
    try:
        return kernel.syscall(_CREATE, None, 0, _VERSION_FLAG)
    except OSError:
        return 0


def restrict(
    read: Iterable[Path], run: Iterable[Path], write: Iterable[Path]
) -> tuple[bool, bool, bool]:
    """Leave nothing but these files and folders; paths that do not exist are skipped.

    ``read`` may be read, ``run`` also executed, ``write`` everything. Needs "no new
    privileges" set before.

    Returns
    -------
    Whether files, TCP and signals to others are shut off.
    """
    version = abi()
    if version == 0:
        return False, False, False
    every = (1 << (_LAST_RIGHT.get(version, 15) + 1)) - 1
    rules = _Ruleset(every, _TCP if version >= 4 else 0, _SCOPES if version >= 6 else 0)
    size = 24 if version >= 6 else 16 if version >= 4 else 8
    ruleset = kernel.syscall(_CREATE, ctypes.byref(rules), size, 0)
    try:
        for paths, rights in ((read, READ_ONLY), (run, READ_AND_RUN), (write, every)):
            for path in paths:
                _allow(ruleset, path, rights & every)
        kernel.syscall(_RESTRICT, ruleset, 0)
    finally:
        os.close(ruleset)
    return True, version >= 4, version >= 6


def _allow(ruleset: int, path: Path, rights: int) -> None:
    try:
        fd = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return
    try:
        if not stat.S_ISDIR(os.fstat(fd).st_mode):
            rights &= _FILE_RIGHTS
        rule = _PathRule(rights, fd)
        kernel.syscall(_ADD, ruleset, _PATH_BENEATH, ctypes.byref(rule), 0)
    finally:
        os.close(fd)
