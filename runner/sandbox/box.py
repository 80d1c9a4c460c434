"""A contestant's own files: a private copy of the submission, a home, a folder for temporaries."""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from crazyarena.errors import InputError
from crazyarena.runner.contestant import entry_file

_LEFT_OUT = {"__pycache__", ".git", "results", "runs"}


class Box:
    """Folder tree of one contestant, in the machine's folder for temporaries.

    Attributes
    ----------
    root: holds all of it. submission: the copy, a folder or a .py file. work: where the
        contestant runs. home, tmp: for HOME and TMPDIR. output: what it prints.
    """

    def __init__(self, submission: Path, limit: int) -> None:
        self.root = Path(tempfile.mkdtemp(prefix="crazyarena-contestant-"))
        try:
            self.work, self.home, self.tmp = (
                self._folder(name) for name in ("work", "home", "tmp")
            )
            self.output = self.root / "output.txt"
            self.output.touch(mode=0o600)
            self.submission = self._copy(submission, limit)
        except BaseException:
            self.remove()
            raise

    def _folder(self, name: str) -> Path:
        folder = self.root / name
        folder.mkdir(mode=0o700)
        return folder

    def _copy(self, submission: Path, limit: int) -> Path:
        entry = entry_file(submission)
        single = not submission.is_dir()
        # The name of the folder counts: entries import themselves by it.
        target = self.root / "copy" / entry.parent.name
        target.mkdir(parents=True)
        source = entry.parent
        files = source.glob("*.py") if single else _files(source)
        size = 0
        for file in files:
            # A link could make the runner, who may read everything, copy something secret.
            if file.is_symlink() and not file.resolve().is_relative_to(source.resolve()):
                continue
            if not file.is_file():
                continue
            size += file.stat().st_size
            if size > limit:
                raise InputError(
                    f"{submission}: more than {limit // 2**20} MiB; too much for a submission"
                )
            place = target / file.relative_to(source)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, place)
        return target / entry.name if single else target

    def give_to(self, uid: int, gid: int) -> None:
        """Make the contestant's user the owner of everything in here."""
        self.root.chmod(0o755)
        for folder, folders, files in os.walk(self.root):
            for name in (*folders, *files):
                os.chown(os.path.join(folder, name), uid, gid, follow_symlinks=False)
        os.chown(self.output, 0, 0)

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

        def make_writable(function: object, path: str, error: object) -> None:
            with contextlib.suppress(OSError):
                os.chmod(os.path.dirname(path), stat.S_IRWXU)
                os.unlink(path)

        shutil.rmtree(self.root, onerror=make_writable)
        shutil.rmtree(self.root, ignore_errors=True)


def _files(folder: Path) -> Iterator[Path]:
    for root, folders, files in os.walk(folder):
        folders[:] = [f for f in folders if f not in _LEFT_OUT and not f.startswith(".")]
        for name in files:
            if not name.startswith("."):
                yield Path(root) / name
