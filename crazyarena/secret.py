"""Secrets that programs share through a file, to prove where their messages come from."""

from __future__ import annotations

from pathlib import Path

from crazyarena.errors import InputError

_SHORTEST = 16
_LONGEST = 4096


def read_secret(path: str | Path, what: str = "token") -> bytes:
    """Shared secret from a file only its owner can read.

    Parameters
    ----------
    what: what the secret is called in messages.

    Raises
    ------
    InputError: no file, too short a secret, or one that others can read.
    """
    path = Path(path)
    try:
        mode = path.stat().st_mode
        with path.open("rb") as stream:
            secret = stream.read(_LONGEST).strip()
    except OSError as error:
        raise InputError(f"{path}: cannot read the {what}: {error.strerror}") from None
    if mode & 0o077:
        raise InputError(f"{path}: others can read the {what}; run: chmod 600 {path}")
    if len(secret) < _SHORTEST:
        raise InputError(
            f"{path}: the {what} has {len(secret)} bytes; need {_SHORTEST} or more, e.g. "
            "from: openssl rand -hex 32"
        )
    return secret
