"""``--record DIR``: a script's flight is kept as dry runs are, whatever it flies on."""

from __future__ import annotations

import atexit
import importlib
from pathlib import Path
from typing import Any

# By name: recordings are the runner's business, and a script without this flag never loads it.
_RECORDER = "crazyarena.runner.records.script_recorder"


def record_script(folder: str | None, time_helper: Any, fleet: Any) -> None:
    """Record every vehicle of a fleet into ``folder`` until the script ends; nothing without one.

    Raises
    ------
    InputError: the folder holds an older run, or cannot be written.
    """
    if folder is None:
        return
    recorder = importlib.import_module(_RECORDER).ScriptRecorder(
        Path(folder), [cf.id for cf in fleet.crazyflies], fleet._link, fleet.guard
    )
    observe = getattr(time_helper, "addObserver", None)
    if observe is not None:
        observe(lambda t, _: recorder.take(t))
    else:
        time_helper.while_sleeping(lambda: recorder.take(time_helper.time()))
    atexit.register(recorder.close)
