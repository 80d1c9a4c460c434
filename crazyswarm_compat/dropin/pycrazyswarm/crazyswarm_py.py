"""The entry class and its command line."""

from crazyarena.crazyswarm_compat.crazyswarm1 import Crazyswarm
from crazyarena.crazyswarm_compat.options import build_argparser

__all__ = ["Crazyswarm", "build_argparser"]
