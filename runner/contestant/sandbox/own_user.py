"""A user of its own for each contestant: the kernel counts processes by user, and two who share one
could take each other's share.
"""

from __future__ import annotations

import itertools
import secrets
from pathlib import Path

_FIRST, _COUNT = 61184, 4336
"""Numbers that distributions leave for users that live as long as one process."""
_NOBODY = 65534
_MAPS = Path("/proc/self/uid_map"), Path("/proc/self/gid_map")
_turns = itertools.count(secrets.randbelow(_COUNT))


def own_user(maps: tuple[Path, ...] = _MAPS) -> int:
    """Number of a user, and of its group, that no other contestant of this process has.

    That of ``nobody`` where this machine's root may not become it, as in small user namespaces.
    """
    number = _FIRST + next(_turns) % _COUNT
    return number if all(_knows(each, number) for each in maps) else _NOBODY


def _knows(file: Path, number: int) -> bool:
    try:
        rows = [tuple(map(int, line.split())) for line in file.read_text().splitlines()]
        return any(first <= number < first + count for first, _, count in rows)
    except (OSError, ValueError):
        return False
