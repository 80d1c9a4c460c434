"""Namespaces of its own for a contestant: processes, network, and what people call IPC."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable

from crazyarena.runner.contestant.sandbox import kernel


def enter(own_users: bool = True) -> list[str]:
    """Enter new namespaces as far as allowed; returns which: ``user``, ``network``, ``ipc``,
    ``processes``. The last one begins with the next child, see :func:`split`.

    ``own_users`` False leaves out the first, in which nobody can become another user.
    """
    entered = []
    uid, gid = os.getuid(), os.getgid()
    try:
        if not own_users:
            raise PermissionError
        kernel.unshare(kernel.CLONE_NEWUSER)
        with open("/proc/self/setgroups", "w") as stream:
            stream.write("deny")
        with open("/proc/self/uid_map", "w") as stream:
            stream.write(f"{uid} {uid} 1")
        with open("/proc/self/gid_map", "w") as stream:
            stream.write(f"{gid} {gid} 1")
        entered.append("user")
    except OSError:
        pass  # the others work without it for the super-user
    for name, flag in (
        ("network", kernel.CLONE_NEWNET),
        ("ipc", kernel.CLONE_NEWIPC),
        ("processes", kernel.CLONE_NEWPID),
    ):
        try:
            kernel.unshare(flag)
            entered.append(name)
        except OSError:
            continue
    return entered


def die_with_parent() -> None:
    """Be killed when the parent dies; ends at once if it already has."""
    parent = os.getppid()
    kernel.prctl(kernel.PR_SET_PDEATHSIG, int(signal.SIGKILL))
    if os.getppid() != parent:
        os._exit(1)


def split(tell_pid: Callable[[int], None]) -> None:
    """Go on in a child, the first process of the new namespace; its death takes along all others.

    The parent stays behind, hands the child's pid to ``tell_pid``, waits, and ends as the child
    did.
    """
    child = os.fork()
    if child == 0:
        die_with_parent()
        return
    tell_pid(child)
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        signal.signal(number, signal.SIG_DFL) if number not in (
            signal.SIGKILL,
            signal.SIGSTOP,
        ) else None
        os.kill(os.getpid(), number)
    sys.stdout.flush()
    os._exit(os.WEXITSTATUS(status) if os.WIFEXITED(status) else 1)
