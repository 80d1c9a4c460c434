from __future__ import annotations

import numpy as np
import pytest

from crazyarena.errors import InputError
from crazyarena.mocap.marker_config import constellation, limits
from crazyarena.mocap.tracker import TrackerConfig

POINTS = [[0.02, 0.01, 0.05], [-0.02, 0.01, 0.05], [0.0, -0.03, 0.05]]


@pytest.mark.parametrize("prefix", ["", "p"])
def test_both_generations_are_read(prefix):
    entry = {
        "numPoints": 3,
        "offset": [0, -0.01, -0.04],
        "points": {f"{prefix}{i}": p for i, p in enumerate(POINTS)},
    }
    expected = np.array(POINTS) + [0, -0.01, -0.04]
    np.testing.assert_allclose(constellation("0", entry), expected)


@pytest.mark.parametrize(
    ("entry", "field"),
    [
        ({}, "points"),
        ({"points": {"0": [1, 2]}}, r"points\.0"),
        ({"points": {"0": [1, 2, float("nan")]}}, r"points\.0"),
        ({"points": {"0": [1, 2, 3]}, "offset": "none"}, "offset"),
        ({"points": {"0": [1, 2, 3]}, "numPoints": 2}, "numPoints"),
    ],
)
def test_what_is_wrong_is_named(entry, field):
    with pytest.raises(InputError, match=field):
        constellation("0", entry)


def test_limits_come_over():
    config = limits(
        "0", {"max_roll": 1.4, "maxPitch": 1.2, "maxFitnessScore": 1e-4}, TrackerConfig()
    )
    assert config.max_tilt == 1.2
    assert config.max_fitness == pytest.approx(0.01)
    with pytest.raises(InputError, match="max_roll"):
        limits("0", {"max_roll": -1}, TrackerConfig())
