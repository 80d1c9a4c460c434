"""Tests of what not every installation has."""

from importlib.util import find_spec

import pytest

needs_pybullet = pytest.mark.skipif(
    find_spec("pybullet") is None, reason="the extra 'pybullet' is not installed"
)
