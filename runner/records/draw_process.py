"""The process that draws: takes pickled jobs from its parent, answers each with a line of JSON."""

from __future__ import annotations

import contextlib
import json
import pickle
import signal
import sys
from pathlib import Path
from typing import Any

from crazyarena.errors import StorageError
from crazyarena.runner.records.figure import save_figure
from crazyarena.runner.records.picture import Picture
from crazyarena.runner.records.sheet import save_sheet


def main() -> None:
    """Draw until the parent closes its end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent says when it is over
    jobs, answers = sys.stdin.buffer, sys.stdout
    sys.stdout = sys.stderr
    with contextlib.suppress(ImportError):
        import matplotlib.backends.backend_agg
        import matplotlib.collections
        import matplotlib.figure  # noqa: F401 - loaded while the first episode flies
    while True:
        try:
            file, what = pickle.load(jobs)
        except EOFError:
            return
        answers.write(json.dumps(_draw(file, what)) + "\n")
        answers.flush()


def _draw(file: Path, what: tuple[Any, ...]) -> str | None:
    try:
        if len(what) == 1 and isinstance(what[0], Picture):
            save_figure(file, what[0])
        else:
            save_sheet(file, *what)
    except StorageError as error:
        return str(error)
    except Exception as error:
        return f"{file}: not drawn: {type(error).__name__}: {error}"
    return None
