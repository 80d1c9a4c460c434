"""Helpers of scripts; a star import also brings np, sp and scipy, which scripts rely on."""

import numpy as np
import scipy
import scipy as sp
import scipy.spatial

from crazyarena.crazyswarm_compat.util import (
    check_ellipsoid_collisions,
    grid_yaml,
    poisson_disk_sample,
)

__all__ = ["check_ellipsoid_collisions", "grid_yaml", "np", "poisson_disk_sample", "scipy", "sp"]
