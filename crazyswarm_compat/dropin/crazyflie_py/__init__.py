"""Drop-in for Crazyswarm2's Python package; see crazyarena.crazyswarm_compat.crazyswarm2."""

from crazyarena.crazyswarm_compat.crazyswarm2 import Crazyswarm

__all__ = ["Crazyswarm"]
