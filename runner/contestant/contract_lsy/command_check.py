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


def _other_mode(found: int, size: int) -> str:
    """The remedy where the numbers are those of the level's other mode."""
    modes = {13: "state", 4: "attitude"}
    if found not in modes or found == size:
        return ""
    return (
        f". The level is in {modes[size]} mode; {found} numbers want --set "
        f"env.control_mode={modes[found]} (in a race: control_mode in its env.kwargs)"
    )


def _entry(index: int, size: int) -> str:
    names = (
        "roll pitch yaw thrust"
        if size == 4
        else ("x y z vx vy vz ax ay az yaw roll-rate pitch-rate yaw-rate")
    )
    return names.split()[index]


def _holds_complex(answer: Any) -> bool:
    """Whether NumPy would throw imaginary parts away."""
    if isinstance(answer, np.ndarray) and answer.dtype.kind != "O":
        return answer.dtype.kind == "c"
    if isinstance(answer, list | tuple | np.ndarray):
        return any(map(_holds_complex, answer))
    return isinstance(answer, complex | np.complexfloating)


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
            f"step {step}: compute_control returned nothing; expected {size} numbers {what}. "
            "Does every way through it end with a return?"
        )
    if _holds_complex(answer):
        raise CommandError(
            f"step {step}: compute_control returned complex numbers; expected {size} real ones "
            f"{what}. Take their np.real()"
        )
    try:
        # What is masked is no number, whatever lies below the mask.
        masked = isinstance(answer, np.ma.MaskedArray)
        command = np.array(answer.astype(float).filled(np.nan) if masked else answer, dtype=float)
    except (TypeError, ValueError):
        raise CommandError(
            f"step {step}: compute_control returned {type(answer).__name__}; "
            f"expected {size} numbers {what}"
        ) from None
    if command.size != size or command.ndim > 2:
        raise CommandError(
            f"step {step}: compute_control returned numbers of shape {list(command.shape)}; "
            f"expected {size} {what}{_other_mode(command.size, size)}"
        )
    command = command.reshape(size)
    if not np.isfinite(command).all():
        index = int(np.flatnonzero(~np.isfinite(command))[0])
        raise CommandError(
            f"step {step}: compute_control returned a number that is not finite: entry {index} "
            f"({_entry(index, size)}) is {command[index]}"
        )
    # Beyond these nothing flies, and squares overflow.
    return np.clip(command, -1e6, 1e6)
