"""Stops from a shell to the sessions of the same user on this machine; where those are found.

A session is found in two ways. In each folder that a shell may take for the user's (:func:`places`)
lies a datagram socket; and, on Linux, it has an abstract one, which no chmod shuts and no unlink
removes, and which any shell finds whatever its environment says. The kernel tells who sends over
the latter. Whoever stops sends to all of them at once: a stop too many is safe, one that was not
tried is not. :mod:`.estop_socket` is the other end. Nothing that takes long is imported here.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import select
import socket
import stat
import struct
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from crazyarena.clock import WallClock
from crazyarena.errors import InputError
from crazyarena.plain_text import shown_line

ONLY_PLACE = "CRAZYARENA_RUNTIME_DIR"
"""Environment variable: the one folder to use, by listeners and by who stops; for tests, and for
sessions that must not hear each other's stops."""

STOPPED, TESTED, LANDING = "stopped", "tested", "landing"
HEARD, REFUSED = "heard", "refused"
"""Beginnings of answers; all but HEARD are final."""

ABSTRACT = "crazyarena-estop/"
MOST_REASON = 150
"""Letters: however they are escaped, they fit into the one message that a listener reads, and a
request to land is not cut off into a stop."""
LINUX = sys.platform.startswith("linux")
CREDENTIALS = struct.Struct("3i")  # pid, uid, gid: struct ucred
_ASK = 0.01  # s, between looks at answers

Address = str | bytes


def places() -> list[Path]:
    """Folders where stop sockets of this user may lie, best first."""
    name = f"crazyarena-{os.getuid()}"
    only = os.environ.get(ONLY_PLACE)
    if only:
        return [Path(only) / name]
    bases = [os.environ.get("XDG_RUNTIME_DIR"), os.environ.get("TMPDIR"), "/tmp"]
    login = f"/run/user/{os.getuid()}"
    if os.path.isdir(login):
        bases.insert(1, login)
    with contextlib.suppress(OSError):  # there may be no place for temporaries at all
        bases.append(tempfile.gettempdir())
    return list(dict.fromkeys(Path(base) / name for base in bases if base))


def runtime_folder() -> Path:
    """Folder of this user's runtime files, made on demand, closed to others.

    What an earlier flight has left behind, or somebody has opened, is put right.

    Raises
    ------
    InputError: there is no place for one.
    """
    troubles = []
    for folder in places():
        trouble = make_own(folder)
        if trouble is None:
            return folder
        troubles.append(trouble)
    raise InputError(f"no folder for runtime files: {'; '.join(troubles)}. Set XDG_RUNTIME_DIR")


def make_own(folder: Path) -> str | None:
    """Make a folder this user's alone; returns why it cannot be."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.lstat()
        if not stat.S_ISDIR(status.st_mode):
            return f"{folder}: is no folder; remove it"
        if status.st_uid != os.getuid():
            return f"{folder}: belongs to somebody else; remove it"
        if stat.S_IMODE(status.st_mode) != 0o700:
            folder.chmod(0o700)
    except FileExistsError:
        return f"{folder}: is no folder; remove it"
    except OSError as error:
        return f"{folder}: {error.strerror or error}"
    return None


def sender_of(extra: list[tuple[int, int, bytes]]) -> int | None:
    """Who sent a message, as the kernel says; files that came along are closed."""
    user = None
    for level, kind, data in extra:
        if level != socket.SOL_SOCKET:
            continue
        if kind == socket.SCM_RIGHTS:
            whole = len(data) - len(data) % 4
            for (number,) in struct.iter_unpack("i", data[:whole]):
                with contextlib.suppress(OSError):
                    os.close(number)
        elif LINUX and kind == socket.SCM_CREDENTIALS and len(data) >= CREDENTIALS.size:
            user = CREDENTIALS.unpack_from(data)[1]
    return user


@dataclass
class _Target:
    """A session, and the ways to it."""

    left: list[tuple[socket.socket, Address]] = field(default_factory=list)
    answer: str | None = None
    final: bool = False
    reached: bool = False
    trouble: str = "no answer"


def stop_local(
    reason: str = "",
    test: bool = False,
    folder: Path | None = None,
    timeout: float = 1.5,
    warn: Callable[[str], None] = lambda text: None,
    land: bool = False,
) -> list[tuple[str, str]]:
    """Stop every running session of this user; the super-user those of everybody.

    All are sent to at once, then the answers are waited for.

    Parameters
    ----------
    reason: for the record; the first 150 letters of it.
    folder: the only one to look in; by default all of :func:`places`, and abstract sockets.
    timeout: s, for all answers together.
    warn: told of what looks odd; nothing of that keeps a stop from being sent.
    land: ask them to land instead, where a watchdog can.

    Returns
    -------
    For each, the name of its socket and its answer: ``stopped`` where a vehicle's link has
    confirmed, ``tested``, ``landing``, or what went wrong. Sockets nobody listens on any more
    are removed.
    """
    reason = shown_line(reason, MOST_REASON)
    wanted = {"test": True} if test else {"reason": reason, **({"land": True} if land else {})}
    payload = json.dumps(wanted).encode()
    targets: dict[str, _Target] = {}
    with contextlib.ExitStack() as stack:
        plain = _reply_socket(stack, abstract=False) or _reply_socket(stack, abstract=True)
        abstract = _reply_socket(stack, abstract=True)
        for path in _socket_files(folder, warn):
            if plain is not None:
                targets.setdefault(path.name, _Target()).left.append((plain, str(path)))
        if folder is None and abstract is not None:
            for name, address in _abstract_names():
                targets.setdefault(name, _Target()).left.append((abstract, address))
        clock = WallClock()
        end = clock.now() + timeout
        _send(targets, payload)
        replies = [s for s in dict.fromkeys((plain, abstract)) if s is not None]
        while any((t.reached or t.left) and not t.final for t in targets.values()):
            left = end - clock.now()
            if left <= 0.0:
                break
            ready, _, _ = select.select(replies, [], [], min(left, _ASK))
            for listening in ready:
                _collect(listening, targets)
            _send(targets, payload)
    return [
        (name, target.answer or target.trouble)
        for name, target in sorted(targets.items())
        if target.reached or target.left or target.trouble != "no answer"
    ]


def _send(targets: dict[str, _Target], payload: bytes) -> None:
    """To all that have not taken it yet; never waits."""
    for target in targets.values():
        for way in list(target.left):
            sender, address = way
            try:
                sender.sendto(payload, socket.MSG_DONTWAIT, address)
            except BlockingIOError:
                target.trouble = "does not listen: its queue is full"
                continue
            except (ConnectionRefusedError, FileNotFoundError):
                if isinstance(address, str):
                    with contextlib.suppress(OSError):
                        os.unlink(address)
            except OSError as error:
                if error.errno == errno.ENOBUFS:
                    continue
                target.trouble = f"not sent: {error.strerror}"
            else:
                target.reached = True
                target.trouble = "no answer"
            target.left.remove(way)


def _collect(listening: socket.socket, targets: dict[str, _Target]) -> None:
    try:
        data, extra, _, _ = listening.recvmsg(
            512, socket.CMSG_SPACE(CREDENTIALS.size), socket.MSG_DONTWAIT
        )
    except OSError:
        return
    user = sender_of(extra)
    name, _, text = data.decode("utf-8", "replace").partition("\n")
    target = targets.get(name)
    # Anybody could answer in place of a flight.
    if target is None or target.final or (user is not None and user not in (os.getuid(), 0)):
        return
    target.answer = shown_line(text)
    if text == HEARD:
        target.answer = "heard, not confirmed"
    else:
        target.final = not text.startswith(REFUSED)


def _reply_socket(stack: contextlib.ExitStack, abstract: bool) -> socket.socket | None:
    """A socket that can be answered; None where there can be none."""
    if abstract and not LINUX:
        return None
    reply = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
    try:
        if abstract:
            reply.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
            reply.bind("")  # the kernel finds a name
        else:
            own = stack.enter_context(
                tempfile.TemporaryDirectory(prefix="crazyarena-", ignore_cleanup_errors=True)
            )
            reply.bind(str(Path(own) / "reply"))
    except OSError:
        return None
    return reply


def _socket_files(folder: Path | None, warn: Callable[[str], None]) -> Iterator[Path]:
    found = [folder] if folder is not None else places()
    if folder is None and os.getuid() == 0 and not os.environ.get(ONLY_PLACE):
        for base in (*Path("/run/user").glob("*"), Path("/tmp")):
            with contextlib.suppress(OSError):
                found += base.glob("crazyarena-[0-9]*")
    seen: set[tuple[int, int]] = set()
    for place in dict.fromkeys(found):
        try:
            status = place.stat()
        except FileNotFoundError:
            continue
        except OSError as error:
            warn(f"{place}: {error.strerror}")
            continue
        if (status.st_dev, status.st_ino) in seen or not stat.S_ISDIR(status.st_mode):
            continue
        seen.add((status.st_dev, status.st_ino))
        mine = status.st_uid == os.getuid()
        if not mine and os.getuid() != 0:
            warn(f"{place}: belongs to somebody else; sending there nevertheless")
        if folder is None and mine and stat.S_IMODE(status.st_mode) != 0o700:
            warn(f"{place}: somebody changed its permissions; sending nevertheless")
            with contextlib.suppress(OSError):
                place.chmod(0o700)
        try:
            yield from sorted(place.glob("estop-*.sock"))
        except OSError as error:
            warn(f"{place}: {error.strerror}")


def _abstract_names() -> Iterator[tuple[str, str]]:
    """Names and addresses of abstract stop sockets of this machine."""
    if not LINUX or os.environ.get(ONLY_PLACE):
        return
    with contextlib.suppress(OSError), open("/proc/net/unix", errors="replace") as stream:
        for line in stream:
            _, at, path = line.rstrip("\n").partition(f" @{ABSTRACT}")
            user, slash, name = path.partition("/")
            # Those of others would refuse it.
            mine = os.getuid() == 0 or user in (str(os.getuid()), "0")
            if at and slash and mine:
                yield name, f"\0{ABSTRACT}{path}"
