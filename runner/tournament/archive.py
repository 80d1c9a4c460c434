"""Submissions as archives that are known by their contents, and back to files where they fly."""

from __future__ import annotations

import hashlib
import io
import os
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path

from crazyarena.errors import InputError
from crazyarena.runner.contestant.submission import MOST_BYTES, submission_files
from crazyarena.runner.tournament.entries import Entry

_MODE = 0o644
_FILTERS = hasattr(tarfile, "data_filter")  # not in Python up to 3.11.3, such as Debian 12's


def pack(entry: Entry, folder: Path) -> tuple[str, str]:
    """Write ``<sha256>.tar`` of a submission into ``folder``, unless it is there.

    The same files make the same archive, whenever and wherever they were packed.

    Returns
    -------
    SHA-256 of the archive, in hex, and where in it the submission is.

    Raises
    ------
    InputError: a file of it cannot be read, or it is too large. OSError: ``folder`` is full.
    """
    root = _root(entry)
    inside = (root.name or "submission") / entry.path.relative_to(root)
    handle, name = tempfile.mkstemp(dir=folder, prefix=".packing-", suffix=".tar")
    try:
        with os.fdopen(handle, "wb") as stream:
            digest = _write(stream, entry, root)
            stream.flush()
            os.fsync(stream.fileno())
        target = folder / f"{digest}.tar"
        if not target.exists():
            os.chmod(name, _MODE)
            os.rename(name, target)
    finally:
        if os.path.exists(name):
            os.unlink(name)
    return digest, Path(inside).as_posix()


def _root(entry: Entry) -> Path:
    """The folder whose name goes along: submissions import themselves by it."""
    if entry.root is not None:
        return entry.root
    return entry.path if entry.path.is_dir() else entry.path.parent


class _Hashed:
    """A file that knows the digest of what was written to it."""

    def __init__(self, stream: io.BufferedWriter) -> None:
        self._stream = stream
        self.sha = hashlib.sha256()

    def write(self, data: bytes) -> int:
        self.sha.update(data)
        return self._stream.write(data)

    def tell(self) -> int:
        return self._stream.tell()


def _write(stream: io.BufferedWriter, entry: Entry, root: Path) -> str:
    out = _Hashed(stream)
    total = 0
    with tarfile.open(fileobj=out, mode="w|", format=tarfile.PAX_FORMAT) as archive:  # type: ignore[call-overload]
        for file in _files(entry, root):
            try:
                with open(file, "rb") as source:
                    length = os.fstat(source.fileno()).st_size
                    total += length
                    if total > MOST_BYTES:
                        raise InputError(f"{root}: more than {MOST_BYTES // 2**20} MiB")
                    member = tarfile.TarInfo(f"{root.name}/{file.relative_to(root).as_posix()}")
                    member.size, member.mode = length, _MODE
                    archive.addfile(member, source)
            except (OSError, UnicodeEncodeError) as error:
                # What is full is the folder, not the submission.
                if isinstance(error, OSError) and error.filename is None:
                    raise
                reason = getattr(error, "strerror", None) or str(error)
                raise InputError(f"{file}: cannot read this file: {reason}") from None
    return out.sha.hexdigest()


def _files(entry: Entry, root: Path) -> Iterator[Path]:
    if entry.root is None and not entry.path.is_dir():
        yield entry.path
        return
    home = root.resolve()
    for file in submission_files(root):
        # A link could make us, who may read everything, hand out something secret.
        if file.is_symlink() and not file.resolve().is_relative_to(home):
            continue
        yield file


def unpack(archive: Path | bytes, sha: str, folder: Path) -> Path:
    """Files of an archive below ``folder``; returns the folder that holds them.

    Made once: processes side by side share it, and none sees it half done.

    Raises
    ------
    InputError: it is not the archive of that digest.
    """
    target = folder / sha
    if target.is_dir():
        return target
    data = archive if isinstance(archive, bytes) else archive.read_bytes()
    if hashlib.sha256(data).hexdigest() != sha:
        raise InputError(f"archive {sha[:12]}: its contents are not what its name says")
    folder.mkdir(parents=True, exist_ok=True)
    new = Path(tempfile.mkdtemp(dir=folder, prefix=".unpacking-"))
    with tarfile.open(fileobj=io.BytesIO(data)) as stream:
        _extract(stream, new)
    try:
        new.rename(target)
    except OSError:  # another process was first
        if not target.is_dir():
            raise
    return target


def _extract(stream: tarfile.TarFile, folder: Path) -> None:
    """Folders and files, nothing else and nowhere else: what :func:`pack` puts in."""
    if _FILTERS:
        stream.extractall(folder, filter="data")
        return
    for member in stream.getmembers():
        place = Path(member.name)
        if place.is_absolute() or ".." in place.parts or not (member.isfile() or member.isdir()):
            raise InputError(f"archive: {member.name}: not a file or folder below the submission")
        stream.extract(member, folder, set_attrs=False)
