"""What ``compute_control`` answers, checked."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import CommandError


def _holds_text(answer: Any) -> bool:
    """Whether NumPy would read numbers out of text."""
    if isinstance(answer, np.ndarray):
        return answer.dtype.kind in "USO" and any(map(_holds_text, answer.ravel().tolist()))
    if isinstance(answer, list | tuple):
        return any(map(_holds_text, answer))
    return isinstance(answer, str | bytes | bytearray)


def checked_command(answer: Any, size: int, step: int) -> NDArray[np.float64]:
    """The command as (size,) finite numbers.

    Raises
    ------
    CommandError: it is none, or of another shape, or not finite.
    """
    what = (
        "[x, y, z, vx, vy, vz, ax, ay, az, yaw, rates]"
        if size == 13
        else ("[roll, pitch, yaw, thrust]")
    )
    if not isinstance(answer, str | bytes) and _holds_text(answer):
        raise CommandError(
            f"step {step}: compute_control returned text among its numbers; expected {size} "
            f"numbers {what}. Convert them with float()"
        )
    try:
        command = np.array(answer, dtype=np.float64)
    except (TypeError, ValueError):
        raise CommandError(
            f"step {step}: compute_control returned {type(answer).__name__}; "
            f"expected {size} numbers {what}"
        ) from None
    if command.size != size or command.ndim > 2:
        raise CommandError(
            f"step {step}: compute_control returned numbers of shape {list(command.shape)}; "
            f"expected {size} {what}"
        )
    command = command.reshape(size)
    if not np.isfinite(command).all():
        raise CommandError(f"step {step}: compute_control returned a number that is not finite")
    # Beyond these nothing flies, and squares overflow.
    return np.clip(command, -1e6, 1e6)
