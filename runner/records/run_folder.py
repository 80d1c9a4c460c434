"""The folder of a run: claimed for one run, with a result that is true after every episode."""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import tempfile
from pathlib import Path
from typing import Any

from crazyarena.errors import InputError, StorageError
from crazyarena.plain_text import file_name, shown_in
from crazyarena.whole_file import write_whole

_RESULT = "result.json"
# What runs leave; of other files a folder may hold as many as it likes.
_TRACES = (_RESULT, "compare.json", "*.mcap", "*.mcap.part", "bench_[0-9]*", "dry_[0-9]*")
_RESERVE = 256 * 1024  # bytes, for the result of a run whose recordings have filled the disk


def run_folder(out: Path | None, submission: Path, level: str) -> Path:
    """Make the folder of a run: ``out``, or a new one under ``runs/`` named after both.

    Raises
    ------
    InputError: it cannot be made, or ``out`` holds an older run.
    """
    try:
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            refuse_older_run(out)
            return out.resolve()
        stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
        stem = submission.stem if submission.suffix == ".py" else submission.name
        base = Path("runs") / f"{stamp}-{file_name(stem)}-{level}"
        base.parent.mkdir(parents=True, exist_ok=True)
        out, count = base, 1
        while True:
            # Another run may begin in the same second.
            with contextlib.suppress(FileExistsError):
                out.mkdir()
                return out.resolve()
            count += 1
            out = base.with_name(f"{base.name}-{count}")
    except OSError as error:
        raise InputError(f"--out {out}: cannot make this folder: {error.strerror}") from error


def refuse_older_run(out: Path) -> None:
    """Raise InputError if a run has left something in a folder: results are never mixed."""
    traces = [trace for pattern in _TRACES for trace in sorted(out.glob(pattern))]
    older = next((t for t in traces if t.is_file() or ".mcap" not in t.name), None)
    if older is not None:
        raise InputError(
            f"--out {out}: holds an older run ({older.name}). Pass another folder, or delete it"
        )


class ResultFile:
    """``result.json``, replaced after every episode, in one piece each time.

    Parameters
    ----------
    folder: of the run. It is claimed by the first writing, before anything flies.
    beginning: the document before the first episode; ``episodes`` is empty.

    Raises
    ------
    InputError: another run has claimed the folder meanwhile.
    StorageError: the disk takes nothing.
    """

    def __init__(self, folder: Path, beginning: dict[str, Any]) -> None:
        self.path = folder / _RESULT
        self._texts: list[str] = []
        self._reserve = _reserve(folder)
        try:
            self._claim(folder, json.dumps(shown_in(beginning), indent=2) + "\n")
        except OSError as error:
            raise StorageError.of(self.path, error) from error

    def _claim(self, folder: Path, text: str) -> None:
        """Put the file there if there is none: whole, and only once."""
        number, name = tempfile.mkstemp(prefix=f".{_RESULT}.", dir=folder)
        try:
            with open(number, "w", encoding="utf-8") as stream:
                stream.write(text)
            os.chmod(name, 0o644)
            try:
                os.link(name, self.path)
            except FileExistsError:
                raise InputError(
                    f"--out {folder}: another run writes here. Pass another folder"
                ) from None
            except OSError:  # a file system without links
                os.replace(name, self.path)
        finally:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(name)

    def add(self, episode: dict[str, Any], document: dict[str, Any]) -> None:
        """Write ``document`` with the episodes added so far and ``episode``."""
        self._texts.append(json.dumps(shown_in(episode)))
        # Episodes are turned into text once: a thousand of them would cost a thousand times more.
        head = json.dumps(shown_in({k: v for k, v in document.items() if k != "episodes"}))
        self._write(head[:-1] + ', "episodes": [\n' + ",\n".join(self._texts) + "\n]}\n")

    def finish(self, document: dict[str, Any]) -> None:
        """Write the whole document for the last time."""
        self._write(json.dumps(shown_in(document), indent=2) + "\n")
        self.close()

    def discard(self) -> None:
        """Nothing has flown: leave no trace."""
        self.close()
        with contextlib.suppress(OSError):
            self.path.unlink()

    def close(self) -> None:
        """Give the reserve back. Idempotent."""
        if self._reserve is not None:
            self._reserve.close()
            self._reserve = None

    def _write(self, text: str) -> None:
        try:
            write_whole(self.path, text)
        except StorageError:
            if self._reserve is None:
                raise
            self.close()
            write_whole(self.path, text)


def _reserve(folder: Path) -> Any:
    """A file without a name that holds some space; None where there is no such thing."""
    try:
        file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed when it is needed
    except OSError:
        return None
    try:
        os.posix_fallocate(file.fileno(), 0, _RESERVE)
    except (OSError, AttributeError):
        file.close()
        return None
    return file
