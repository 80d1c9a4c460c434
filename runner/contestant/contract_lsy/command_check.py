"""What ``compute_control`` answers, checked."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import CommandError

_MODES = {13: "state", 4: "attitude"}  # by numbers of a command


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
    if answer is None:
        raise CommandError(
            f"step {step}: compute_control returned nothing (None); expected {size} numbers "
            f"{what}. A path through it has no return"
        )
    try:
        command = np.array(answer, dtype=np.float64)
    except (TypeError, ValueError):
        raise CommandError(
            f"step {step}: compute_control returned {type(answer).__name__}; "
            f"expected {size} numbers {what}"
        ) from None
    if command.size != size or command.ndim > 2:
        text = (
            f"step {step}: compute_control returned numbers of shape {list(command.shape)}; "
            f"expected {size} {what}"
        )
        if command.size in _MODES:
            # Complete commands, of the other mode: the level is what does not fit.
            have, need = _MODES[size], _MODES[command.size]
            text += f"; this is {have} mode, {need} mode is --set env.control_mode={need}"
        raise CommandError(text)
    command = command.reshape(size)
    if not np.isfinite(command).all():
        raise CommandError(f"step {step}: compute_control returned a number that is not finite")
    # Beyond these nothing flies, and squares overflow.
    return np.clip(command, -1e6, 1e6)
