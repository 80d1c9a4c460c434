"""Vehicles in the air."""

from crazyarena.clock import WallClock
from crazyarena.crazyswarm_compat.crazyswarm1 import DEFAULT_YAML, Crazyflie
from crazyarena.crazyswarm_compat.crazyswarm1 import CrazyflieServer as _CrazyflieServer
from crazyarena.crazyswarm_compat.timehelper import WallTimeHelper as _WallTimeHelper


class TimeHelper(_WallTimeHelper):
    """Wall clock."""

    def __init__(self) -> None:
        super().__init__(WallClock())


class CrazyflieServer(_CrazyflieServer):
    """The fleet behind the radio."""

    def __init__(self, crazyflies_yaml: str = DEFAULT_YAML) -> None:
        super().__init__(TimeHelper(), crazyflies_yaml, backend="radio")


__all__ = ["Crazyflie", "CrazyflieServer", "TimeHelper"]
