"""What people have tried by hand before a flight, remembered from one command to the next.

``crazyarena preflight`` has somebody pull the emergency stop and tip the vehicle; ``crazyarena
fly`` a minute later should not ask for it again. Kept in the user's runtime folder, which goes
with the login.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from crazyarena.errors import InputError
from crazyarena.safety.estop_local import runtime_folder

_FILE = "rehearsed.json"
_STOP = "stop"
_BODIES = "bodies"


class Rehearsals:
    """Times at which things were tried.

    Parameters
    ----------
    folder: of the record; that of the user's stop sockets by default.
    wall: Unix time.
    """

    def __init__(self, folder: Path | None = None, wall: Callable[[], float] = time.time) -> None:
        self._wall = wall
        self._file: Path | None = None  # where nothing can be kept, nothing was tried
        with contextlib.suppress(InputError):
            self._file = (folder or runtime_folder()) / _FILE

    def note_stop(self) -> None:
        """An emergency stop was tried now."""
        self._change({_STOP: self._wall()})

    def stop_age(self) -> float:
        """s since it was; inf if never."""
        return self._age(self._read().get(_STOP))

    def note_body(self, uri: str, body: str, turned: float | None = None) -> None:
        """The vehicle at ``uri`` was seen to be this body now, with its nose ``turned`` rad from
        the vehicle's; no other vehicle is, then."""
        bodies = {k: v for k, v in self._bodies().items() if v[0] != body}
        self._change({_BODIES: {**bodies, uri: [body, self._wall(), turned]}})

    def body(self, uri: str) -> tuple[str | None, float]:
        """Body that the vehicle at ``uri`` was last seen to be, and s since then."""
        name, when, *_ = self._bodies().get(uri, (None, None))
        return name, self._age(when)

    def turned(self, uri: str) -> float | None:
        """rad between the noses of that body and the vehicle; None if nobody has told."""
        _, _, *turned = self._bodies().get(uri, (None, None))
        known = turned and isinstance(turned[0], int | float) and math.isfinite(turned[0])
        return float(turned[0]) if known else None

    def _bodies(self) -> dict[str, Any]:
        found = self._read().get(_BODIES)
        if not isinstance(found, dict):
            return {}
        return {k: v for k, v in found.items() if isinstance(v, list) and len(v) in (2, 3)}

    def _age(self, when: Any) -> float:
        # A time in the future is that of a clock that was set: it says nothing.
        age = self._wall() - when if isinstance(when, int | float) else math.inf
        return age if age >= 0.0 else math.inf

    def _read(self) -> dict[str, Any]:
        if self._file is None:
            return {}
        try:
            found = json.loads(self._file.read_bytes())
        except (OSError, ValueError, RecursionError):
            return {}
        return found if isinstance(found, dict) else {}

    def _change(self, entries: dict[str, Any]) -> None:
        if self._file is None:
            return
        part = self._file.with_name(f"{_FILE}.{os.getpid()}")
        # What cannot be remembered is asked for again.
        with contextlib.suppress(OSError):
            part.write_text(json.dumps({**self._read(), **entries}))
            part.replace(self._file)
