"""Draws the pictures of a run in processes of their own, while it goes on flying.

Matplotlib takes longer to draw an episode than a competition level takes to fly it.
"""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import queue
import re
import subprocess
import sys
import threading
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import IO, Any

import crazyarena

_PROGRAM = """import sys; sys.path.append(sys.argv[1])
from crazyarena.runner.records.draw_process import main; main()"""
MANY = 10
"""Episodes that are all drawn; of more, the first, the first failure of each kind, and a contact
sheet of all."""
FAILED = 4
"""Failures that are drawn of more; they may all be as short as a fall."""
_MEASURED = re.compile(r"[-+]?\d+\.\d+")
SHEET = "episodes.png"


class Figures(StrEnum):
    """Which episodes are drawn."""

    AUTO = "auto"
    ALL = "all"
    FAILURES = "failures"
    NONE = "none"

    @classmethod
    def of(cls, wanted: Figures | bool | str) -> Figures:
        """A choice, or yes or no."""
        if isinstance(wanted, bool):
            return cls.AUTO if wanted else cls.NONE
        return cls(wanted)


@dataclass
class Choice:
    """Decides which episodes of a run are drawn, one after the other."""

    wanted: Figures
    episodes: int
    _drawn: int = 0
    _asked: int = 0
    _kinds: set[str] = field(default_factory=set)

    def __call__(self, clean: bool, why: str = "") -> bool:
        """Whether to draw the next episode, which ended for a reason: those that differ in times
        and distances alone are of one kind."""
        self._asked += 1
        kind = _MEASURED.sub("", why)
        new = not clean and kind not in self._kinds
        if self.wanted is Figures.NONE:
            return False
        if self.wanted is Figures.FAILURES:
            yes = not clean
        elif self.wanted is Figures.ALL or self.episodes <= MANY:
            yes = True
        else:
            yes = self._drawn == 0 or (new and self._drawn <= FAILED)
        self._drawn += yes
        if yes and not clean:
            self._kinds.add(kind)
        return yes

    @property
    def left(self) -> int:
        """How many episodes are on the sheet alone."""
        return self._asked - self._drawn if self.wanted is Figures.AUTO else 0

    @property
    def sheet(self) -> bool:
        """Whether there is a contact sheet."""
        return self.wanted is not Figures.NONE and self.episodes > MANY


class Drawer:
    """Processes that draw, started when they are first needed.

    Parameters
    ----------
    workers: how many; by default one, and another where the machine has processors to spare.
    """

    def __init__(self, workers: int | None = None) -> None:
        spare = (os.cpu_count() or 1) - 2
        self._most = workers if workers is not None else max(1, min(4, spare))
        self._jobs: queue.SimpleQueue[tuple[Path, tuple[Any, ...]] | None] = queue.SimpleQueue()
        self._threads: list[threading.Thread] = []
        self._processes: list[subprocess.Popen[bytes]] = []
        self._lock = threading.Lock()
        self.refused: dict[Path, str] = {}
        """Why a picture was not written, by its file."""

    def warm_up(self) -> None:
        """Let a process load what it draws with, so that it is ready when something has flown."""
        if not self._threads:
            self._start()

    def draw(self, file: Path, *what: Any) -> None:
        """Have something drawn: a :class:`~.figure.Picture`, or the arguments of a sheet."""
        self._jobs.put((file, what))
        if len(self._threads) < self._most:
            self._start()

    def finish(self) -> None:
        """Wait until everything is drawn; the processes end."""
        for _ in self._threads:
            self._jobs.put(None)
        for thread in self._threads:
            thread.join()
        self._threads.clear()

    def close(self) -> None:
        """End the processes, whatever is left to draw. Idempotent."""
        with self._lock:
            running = list(self._processes)
        for process in running:
            with contextlib.suppress(OSError):
                process.kill()
        self.finish()

    def _start(self) -> None:
        # Here and not in its thread: nothing is started beside what the main thread may start.
        process = subprocess.Popen(
            # Not by -m: that looks for modules in the folder the user is in, too.
            [sys.executable, "-P", "-c", _PROGRAM, str(Path(crazyarena.__file__).parents[1])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        with self._lock:
            self._processes.append(process)
        thread = threading.Thread(target=self._serve, args=(process,), daemon=True)
        self._threads.append(thread)
        thread.start()

    def _serve(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdin is not None
        assert process.stdout is not None
        while (job := self._jobs.get()) is not None:
            file, what = job
            reason = _asked(process.stdin, process.stdout, file, what)
            if reason is not None:
                self.refused[file] = reason
        with contextlib.suppress(OSError):
            process.stdin.close()
        process.stdout.close()
        process.wait()
        with self._lock:
            self._processes.remove(process)


def _asked(to: IO[bytes], back: IO[bytes], file: Path, what: tuple[Any, ...]) -> str | None:
    """Have a process draw one thing; returns why it did not."""
    try:
        pickle.dump((file, what), to, protocol=pickle.HIGHEST_PROTOCOL)
        to.flush()
        answer = back.readline()
        reason: str | None = json.loads(answer) if answer else "the drawing process has died"
    except (OSError, ValueError, pickle.PicklingError) as error:
        return f"{file}: not drawn: {error}"
    return reason
