"""How a firmware module declares the parameters that a client may set.

Every module with parameters has a tuple ``PARAMS`` in the order of the parameter row its
kernels read, so that a parameter's index in the tuple is its index in the row.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

GENERATIONS = (2022, 2026)


class Param(NamedTuple):
    """One parameter of the firmware.

    Attributes
    ----------
    name
        Group and name as in the table of contents, ``"ctrlMel.kp_xy"``.
    default_2022, default_2026
        Value after boot; None where that generation does not have the parameter.
    ctype
        Type on the wire: ``"uint8"``, ``"int8"``, ``"uint16"``, ``"int16"``, ``"uint32"``,
        ``"int32"`` or ``"float"``.
    """

    name: str
    default_2022: float | None
    default_2026: float | None
    ctype: str = "float"


def default_row(params: Sequence[Param], generation: int) -> np.ndarray:
    """Parameter row of a freshly booted vehicle, float64 of shape ``(len(params),)``.

    A parameter that the generation lacks reads 0; its kernels do not look at it.

    Raises
    ------
    ValueError
        If the generation is neither 2022 nor 2026.
    """
    if generation not in GENERATIONS:
        raise ValueError(f"firmware generation {generation!r}: expected 2022 or 2026")
    values = [p.default_2022 if generation == 2022 else p.default_2026 for p in params]
    return np.array([0.0 if value is None else value for value in values], dtype=np.float64)


def index(params: Sequence[Param], name: str) -> int:
    """Position of a named parameter in its row.

    Raises
    ------
    KeyError
        If the name is not declared.
    """
    for i, param in enumerate(params):
        if param.name == name:
            return i
    raise KeyError(name)
