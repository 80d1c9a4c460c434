"""Crazyswarm2 (``crazyflie_py``) without ROS: the entry class, the fleet and the vehicle.

Whole numbers are accepted wherever the ROS messages would refuse them.
"""

from __future__ import annotations

import atexit
import math
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from crazyarena.clock import WallClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.backend import Backend
from crazyarena.crazyswarm_compat.checks import check_param_name
from crazyarena.crazyswarm_compat.config import (
    FleetConfig,
    VehicleConfig,
    load_crazyflies_2,
)
from crazyarena.crazyswarm_compat.core import (
    EVERYBODY,
    FleetCore,
    VehicleCore,
    by_config,
    open_fleet,
    vector,
)
from crazyarena.crazyswarm_compat.crazyswarm1 import Crazyflie as Viewed
from crazyarena.crazyswarm_compat.hardware import with_uris
from crazyarena.crazyswarm_compat.joystick import Joystick
from crazyarena.crazyswarm_compat.options import parse, warn, with_guard_of
from crazyarena.crazyswarm_compat.timehelper import (
    ExactTimeHelper,
    TimeHelper,
    WallTimeHelper,
    make_time_helper,
)
from crazyarena.crazyswarm_compat.visualizers import open_visualizer
from crazyarena.errors import BackendError, InputError

# Where a checkout of Crazyswarm2 keeps the vehicle list, seen from a script or its folder.
_SEARCH = (
    "crazyflies.yaml",
    "config/crazyflies.yaml",
    "../config/crazyflies.yaml",
    "../crazyflie/config/crazyflies.yaml",
    "../../crazyflie/config/crazyflies.yaml",
)
_ALONE = """\
robots:
  cf231: {uri: "radio://0/80/2M/E7E7E7E7E7", initial_position: [0, 0, 0], type: default}
robot_types:
  default: {}
"""
# rcl_interfaces/msg/ParameterType
_INTEGER, _DOUBLE = 2, 3


@dataclass(slots=True)
class Point:
    """geometry_msgs/Point, m."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass(slots=True)
class Quaternion:
    """geometry_msgs/Quaternion."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


@dataclass(slots=True)
class PoseMessage:
    """geometry_msgs/Pose."""

    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass(slots=True)
class Stamp:
    """builtin_interfaces/Time."""

    sec: int = 0
    nanosec: int = 0


@dataclass(slots=True)
class Header:
    """std_msgs/Header."""

    stamp: Stamp = field(default_factory=Stamp)
    frame_id: str = "world"


@dataclass(slots=True)
class PoseStamped:
    """geometry_msgs/PoseStamped."""

    header: Header = field(default_factory=Header)
    pose: PoseMessage = field(default_factory=PoseMessage)


def _split(seconds: float) -> tuple[int, int]:
    whole = math.floor(seconds)
    return whole, math.floor((seconds - whole) * 1e9)


def _param_type(value: float) -> int:
    return _INTEGER if isinstance(value, int) else _DOUBLE


class Crazyflie(VehicleCore):
    """One vehicle of Crazyswarm2.

    Attributes: ``prefix``, ``uri``, ``initialPosition`` (3,) m; ``status``, ``poseStamped``,
    ``pose`` and ``position`` (list of 3, m) are refreshed while the script sleeps.
    """

    def __init__(self, backend: Backend, config: VehicleConfig, timeHelper: Any) -> None:
        super().__init__(backend, config, timeHelper)
        self.prefix = f"/{config.name}"
        self.uri = config.uri
        self.status: dict[str, Any] = {}
        self.poseStamped = PoseStamped()
        self.pose = self.poseStamped.pose
        self.position: list[float] = [0.0, 0.0, 0.0]
        self._frame = config.reference_frame

    def _spin(self) -> None:
        """Take over what the link has reported since the last sleep."""
        telemetry = self._backend.telemetry(self.id)
        sec, nanosec = _split(telemetry.timestamp)
        self.status = {
            "id": self.id,
            "timestamp_sec": sec,
            "timestamp_nsec": nanosec,
            "supervisor": telemetry.supervisor or 0,
            "battery": telemetry.battery if telemetry.battery is not None else math.nan,
            "pm_state": 0,
            "rssi": -telemetry.rssi if telemetry.rssi is not None else math.nan,
            "num_rx_broadcast": 0,
            "num_tx_broadcast": 0,
            "num_rx_unicast": 0,
            "num_tx_unicast": 0,
        }
        if telemetry.state is None:
            return
        state = telemetry.state
        self.position = [float(value) for value in state.position]
        sec, nanosec = _split(state.timestamp)
        self.poseStamped = PoseStamped(
            Header(Stamp(sec, nanosec), self._frame),
            PoseMessage(
                Point(*self.position), Quaternion(*(float(value) for value in state.quaternion))
            ),
        )
        self.pose = self.poseStamped.pose

    def emergency(self) -> None:
        """Cut the motors; further commands are ignored until reboot."""
        self._send(c.Emergency())

    def arm(self, arm: bool = True) -> None:
        """Arm or disarm the motors."""
        self._send(c.Arm(bool(arm)))

    def getParam(self, name: str) -> float:
        """Value of the parameter ``group.name``; NaN, with a warning, if unknown."""
        dotted = check_param_name(self._name, name)
        try:
            return self._backend.get_param(self.id, dotted)
        except BackendError as error:
            warn(f"getParam: {error}")
            return math.nan

    def setParam(self, name: str, value: float) -> None:
        """Set the parameter ``group.name``, cast to its declared type."""
        dotted = check_param_name(self._name, name)
        try:
            declared = self._backend.get_param(self.id, dotted)
        except BackendError as error:
            warn(f"setParam: {error}")
            return
        self._send(c.SetParam(dotted, int(value) if isinstance(declared, int) else value))

    def cmdHover(self, vx: float, vy: float, yaw_rate: float, z_distance: float) -> None:
        """Stream body velocities m/s, yaw rate rad/s counter-clockwise, absolute height m."""
        self._send(c.Hover(vx, vy, yaw_rate, z_distance))

    def get_status(self) -> dict[str, Any]:
        """Latest status; empty before the first sleep."""
        return self.status

    def get_pose(self) -> PoseMessage:
        """Latest pose: ``position`` x, y, z and ``orientation`` x, y, z, w."""
        return self.pose

    def get_position(self) -> list[float]:
        """Latest position, list of 3, m."""
        return self.position


class CrazyflieServer(FleetCore):
    """The fleet: ``crazyflies``, ``crazyfliesById``, ``crazyfliesByName`` and the broadcasts."""

    def __init__(
        self,
        timeHelper: Any,
        fleet: FleetConfig,
        backend: str = "ideal",
        mocap: str | None = None,
        watchdog: bool = False,
        guard: str | None = None,
    ) -> None:
        link, guarded = open_fleet(backend, fleet, timeHelper, guard)
        configs = by_config(fleet, link)
        cfs = [Crazyflie(guarded or link, config, timeHelper) for config in configs]
        super().__init__(link, guarded, cfs, timeHelper)
        self.crazyfliesByName = {
            config.name: cf for config, cf in zip(configs, self.crazyflies, strict=True)
        }
        if isinstance(timeHelper, TimeHelper):
            # Viewers and logs ask for position() and rpy(), which only the older face has.
            timeHelper.crazyflies = [Viewed(link, config, timeHelper) for config in configs]
        timeHelper.after_sleep(self._spin)
        if backend == "radio":
            self._start_hardware(fleet, timeHelper.clock, mocap, watchdog)

    @property
    def paramTypeDict(self) -> dict[str, dict[str, int]]:
        """Declared ROS types of the parameters by vehicle name: 2 integer, 3 double."""
        names = getattr(self._link, "param_names", None)
        if names is None:
            return {}
        return {
            name: {
                param: _param_type(self._backend.get_param(cf.id, param)) for param in names(cf.id)
            }
            for name, cf in self.crazyfliesByName.items()
        }

    def _spin(self) -> None:
        for cf in self.crazyflies:
            cf._spin()

    def arm(self, arm: bool = True) -> None:
        """Arm or disarm every vehicle."""
        self._send(c.Arm(bool(arm)))

    def setParam(self, name: str, value: float) -> None:
        """Set the parameter ``group.name`` of every vehicle."""
        self._send(c.SetParam(check_param_name(EVERYBODY, name), value))

    def cmdFullState(
        self, pos: ArrayLike, vel: ArrayLike, acc: ArrayLike, yaw: float, omega: ArrayLike
    ) -> None:
        """Stream one and the same full state to every vehicle."""
        self._send(c.FullState(vector(pos), vector(vel), vector(acc), yaw, vector(omega)))


class Crazyswarm:
    """Entry of a script: ``timeHelper``, ``allcfs`` and ``input``.

    The flags come from the command line (see :mod:`.options`). The vehicle list is
    ``--crazyflies-yaml``, or the first ``crazyflies.yaml`` found beside the working directory
    or the script (also in ``config`` and ``../crazyflie/config``); a simulation without any
    flies one vehicle at the origin.

    Raises
    ------
    InputError, BackendError
        see :class:`.crazyswarm1.Crazyswarm`.
    """

    def __init__(
        self,
        *,
        crazyflies_yaml: str | os.PathLike[str] | None = None,
        args: str | Sequence[str] | None = None,
    ) -> None:
        parsed = parse(args, None)
        fleet = load_crazyflies_2(crazyflies_yaml or parsed.crazyflies_yaml or _find(parsed.sim))
        parsed = with_guard_of(parsed, fleet)
        self.timeHelper: TimeHelper | WallTimeHelper
        if parsed.sim:
            self.timeHelper = make_time_helper(parsed, open_visualizer(parsed.vis), ExactTimeHelper)
            if parsed.writecsv or parsed.video:
                atexit.register(self.timeHelper.close)
        else:
            self.timeHelper = WallTimeHelper(WallClock())
        self.allcfs = CrazyflieServer(
            self.timeHelper,
            with_uris(fleet, parsed.uri),
            parsed.backend,
            parsed.mocap,
            parsed.watchdog,
            parsed.guard,
        )
        self.input = Joystick(self.timeHelper)


def _find(sim: bool) -> str | Path:
    folders = [Path.cwd(), Path(sys.argv[0]).resolve().parent]
    for folder in folders:
        for place in _SEARCH:
            if (folder / place).is_file():
                return folder / place
    if not sim:
        raise InputError(
            f"crazyflies.yaml: not found in {folders[0]} or {folders[1]}; name it with "
            "--crazyflies-yaml"
        )
    warn("no crazyflies.yaml found: simulating one vehicle, cf231, at the origin", stacklevel=4)
    return _ALONE
