"""``python -m crazyarena`` and the console script ``crazyarena``."""

from __future__ import annotations

import os


def main() -> None:
    """Run the command line."""
    # Before NumPy is imported: the matrices of a control loop are small, and threads that spin
    # for them steal the core that the simulation or the radio runs on.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from crazyarena.runner.cli import make_app

    make_app()()


if __name__ == "__main__":
    main()
