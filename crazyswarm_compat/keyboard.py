"""Single key strokes from the terminal, without waiting for Enter."""

from __future__ import annotations

import select
import sys
from types import TracebackType
from typing import Any


class KeyPoller:
    """Context manager; :meth:`poll` returns the next character, or None if there is none.

    Where the input is not a terminal, characters come as they are piped in; ``ended`` is then
    True once the input has come to its end.
    """

    def __init__(self) -> None:
        self.ended = False
        self._restore: Any = None

    def __enter__(self) -> KeyPoller:
        if sys.stdin is None or sys.stdin.closed:
            self.ended = True
        elif sys.stdin.isatty():
            import termios
            import tty

            descriptor = sys.stdin.fileno()
            self._restore = (descriptor, termios.tcgetattr(descriptor))
            tty.setcbreak(descriptor)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._restore is not None:
            import termios

            descriptor, attributes = self._restore
            termios.tcsetattr(descriptor, termios.TCSADRAIN, attributes)
            self._restore = None

    def poll(self) -> str | None:
        """Next character, or None."""
        if self.ended:
            return None
        try:
            ready, _, _ = select.select([sys.stdin], [], [], 0)
        except (OSError, ValueError):  # no descriptor behind it, so nobody can press a key
            self.ended = True
            return None
        if not ready:
            return None
        character = sys.stdin.read(1)
        if not character:
            self.ended = True
            return None
        return character
