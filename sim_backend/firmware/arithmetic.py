"""Number handling that the controllers share with the firmware's C code."""

from __future__ import annotations

import math

from crazyarena.jit import kernel


@kernel
def clip(value: float, limit: float) -> float:
    """Limit to [-limit, limit]."""
    if value > limit:
        return limit
    if value < -limit:
        return -limit
    return value


@kernel
def to_int16(value: float, limit: float) -> float:
    """Saturate at ``limit`` and drop the fraction; not-a-number (undefined in C) becomes 0."""
    if math.isnan(value):
        return 0.0
    return float(int(clip(value, limit)))
