"""Drop-in for the module that Crazyswarm scripts keep beside them."""

from crazyarena.crazyswarm_compat.uav_trajectory import (
    Polynomial,
    Polynomial4D,
    Trajectory,
    TrajectoryOutput,
    normalize,
)

__all__ = ["Polynomial", "Polynomial4D", "Trajectory", "TrajectoryOutput", "normalize"]
