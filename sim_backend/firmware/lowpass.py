"""Second-order Butterworth low-pass, the sensor filter of the firmware (direct form II).

A filter is a row of five coefficients plus two delay elements per filtered signal; signals
that share a cut-off share the coefficients, and their delays lie next to each other in one row.
"""

from __future__ import annotations

import math

import numpy as np
from crazyarena.sim_backend.jit import kernel

B0, B1, B2, A1, A2 = range(5)
COEF_SIZE = 5
DELAY_SIZE = 2


@kernel
def coefficients(sample_rate: float, cutoff: float, coef: np.ndarray) -> None:
    """Write the filter of ``cutoff`` Hz at ``sample_rate`` Hz into ``coef[:COEF_SIZE]``."""
    ohm = math.tan(math.pi * cutoff / sample_rate)
    damping = 2.0 * math.cos(math.pi / 4.0) * ohm
    scale = 1.0 + damping + ohm * ohm
    coef[B0] = ohm * ohm / scale
    coef[B1] = 2.0 * coef[B0]
    coef[B2] = coef[B0]
    coef[A1] = 2.0 * (ohm * ohm - 1.0) / scale
    coef[A2] = (1.0 - damping + ohm * ohm) / scale


@kernel
def apply(coef: np.ndarray, delay: np.ndarray, at: int, sample: float) -> float:
    """Filter one sample; the signal's delays are ``delay[at:at + DELAY_SIZE]``."""
    d1 = delay[at]
    d2 = delay[at + 1]
    d0 = sample - coef[A1] * d1 - coef[A2] * d2
    if not math.isfinite(d0):
        d0 = sample
    delay[at] = d0
    delay[at + 1] = d1
    return coef[B0] * d0 + coef[B1] * d1 + coef[B2] * d2


@kernel
def reset(coef: np.ndarray, delay: np.ndarray, at: int, sample: float) -> float:
    """Settle the filter at a value, as if it had always been the input, and filter it."""
    settled = sample / (coef[B0] + coef[B1] + coef[B2])
    delay[at] = settled
    delay[at + 1] = settled
    return apply(coef, delay, at, sample)
