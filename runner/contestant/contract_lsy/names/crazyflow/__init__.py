"""Stands in for crazyflow where controllers of lsy_drone_racing are loaded."""

from .sim import Sim

__all__ = ["Sim"]
