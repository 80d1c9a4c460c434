"""Environment variables of a contestant's process: nothing of the judge's but what it needs."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping

from crazyarena.runner.contestant.dialogue import PARAMETERS
from crazyarena.runner.contestant.sandbox.box import Box
from crazyarena.runner.contestant.sandbox.confine import ACADOS, acados_folder

_THREADS = (
    "OPENBLAS_NUM_THREADS",
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMBA_NUM_THREADS",
)


def environment(box: Box, parameters: Mapping[str, object]) -> dict[str, str]:
    """Everything the process finds in its environment; homes and caches lie in its box."""
    kept = {k: os.environ[k] for k in ("PATH", "LANG", "LC_ALL", "TZ") if k in os.environ}
    acados = acados_folder()
    if acados is not None:
        kept[ACADOS] = str(acados)
        kept["LD_LIBRARY_PATH"] = str(acados / "lib")
    return {
        **kept,
        "HOME": str(box.home),
        # Its user has no name of its own that libraries could look up.
        "USER": "contestant",
        "LOGNAME": "contestant",
        "TMPDIR": str(box.tmp),
        "XDG_CACHE_HOME": str(box.home / ".cache"),
        "NUMBA_CACHE_DIR": str(box.home / ".numba"),
        "MPLCONFIGDIR": str(box.home / ".matplotlib"),
        "MPLBACKEND": "Agg",
        # torch.compile would make a file larger than any may be.
        "TORCHINDUCTOR_CPP_CACHE_PRECOMPILE_HEADERS": "0",
        "PYTHONHASHSEED": "0",
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONUNBUFFERED": "1",
        **dict.fromkeys(_THREADS, "1"),
        **({PARAMETERS: json.dumps(parameters)} if parameters else {}),
    }
