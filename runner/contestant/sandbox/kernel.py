"""System calls that the standard library has no function for."""

from __future__ import annotations

import ctypes
import os
import platform
import struct
from pathlib import Path

_LIBC = ctypes.CDLL(None, use_errno=True)

PR_SET_PDEATHSIG = 1
PR_SET_DUMPABLE = 4
PR_SET_NO_NEW_PRIVS = 38
PR_SET_SECCOMP = 22

CLONE_NEWNS = 0x00020000
CLONE_NEWCGROUP = 0x02000000
CLONE_NEWUTS = 0x04000000
CLONE_NEWIPC = 0x08000000
CLONE_NEWUSER = 0x10000000
CLONE_NEWPID = 0x20000000
CLONE_NEWNET = 0x40000000

MS_RDONLY = 1
MS_NOSUID = 2
MS_NODEV = 4
MS_NOEXEC = 8
MS_REMOUNT = 32
MS_BIND = 4096
MS_REC = 16384
MS_PRIVATE = 1 << 18
MNT_DETACH = 2

_ARM = platform.machine() == "aarch64"
_PIVOT_ROOT, _CAPSET = (41, 91) if _ARM else (155, 126)
_MOUNT_SETATTR = 442
_RECURSIVE = 0x8000
_ATTR_RDONLY, _ATTR_NOSUID = 1, 2
_CAPABILITY_VERSION = 0x20080522
_HERE = -100


def _checked(result: int) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result


def prctl(option: int, *arguments: object) -> None:
    """Call prctl(2); raises OSError."""
    values = [a if not isinstance(a, int) else ctypes.c_ulong(a) for a in arguments]
    values += [ctypes.c_ulong(0)] * (4 - len(values))
    _checked(_LIBC.prctl(ctypes.c_int(option), *values))


def unshare(flags: int) -> None:
    """Call unshare(2); raises OSError."""
    _checked(_LIBC.unshare(ctypes.c_int(flags)))


def mount(
    source: str | None, target: Path, kind: str | None, flags: int, options: str | None = None
) -> None:
    """Call mount(2); raises OSError."""
    texts = [None if text is None else os.fsencode(text) for text in (source, target, kind)]
    data = None if options is None else options.encode()
    _checked(_LIBC.mount(*texts, ctypes.c_ulong(flags), data))


def syscall(number: int, *arguments: object) -> int:
    """Call any system call; raises OSError."""
    values = [ctypes.c_long(a) if isinstance(a, int) else a for a in arguments]
    return _checked(_LIBC.syscall(ctypes.c_long(number), *values))


def pivot_root(new: Path) -> None:
    """Make ``new``, a mount, the root of this process's mount namespace; the old one is gone.

    Raises OSError.
    """
    os.chdir(new)
    dot = ctypes.c_char_p(b".")
    syscall(_PIVOT_ROOT, dot, dot)
    _checked(_LIBC.umount2(dot, ctypes.c_int(MNT_DETACH)))
    os.chdir("/")


def read_only(place: Path) -> None:
    """Make a mount and all below it read-only (Linux 5.12 or later); raises OSError."""
    attributes = struct.pack("<4Q", _ATTR_RDONLY | _ATTR_NOSUID, 0, 0, 0)
    path = ctypes.c_char_p(os.fsencode(place))
    syscall(_MOUNT_SETATTR, _HERE, path, _RECURSIVE, ctypes.c_char_p(attributes), 32)


def drop_capabilities() -> None:
    """Give up every capability of this process; raises OSError."""
    head = struct.pack("<Ii", _CAPABILITY_VERSION, 0)
    syscall(_CAPSET, ctypes.c_char_p(head), ctypes.c_char_p(bytes(24)))
