"""``python -m crazyarena`` and the console script ``crazyarena``."""

from __future__ import annotations


def main() -> None:
    """Run the command line."""
    from crazyarena.runner.cli import make_app

    make_app()()


if __name__ == "__main__":
    main()
