"""A contestant's own files: a private copy of the submission, a home, a folder for temporaries."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from crazyarena.errors import InputError
from crazyarena.runner.contestant.submission import entry_file

_LEFT_OUT = {"__pycache__", ".git", "results", "runs"}
_PREFIX = "crazyarena-contestant-"
_BLOCK = 4096  # bytes; what the smallest file takes
_YOUNG = 3600.0  # s; a folder without a lock may be one that is just being made


class Box:
    """Folder tree of one contestant, in the machine's folder for temporaries.

    ``bundle`` is a folder above the submission, a file, that is copied with all that is in it.
    It is locked while its owner lives; making one removes those whose owners were killed.

    Attributes
    ----------
    root: holds all of it. files: what the contestant may change, and in it
        submission: the copy, a folder or a .py file; work: where the contestant runs;
        home, tmp: for HOME and TMPDIR. given: empty, where ``files`` can be seen when a file
        system of the contestant's own lies over it; root, empty, is where a root of its own is
        made. output: what it prints.
    size, count: bytes on disk and number of the files and folders that it is given.
    """

    def __init__(self, submission: Path, limit: int, bundle: Path | None = None) -> None:
        self.root = Path(tempfile.mkdtemp(prefix=_PREFIX))
        self._lock: int | None = _lock(self.root)
        remove_abandoned(self.root.parent, self.root.stat().st_mtime)
        self.size = self.count = 0
        try:
            self.files = self._folder("files")
            self.given = self._folder("given")
            self._folder("root")
            self.work, self.home, self.tmp = (
                self._folder(f"files/{name}") for name in ("work", "home", "tmp")
            )
            self.output = self.root / "output.txt"
            self.output.touch(mode=0o600)
            self.submission = self._copy(submission, limit, bundle)
        except BaseException:
            self.remove()
            raise

    def _folder(self, name: str) -> Path:
        folder = self.root / name
        folder.mkdir(mode=0o700)
        self.size += _BLOCK
        self.count += 1
        return folder

    def _copy(self, submission: Path, limit: int, bundle: Path | None) -> Path:
        entry = submission if bundle is not None else entry_file(submission)
        single = not submission.is_dir() and bundle is None
        source = entry.parent if bundle is None else bundle
        # The name of the folder counts: entries import themselves by it.
        target = self._folder("files/copy") / source.name
        target.mkdir()
        # What lies beside a single file is somebody else's.
        files = [entry] if single else _files(source)
        size = 0
        for file in files:
            # A link could make the runner, who may read everything, copy something secret.
            if file.is_symlink() and not file.resolve().is_relative_to(source.resolve()):
                continue
            if not file.is_file():
                continue
            length = file.stat().st_size
            size += length
            self.size += -(-length // _BLOCK) * _BLOCK
            self.count += 1
            if size > limit:
                raise InputError(
                    f"{submission}: more than {limit // 2**20} MiB with what lies beside it; too "
                    "much for a submission. Put it into a folder of its own"
                )
            place = target / file.relative_to(source)
            if not place.parent.exists():
                place.parent.mkdir(parents=True)
                self.count += len(place.relative_to(target).parents)
            shutil.copyfile(file, place)
        if bundle is not None:
            return target / entry.relative_to(bundle)
        return target / entry.name if single else target

    def give_to(self, uid: int, gid: int) -> None:
        """Make the contestant's user the owner of everything in here."""
        for folder in (self.root, self.given):
            folder.chmod(0o755)
        os.chown(self.files, uid, gid)
        for place, folders, files in os.walk(self.files):
            for name in (*folders, *files):
                os.chown(os.path.join(place, name), uid, gid, follow_symlinks=False)

    def last_output(self, size: int = 8192) -> str:
        """End of what the contestant printed."""
        try:
            with open(self.output, "rb") as stream:
                stream.seek(0, os.SEEK_END)
                stream.seek(max(0, stream.tell() - size))
                return stream.read().decode(errors="replace")
        except OSError:
            return ""

    def remove(self) -> None:
        """Delete everything; idempotent."""
        _remove(self.root)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def _lock(root: Path) -> int:
    """Make the lock file of a folder; held until the returned file is closed."""
    new = root / "new-lock"
    file = os.open(new, os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_CLOEXEC, 0o600)
    fcntl.flock(file, fcntl.LOCK_EX)
    # Nobody ever sees it unlocked while its owner lives.
    new.rename(root / "lock")
    return file


def remove_abandoned(parent: Path, now: float) -> list[Path]:
    """Remove the folders in ``parent`` whose owners were killed; returns them.

    ``now`` is the present time as files are stamped with it, s.
    """
    removed = []
    for entry in os.scandir(parent):
        if not entry.name.startswith(_PREFIX):
            continue
        with contextlib.suppress(OSError):
            status = entry.stat(follow_symlinks=False)
            if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid():
                continue
            if _is_abandoned(entry.path, now - status.st_mtime):
                _remove(Path(entry.path))
                removed.append(Path(entry.path))
    return removed


def _is_abandoned(folder: str, age: float) -> bool:
    try:
        file = os.open(os.path.join(folder, "lock"), os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    except FileNotFoundError:
        return age > _YOUNG
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    finally:
        os.close(file)
    return True


def _remove(root: Path) -> None:
    """Delete a tree that somebody else has made, however deep it is.

    Neither recursion nor paths may grow with it: folders in folders are moved up first.
    """
    pending, count = [root], 0
    looked_at: set[Path] = set()
    while pending:
        folder = pending[-1]
        if folder in looked_at:
            pending.pop()
            with contextlib.suppress(OSError):
                folder.rmdir()
            continue
        looked_at.add(folder)
        inside: list[os.DirEntry[str]] = []
        with contextlib.suppress(OSError):
            folder.chmod(stat.S_IRWXU)
            with os.scandir(folder) as entries:
                inside = list(entries)
        for entry in inside:
            with contextlib.suppress(OSError):
                if not entry.is_dir(follow_symlinks=False):
                    os.unlink(entry.path)
                    continue
                os.chmod(entry.path, stat.S_IRWXU)
                count += 1
                place = root / f"removed-{count}"
                os.rename(entry.path, place)
                pending.append(place)


def _files(folder: Path) -> Iterator[Path]:
    for root, folders, files in os.walk(folder):
        folders[:] = [f for f in folders if f not in _LEFT_OUT and not f.startswith(".")]
        for name in files:
            if not name.startswith("."):
                yield Path(root) / name
