"""Second-order Butterworth low-pass, the sensor filter of the firmware (direct form II).

A filter is a row of five coefficients plus two delay elements per filtered signal; signals
that share a cut-off share the coefficients, and their delays lie next to each other in one row.
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.jit import kernel

B0, B1, B2, A1, A2 = range(5)
COEF_SIZE = 5
DELAY_SIZE = 2


@kernel
def coefficients(sample_rate: float, cutoff: float, coef: np.ndarray) -> None:
    """Write the filter of ``cutoff`` Hz at ``sample_rate`` Hz into ``coef[:COEF_SIZE]``."""
    one, two = np.float32(1.0), np.float32(2.0)
    ratio = np.float32(sample_rate) / np.float32(cutoff)
    ohm = np.float32(math.tan(np.float32(math.pi) / ratio))
    damping = two * np.float32(math.cos(math.pi / 4.0)) * ohm
    scale = one + damping + ohm * ohm
    coef[B0] = ohm * ohm / scale
    coef[B1] = 2.0 * coef[B0]
    coef[B2] = coef[B0]
    coef[A1] = two * (ohm * ohm - one) / scale
    coef[A2] = (one - damping + ohm * ohm) / scale


@kernel
def apply(coef: np.ndarray, delay: np.ndarray, at: int, sample: float) -> float:
    """Filter one sample; the signal's delays are ``delay[at:at + DELAY_SIZE]``.

    Single precision throughout: the poles lie so close to 1 that the rounding of the delays
    shows in the output after a spike.
    """
    d1 = np.float32(delay[at])
    d2 = np.float32(delay[at + 1])
    x = np.float32(sample)
    d0 = x - d1 * np.float32(coef[A1]) - d2 * np.float32(coef[A2])
    if not math.isfinite(d0):
        d0 = x
    delay[at] = d0
    delay[at + 1] = d1
    y = d0 * np.float32(coef[B0]) + d1 * np.float32(coef[B1]) + d2 * np.float32(coef[B2])
    return float(y)


@kernel
def reset(coef: np.ndarray, delay: np.ndarray, at: int, sample: float) -> float:
    """Settle the filter at a value, as if it had always been the input, and filter it."""
    gain = np.float32(coef[B0]) + np.float32(coef[B1]) + np.float32(coef[B2])
    settled = float(np.float32(sample) / gain)
    delay[at] = settled
    delay[at + 1] = settled
    return apply(coef, delay, at, sample)
