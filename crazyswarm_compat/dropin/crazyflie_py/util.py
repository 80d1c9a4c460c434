"""Helpers of scripts."""

from crazyarena.crazyswarm_compat.util import check_ellipsoid_collisions, poisson_disk_sample

__all__ = ["check_ellipsoid_collisions", "poisson_disk_sample"]
