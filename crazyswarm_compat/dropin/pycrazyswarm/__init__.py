"""Drop-in for Crazyswarm 1's Python package; see crazyarena.crazyswarm_compat.crazyswarm1."""

from crazyarena.crazyswarm_compat.crazyswarm1 import Crazyswarm
from pycrazyswarm import cfsim

__all__ = ["Crazyswarm", "cfsim"]
