"""The second-order low-pass against recorded firmware output."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from crazyarena.sim_backend.firmware import lowpass
from tests.recorded import arrays, vector_files

FILES = list(vector_files("coef_b0_b1_b2_a1_a2", "reset_x", "reset_y"))
TOLERANCE = 5e-6


def test_filters_are_recorded():
    assert FILES


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_filters(path: Path):
    data = arrays(path)
    for k, (rate, cutoff) in enumerate(zip(data["fs"], data["fc"], strict=True)):
        coef = np.zeros(lowpass.COEF_SIZE)
        lowpass.coefficients(float(rate), float(cutoff), coef)
        np.testing.assert_allclose(coef, data["coef_b0_b1_b2_a1_a2"][k], rtol=TOLERANCE)

        # The signals of a filter share one row of delays.
        signals = data["x"][k].astype(float)
        delay = np.zeros(lowpass.DELAY_SIZE * len(signals))
        filtered = np.zeros_like(signals)
        for s, signal in enumerate(signals):
            for t, sample in enumerate(signal):
                filtered[s, t] = lowpass.apply(coef, delay, s * lowpass.DELAY_SIZE, sample)
        np.testing.assert_allclose(filtered, data["y"][k], rtol=TOLERANCE, atol=1e-9)

        signal = data["reset_x"][k].astype(float)
        delay = np.zeros(lowpass.DELAY_SIZE)
        filtered = [lowpass.reset(coef, delay, 0, signal[0])]
        filtered += [lowpass.apply(coef, delay, 0, sample) for sample in signal[1:]]
        np.testing.assert_allclose(filtered, data["reset_y"][k], rtol=TOLERANCE, atol=1e-9)
