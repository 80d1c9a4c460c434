"""A child process that is spoken to in lines of JSON."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

from crazyarena.errors import BackendError

Message = dict[str, Any]


class JsonChild:
    """Runs ``python -m module``; messages go to its stdin and come from its stdout.

    Use as a context manager: neither the child nor what it has started outlives it. Nor do they
    get the terminal's Ctrl-C, which is the parent's business.

    Parameters
    ----------
    module: calls :func:`converse`.
    config: its first message.
    log: file for its stderr.
    """

    def __init__(self, module: str, config: Message, log: Path) -> None:
        self._module = module
        self._log = log
        with log.open("w") as errors:
            self._process = subprocess.Popen(
                [sys.executable, "-m", module],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                start_new_session=True,
            )
        self._killed = False
        self._heard: queue.Queue[Message | None] = queue.Queue()
        self._reader = threading.Thread(target=self._read, name=f"from {module}", daemon=True)
        self._reader.start()
        self.tell(config)

    def __enter__(self) -> JsonChild:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with contextlib.suppress(ValueError):  # the last line of a killed child may be short
                self._heard.put(json.loads(line))
        self._heard.put(None)

    def tell(self, message: Message) -> None:
        """Send a message; one that the child does not live to read is lost."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError, ValueError):
            self._process.stdin.write(json.dumps(message) + "\n")
            self._process.stdin.flush()

    def take(self, timeout: float) -> Message:
        """Return the next message.

        Raises
        ------
        BackendError: none comes within ``timeout`` s, or the child has ended.
        """
        try:
            message = self._heard.get(timeout=timeout)
        except queue.Empty:
            raise BackendError(f"{self._module}: silent for {timeout:g} s") from None
        if message is None:
            self._heard.put(None)
            words = self._log.read_text(errors="replace").strip()[-2000:]
            raise BackendError(f"{self._module} has ended: {words or 'without a word'}")
        return message

    def kill(self) -> None:
        """SIGKILL to the child and all that it has started; returns when it is dead."""
        if not self._killed:
            self._killed = True
            # The group is that of its session; it may be alone in it, and have ended.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def close(self) -> None:
        """Kill what still runs and release everything; idempotent."""
        self.kill()
        self._reader.join()
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        self._process.stdout.close()


Tell = Callable[[Message], None]


def converse(talk: Callable[[queue.Queue[Message | None], Tell], None]) -> None:
    """The child's side: ``talk(heard, tell)``.

    ``heard`` delivers what the parent says, then None when nothing more comes, because it said so
    or has died. Whatever else writes to stdout goes to stderr.
    """
    output = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    sys.stdout = sys.stderr  # written line by line: a child that is killed flushes nothing
    heard: queue.Queue[Message | None] = queue.Queue()
    lock = threading.Lock()

    def listen() -> None:
        for line in sys.stdin:
            heard.put(json.loads(line))
        heard.put(None)

    def tell(message: Message) -> None:
        with lock, contextlib.suppress(BrokenPipeError):
            output.write(json.dumps(message) + "\n")
            output.flush()

    threading.Thread(target=listen, name="from parent", daemon=True).start()
    talk(heard, tell)
    output.flush()
