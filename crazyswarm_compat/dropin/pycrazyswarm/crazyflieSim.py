"""Simulated vehicles."""

from crazyarena.crazyswarm_compat.crazyswarm1 import Crazyflie, CrazyflieServer
from crazyarena.crazyswarm_compat.timehelper import TimeHelper

__all__ = ["Crazyflie", "CrazyflieServer", "TimeHelper"]
