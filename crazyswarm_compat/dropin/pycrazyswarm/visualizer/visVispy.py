"""The vispy viewer's name, with the matplotlib viewer behind it."""

from crazyarena.crazyswarm_compat.visualizers import VisMatplotlib as VisVispy

__all__ = ["VisVispy"]
