"""Listens for stops from other shells; :mod:`.estop_local` says how it is found, and sends them."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import select
import socket
import stat
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from crazyarena.clock import WallClock
from crazyarena.errors import InputError
from crazyarena.plain_text import shown_line
from crazyarena.safety.estop import StopButton, say_loudly
from crazyarena.safety.estop_local import (
    ABSTRACT,
    CREDENTIALS,
    HEARD,
    LANDING,
    LINUX,
    ONLY_PLACE,
    REFUSED,
    TESTED,
    Address,
    make_own,
    places,
    sender_of,
)

_TICK = 0.1  # s, at which a listener looks whether it should end
_CLOSES = 10.0  # s, until nobody waits for the listener any more
_LOOK = 0.25  # s, between looks whether its sockets are still there
_ASK = 0.01  # s, between questions whether the vehicles confirm
_CONFIRMED = 0.8  # s, within which they must
_REPEAT = 10.0  # s, until the same trouble is worth telling again
_TESTS = 0.2  # s, between rehearsals that are taken note of
_MOST_WAITING = 64  # who wait for a confirmation
_LONGEST = 2048  # bytes of a message


class SocketSource:
    """Listens for ``crazyarena estop`` from other shells of the same user.

    Whatever arrives is a stop, except ``{"test": true}``, which is a rehearsal, and ``{"land":
    true}``, which asks to land. Nothing that
    arrives ends the listener. A socket that was removed or shut off is put back, and people are
    told.

    Parameters
    ----------
    folder: the only place to listen at; by default every one of :func:`places`, and the
        abstract socket.
    say: told of trouble, in words, from the listener's thread.
    land: brings down what flies, if anything can; given the reason.

    Raises
    ------
    InputError: no socket can be made anywhere.
    """

    def __init__(
        self,
        stop: StopButton,
        folder: Path | None = None,
        say: Callable[[str], None] = say_loudly,
        land: Callable[[str], None] | None = None,
    ) -> None:
        self._stop = stop
        self._say = say
        self._land = land
        self._clock = WallClock()
        self._said: dict[str, float] = {}
        # Not by pid alone: containers that share a folder count theirs from one.
        self.name = f"estop-{os.getpid()}-{secrets.token_hex(3)}.sock"
        self._doors: list[_Door] = []
        self._abstract = _open_abstract(self.name) if folder is None else None
        self._waiting: dict[tuple[int, Address], tuple[socket.socket, Address]] = {}
        self._until = self._tested = self._looked = -1.0
        troubles = []
        for place in places() if folder is None else [folder]:
            door = _Door(place, self.name, ours=folder is None)
            trouble = door.open()
            if trouble is None:
                self._doors.append(door)
            else:
                troubles.append(trouble)
        if not self._doors and (self._abstract is None or folder is not None):
            raise InputError(
                f"cannot listen for stops from other shells: {'; '.join(troubles)}. Set "
                "XDG_RUNTIME_DIR to a folder of yours with a short name"
            )
        if troubles:
            where = "elsewhere" if self._doors else "without a file"
            self._tell(f"not listening there for stops: {'; '.join(troubles)}; listening {where}")
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="estop-socket", daemon=True)
        self._thread.start()

    @property
    def path(self) -> Path | None:
        """Where the first of its sockets lies, if any does."""
        return self._doors[0].path if self._doors else None

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                self._turn()
            except Exception as error:  # whatever it is, the next stop must be heard
                self._tell(f"the listener for stops: {type(error).__name__}: {error}")
                self._closed.wait(_ASK)
        # By the thread that uses them: what is shut under a late one would be mended again.
        for door in self._doors:
            door.close()
        if self._abstract is not None:
            self._abstract.close()

    def _turn(self) -> None:
        sockets = [door.socket for door in self._doors if door.socket is not None]
        if self._abstract is not None:
            sockets.append(self._abstract)
        ready, _, _ = select.select(sockets, [], [], _ASK if self._waiting else _TICK)
        for listening in ready:
            self._hear(listening)
        self._confirm()
        now = self._clock.now()
        if now - self._looked >= _LOOK:
            self._looked = now
            for door in self._doors:
                trouble = door.mend()
                if trouble is not None:
                    self._tell(trouble)

    def _hear(self, listening: socket.socket) -> None:
        try:
            payload, extra, _, sender = listening.recvmsg(
                _LONGEST, socket.CMSG_SPACE(CREDENTIALS.size), socket.MSG_DONTWAIT
            )
        except (BlockingIOError, InterruptedError):
            return
        user = sender_of(extra)
        if listening is self._abstract and user not in _heeded():
            self._answer(listening, sender, f"{REFUSED}: of another user")
            return
        fields = _fields(payload)
        if fields.get("test") is True:
            now = self._clock.now()
            if now - self._tested >= _TESTS:  # it may be written down, which takes time
                self._tested = now
                self._stop.tested()
            self._answer(listening, sender, TESTED)
            return
        given = fields.get("reason")
        reason = shown_line(given) if isinstance(given, str) else ""
        if fields.get("land") is True:
            if self._land is None:
                self._answer(listening, sender, f"{REFUSED}: nothing here can land it")
            else:
                self._land(reason)
                self._answer(listening, sender, LANDING)
            return
        self._stop.trigger("shell", reason)
        self._answer(listening, sender, HEARD)
        if sender and len(self._waiting) < _MOST_WAITING:
            if not self._waiting:
                self._until = self._clock.now() + _CONFIRMED
            self._waiting[listening.fileno(), sender] = (listening, sender)
        self._confirm()

    def _confirm(self) -> None:
        """Tell who waits for it what became of the stop, once that is known."""
        if not self._waiting:
            return
        outcome = self._stop.outcome(final=self._clock.now() >= self._until)
        if outcome is None:
            return
        for listening, sender in self._waiting.values():
            self._answer(listening, sender, outcome)
        self._waiting.clear()

    def _answer(self, listening: socket.socket, sender: Address, text: str) -> None:
        # Who does not take the answer must not keep others from being heard.
        if sender:
            with contextlib.suppress(OSError):
                answer = f"{self.name}\n{text}".encode("utf-8", "replace")
                listening.sendto(answer, socket.MSG_DONTWAIT, sender)

    def _tell(self, text: str) -> None:
        now = self._clock.now()
        if now - self._said.get(text, -_REPEAT) >= _REPEAT:
            self._said[text] = now
            with contextlib.suppress(Exception):
                self._say(text)

    def close(self) -> None:
        """Idempotent."""
        self._closed.set()
        self._thread.join(timeout=_CLOSES)


class _Door:
    """One socket of a listener that lies in a folder."""

    def __init__(self, folder: Path, name: str, ours: bool) -> None:
        self.path = folder / name
        self.socket: socket.socket | None = None
        self._ours = ours  # the folder is for nothing else
        self._inode = 0

    def open(self) -> str | None:
        """Returns what is wrong."""
        if self._ours:
            trouble = make_own(self.path.parent)
            if trouble is not None:
                return trouble
        opened = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            opened.bind(str(self.path))
            self.path.chmod(0o600)
            self._inode = self.path.lstat().st_ino
        except OSError as error:
            opened.close()
            return f"{self.path}: {error.strerror or error}"
        if self.socket is not None:
            self.socket.close()
        self.socket = opened
        return None

    def mend(self) -> str | None:
        """Put right what somebody has done to it; returns what that was, in words."""
        folder = self.path.parent
        what = None
        if self._ours and folder.is_dir() and stat.S_IMODE(folder.lstat().st_mode) != 0o700:
            trouble = make_own(folder)
            if trouble is not None:
                return f"STOPS MAY NOT BE HEARD HERE: somebody changed {trouble}"
            what = f"somebody changed the permissions of {folder}: put back"
        try:
            status = self.path.lstat()
            if stat.S_ISSOCK(status.st_mode) and status.st_ino == self._inode:
                if stat.S_IMODE(status.st_mode) != 0o600:
                    self.path.chmod(0o600)
                    what = f"somebody changed the permissions of {self.path}: put back"
                return what
            self.path.unlink()
        except FileNotFoundError:
            pass
        except OSError as error:
            return f"STOPS MAY NOT BE HEARD HERE: {self.path}: {error.strerror or error}"
        trouble = self.open()
        if trouble is not None:
            return f"STOPS MAY NOT BE HEARD HERE: somebody removed the stop socket; {trouble}"
        return f"somebody removed the stop socket {self.path}: listening again"

    def close(self) -> None:
        if self.socket is not None:
            self.socket.close()
            self.socket = None
        with contextlib.suppress(OSError):
            self.path.unlink()


def _open_abstract(name: str) -> socket.socket | None:
    """A socket without a file, whose senders the kernel names; None where there is no such."""
    if not LINUX or os.environ.get(ONLY_PLACE):
        return None
    opened = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        opened.bind(f"\0{ABSTRACT}{os.getuid()}/{name}")
    except OSError:
        opened.close()
        return None
    return opened


def _heeded() -> set[int]:
    """Users whose stops count: this one, the super-user, and who became this one by sudo."""
    users = {os.getuid(), 0}
    with contextlib.suppress(ValueError):
        users.add(int(os.environ.get("SUDO_UID", "")))
    return users


def _fields(payload: bytes) -> dict[str, Any]:
    try:
        fields = json.loads(payload)
    except (ValueError, RecursionError):
        return {}
    return fields if isinstance(fields, dict) else {}
