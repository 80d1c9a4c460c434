"""Piecewise polynomial trajectories."""

from crazyarena.crazyswarm_compat.uav_trajectory import (
    Polynomial,
    Polynomial4D,
    Trajectory,
    TrajectoryOutput,
    normalize,
)

__all__ = ["Polynomial", "Polynomial4D", "Trajectory", "TrajectoryOutput", "normalize"]
