"""``python -m crazyarena`` and the console script ``crazyarena``."""

from __future__ import annotations

import os
import sys


def main() -> None:
    """Run the command line."""
    # Before NumPy is imported: the matrices of a control loop are small, and threads that spin
    # for them steal the core that the simulation or the radio runs on.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from crazyarena.runner.cli import make_app

    # A stop must not wait for what other commands import.
    make_app(only="estop" if sys.argv[1:2] == ["estop"] else None)()


if __name__ == "__main__":
    main()
