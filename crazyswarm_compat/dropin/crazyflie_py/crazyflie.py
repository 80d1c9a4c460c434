"""Vehicles, fleet and time."""

from crazyarena.crazyswarm_compat.crazyswarm2 import Crazyflie, CrazyflieServer
from crazyarena.crazyswarm_compat.timehelper import ExactTimeHelper as TimeHelper

__all__ = ["Crazyflie", "CrazyflieServer", "TimeHelper"]
