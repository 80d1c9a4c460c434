"""Errors a user can cause, and so must be able to read.

Every message names the file (or vehicle), the field, what was found and what would be right.
The command line turns any :class:`CrazyarenaError` into one line and exit code 2.
"""

from __future__ import annotations

from pathlib import Path

from crazyarena.plain_text import shown


class CrazyarenaError(Exception):
    """Base of all errors that describe wrong input or a refused action.

    What it quotes of a file or a contestant is shown with control characters escaped, so that
    neither the command line nor a script's traceback hands them to a terminal.
    """

    def __str__(self) -> str:
        return shown(super().__str__())


class InputError(CrazyarenaError):
    """A file, option or submission is wrong; nothing has flown."""


class CommandError(CrazyarenaError, ValueError):
    """A flight command has a wrong type, shape, range or a number that is not finite."""


class BackendError(CrazyarenaError):
    """A vehicle link cannot be opened, was lost, or refused an action."""


class StorageError(CrazyarenaError):
    """A file cannot be written, most often because the disk is full; what was there is there."""

    @classmethod
    def of(cls, path: Path, error: OSError) -> StorageError:
        """From what the system said about a file."""
        return cls(f"{path}: cannot write it: {error.strerror or error}")


class DependencyMissing(CrazyarenaError):
    """An optional package is not installed.

    Parameters
    ----------
    package: name on PyPI.
    extra: the extra of this distribution that brings it, e.g. ``"mocap"``.
    """

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        super().__init__(
            f"{purpose} needs the package '{package}', which is not installed; "
            f"install it with: pip install 'crazyarena[{extra}]'"
        )
