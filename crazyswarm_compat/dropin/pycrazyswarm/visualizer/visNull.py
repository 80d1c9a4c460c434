"""No viewer."""

from crazyarena.crazyswarm_compat.visualizers import VisNull

__all__ = ["VisNull"]
