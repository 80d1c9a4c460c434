"""What a flight shows of itself while it flies, for viewers in processes of their own.

A :class:`Live` is a file in memory with three slots (the scene, the newest state, a viewer's
reply) and the paths flown. Publishing costs some ten microseconds, never waits, and does not
depend on whether anybody looks. :class:`Watched` is the other end.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import secrets
import stat
import struct
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazyarena.errors import InputError
from crazyarena.slot import HEAD, Slot

try:
    import fcntl
except ImportError:  # no such locks; then whether a flight lives is told by its last word alone
    fcntl = None  # type: ignore[assignment]

ID, POSITION, QUATERNION, VELOCITY, SETPOINT, STOP, COLOUR = 0, 1, 4, 8, 11, 14, 17
"""Columns of a vehicle's row: id, position 3 m, quaternion x y z w, velocity 3 m/s, setpoint 3 m,
where it would come to rest 3 m, colour 3 (0..1). NaN where nobody knows."""
COLUMNS = 20
MOST_VEHICLES = 256

_MAGIC = b"CRAZYLV1"
_HEADER = struct.Struct("<8sQQ")  # magic, vehicles, points of each path
_PATH = struct.Struct("<QQ")  # episode, points since its beginning
_SCENE, _STATE, _REPLY = 2 << 20, 256 << 10, 4 << 10
_POINTS = 65536  # of all paths together
_LONGEST = 8192  # points of one
_SUFFIX = ".live"
ONLY_PLACE = "CRAZYARENA_RUNTIME_DIR"


class _Layout(NamedTuple):
    scene: int
    state: int
    reply: int
    path: int
    points: int
    end: int


def _layout(vehicles: int, length: int) -> _Layout:
    scene = 64
    state = scene + HEAD + _SCENE
    reply = state + HEAD + _STATE
    path = reply + HEAD + _REPLY
    points = path + 64
    return _Layout(scene, state, reply, path, points, points + vehicles * length * 12)


def live_folder() -> Path:
    """Folder of this user's live flights, closed to others; in memory where there is such.

    Raises
    ------
    InputError: there is no place for one.
    """
    name = f"crazyarena-live-{os.getuid() if hasattr(os, 'getuid') else 'user'}"
    only = os.environ.get(ONLY_PLACE)
    # Of a file on a disk, pages that are being written out could make the flight wait.
    bases = [only] if only else ["/dev/shm", os.environ.get("XDG_RUNTIME_DIR")]
    troubles = []
    for base in (*bases, None if only else tempfile.gettempdir()):
        if not base or not Path(base).is_dir():
            continue
        folder = Path(base) / name
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
            status = folder.lstat()
            if not stat.S_ISDIR(status.st_mode):
                troubles.append(f"{folder} is no folder")
            elif hasattr(os, "getuid") and status.st_uid != os.getuid():
                troubles.append(f"{folder} belongs to somebody else")
            else:
                if stat.S_IMODE(status.st_mode) != 0o700:
                    folder.chmod(0o700)
                return folder
        except OSError as error:
            troubles.append(f"{folder}: {error.strerror or error}")
    raise InputError(
        f"no folder for what a viewer is shown: {'; '.join(troubles) or 'none is there'}. "
        f"Set {ONLY_PLACE}"
    )


def _lock(descriptor: int) -> bool:
    """Take the lock of a flight that lives; False if somebody has it."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def live_flights(folder: Path | None = None) -> list[Path]:
    """Flights of this user that go on now, newest last; remains of dead ones are removed."""
    found = []
    for file in sorted((folder or live_folder()).glob(f"*{_SUFFIX}")):
        with contextlib.suppress(OSError):
            descriptor = os.open(file, os.O_RDWR)
            try:
                # An empty one is being made.
                if os.fstat(descriptor).st_size and _lock(descriptor):
                    file.unlink()
                else:
                    found.append((file.stat().st_mtime, file))
            finally:
                os.close(descriptor)
    return [file for _, file in sorted(found)]


class Live:
    """What a flight publishes of itself.

    Parameters
    ----------
    vehicles: how many it shows, at most :data:`MOST_VEHICLES`.
    folder: for the file; :func:`live_folder` by default.

    Raises
    ------
    InputError: too many vehicles, or nowhere to put it.
    """

    def __init__(self, vehicles: int = 1, folder: Path | None = None) -> None:
        if not 1 <= vehicles <= MOST_VEHICLES:
            raise InputError(f"viewer: {vehicles} vehicles; it shows 1 to {MOST_VEHICLES}")
        place = folder or live_folder()
        with contextlib.suppress(OSError):
            live_flights(place)  # clears what died
        self.vehicles = vehicles
        length = min(_LONGEST, _POINTS // vehicles)
        self.file = place / f"{os.getpid()}-{secrets.token_hex(3)}{_SUFFIX}"
        layout = _layout(vehicles, length)
        try:
            self._descriptor = os.open(self.file, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
            _lock(self._descriptor)
            os.ftruncate(self._descriptor, layout.end)
            self._memory = mmap.mmap(self._descriptor, layout.end)
        except OSError as error:
            raise InputError(f"viewer: {self.file}: {error.strerror or error}") from error
        self._scene = Slot(self._memory, layout.scene, _SCENE)
        self._state = Slot(self._memory, layout.state, _STATE)
        self._reply = Slot(self._memory, layout.reply, _REPLY)
        self._path_at = layout.path
        self._points = np.frombuffer(
            self._memory, np.float32, vehicles * length * 3, layout.points
        ).reshape(vehicles, length, 3)
        self._episode = self._count = 0
        self.rows = np.full((vehicles, COLUMNS), np.nan)
        """What :meth:`publish` tells of the vehicles; (n, COLUMNS), see :data:`ID`."""
        self.rows[:, ID] = np.arange(1, vehicles + 1)
        self.rows[:, QUATERNION : QUATERNION + 4] = (0.0, 0.0, 0.0, 1.0)
        # Last: from now on it is found.
        self._memory[: _HEADER.size] = _HEADER.pack(_MAGIC, vehicles, length)

    def scene(self, scene: Mapping[str, Any]) -> None:
        """Replace what stands still; see docs/viewer.md for its fields."""
        data = json.dumps(scene).encode()
        if len(data) > _SCENE:
            data = json.dumps({"title": scene.get("title", "")}).encode()
        self._scene.put(data)

    def begin(self) -> None:
        """A new episode: the paths begin anew."""
        self._episode += 1
        self._count = 0
        _PATH.pack_into(self._memory, self._path_at, self._episode, 0)

    def extend(self, positions: ArrayLike | None = None) -> None:
        """Add a point to every path: (n, 3) m, those of ``rows`` by default."""
        if positions is None:
            positions = self.rows[:, POSITION : POSITION + 3]
        self._points[:, self._count % self._points.shape[1]] = positions
        self._count += 1
        _PATH.pack_into(self._memory, self._path_at, self._episode, self._count)

    def publish(self, facts: Mapping[str, Any]) -> None:
        """Show ``rows`` and these facts (plain data) from now on."""
        words = json.dumps(facts).encode()
        numbers = self.rows.tobytes()
        if 4 + len(words) + len(numbers) > _STATE:
            words = json.dumps({"time": facts.get("time"), "phase": facts.get("phase")}).encode()
        self._state.put(struct.pack("<I", len(words)) + words + numbers)

    def reply(self) -> dict[str, Any]:
        """What a viewer says: ``browsers``, ``confirm`` (of which question), and its ``beat``."""
        return _decoded(self._reply.get())

    def close(self) -> None:
        """The flight is over; viewers keep what they saw last. Idempotent."""
        if self._descriptor < 0:
            return
        with contextlib.suppress(OSError):
            self.file.unlink()
        os.close(self._descriptor)
        self._descriptor = -1
        # The map itself goes with the last array that looks into it.
        self._points = np.empty((self.vehicles, self._points.shape[1], 3), np.float32)
        self._path_at = -1
        with contextlib.suppress(BufferError):
            self._memory.close()

    @property
    def closed(self) -> bool:
        return self._descriptor < 0


class State(NamedTuple):
    """One moment: facts as published, and (n, COLUMNS) rows of the vehicles."""

    facts: dict[str, Any]
    rows: NDArray[np.float64]


class Watched:
    """A live flight as a viewer sees it.

    Raises
    ------
    InputError: ``file`` is none.
    """

    def __init__(self, file: Path) -> None:
        try:
            self._descriptor = os.open(file, os.O_RDWR)
            self._memory = mmap.mmap(self._descriptor, 0)
        except (OSError, ValueError) as error:
            raise InputError(f"{file}: no live flight: {error}. Is it still flying?") from None
        head = bytes(self._memory[: _HEADER.size])
        magic, vehicles, length = _HEADER.unpack(head) if len(head) == _HEADER.size else (b"", 0, 0)
        known = magic == _MAGIC and 1 <= vehicles <= MOST_VEHICLES and 1 <= length <= _LONGEST
        layout = _layout(vehicles, length) if known else None
        if layout is None or len(self._memory) < layout.end:
            raise InputError(f"{file}: no live flight of this version of crazyarena")
        self.file = file
        self.vehicles = vehicles
        self._scene = Slot(self._memory, layout.scene, _SCENE)
        self._state = Slot(self._memory, layout.state, _STATE)
        self._reply = Slot(self._memory, layout.reply, _REPLY)
        self._path_at = layout.path
        self._points = np.frombuffer(
            self._memory, np.float32, vehicles * length * 3, layout.points
        ).reshape(vehicles, length, 3)

    @property
    def versions(self) -> tuple[int, int]:
        """Of scene and state; they rise."""
        return self._scene.version, self._state.version

    def scene(self) -> dict[str, Any]:
        """The newest scene; empty before the first."""
        return _decoded(self._scene.get())

    def state(self) -> State | None:
        """The newest state; None before the first."""
        data = self._state.get()
        if data is None or len(data) < 4:
            return None
        (size,) = struct.unpack_from("<I", data)
        facts = _decoded(data[4 : 4 + size])
        numbers = data[4 + size :]
        if len(numbers) != self.vehicles * COLUMNS * 8:
            return None
        rows = np.frombuffer(numbers, np.float64).reshape(self.vehicles, COLUMNS)
        return State(facts, rows)

    def path_version(self) -> tuple[int, int]:
        """Episode, and points since its beginning."""
        episode, count = _PATH.unpack_from(self._memory, self._path_at)
        return episode, count

    def paths(self) -> tuple[NDArray[np.float32], int]:
        """Points (n, k, 3) m flown in this episode, oldest first, and how many there were in all:
        of a long flight only the newest are there still."""
        earlier, before = self.path_version()
        ring = self._points.copy()
        episode, after = self.path_version()
        length = ring.shape[1]
        if episode != earlier:
            return ring[:, :0], 0
        # Those overwritten while they were copied are left out.
        first = max(0, after - length + (after - before if after > length else 0))
        return ring[:, np.arange(first, before) % length], before

    def reply(self, answer: Mapping[str, Any]) -> None:
        """Tell the flight something."""
        self._reply.put(json.dumps(answer).encode())

    @property
    def over(self) -> bool:
        """The flight has ended, in whatever way."""
        if not self.file.exists():
            return True
        if fcntl is None or not _lock(self._descriptor):
            return False
        fcntl.flock(self._descriptor, fcntl.LOCK_UN)
        return True

    def close(self) -> None:
        """Idempotent."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def _decoded(data: bytes | None) -> dict[str, Any]:
    if data is None:
        return {}
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}
