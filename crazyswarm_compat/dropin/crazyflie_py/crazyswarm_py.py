"""The entry class."""

from crazyarena.crazyswarm_compat.crazyswarm2 import Crazyswarm

__all__ = ["Crazyswarm"]
