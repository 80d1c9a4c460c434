"""Matplotlib viewer."""

from crazyarena.crazyswarm_compat.visualizers import VisMatplotlib

__all__ = ["VisMatplotlib"]
