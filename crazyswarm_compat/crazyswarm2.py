"""Crazyswarm2 (``crazyflie_py``) without ROS: the entry class, the fleet and the vehicle.

Whole numbers are accepted wherever the ROS messages would refuse them.
"""

from __future__ import annotations

import atexit
import math
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
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
from crazyarena.crazyswarm_compat.options import NO_MOCAP, parse, warn, with_guard_of
from crazyarena.crazyswarm_compat.recording import record_script
from crazyarena.crazyswarm_compat.ros_like import (
    NodeLike,
    Point,
    PoseMessage,
    PoseStamped,
    Quaternion,
    Record,
    split_seconds,
)
from crazyarena.crazyswarm_compat.server_files import (
    MOTION_CAPTURE,
    LinkLimits,
    ServerFile,
    read_motion_capture,
    read_server,
)
from crazyarena.crazyswarm_compat.timehelper import (
    ExactTimeHelper,
    TimeHelper,
    WallTimeHelper,
    make_time_helper,
)
from crazyarena.crazyswarm_compat.visualizers import VisViser, open_visualizer
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


def _param_types(backend: Backend, vehicle: int) -> dict[str, int]:
    """Declared ROS types of a vehicle's parameters; none where the backend knows no names."""
    names = getattr(backend, "param_names", None)
    if names is None:
        return {}
    whole = getattr(backend, "param_is_whole", None)

    def is_whole(name: str) -> bool:
        if whole is not None:
            return bool(whole(vehicle, name))
        return isinstance(backend.get_param(vehicle, name), int)

    return {name: _INTEGER if is_whole(name) else _DOUBLE for name in names(vehicle)}


class Crazyflie(VehicleCore):
    """One vehicle of Crazyswarm2.

    Attributes: ``prefix``, ``uri``, ``initialPosition`` (3,) m; ``status``, ``poseStamped``,
    ``pose`` and ``position`` (list of 3, m) are refreshed while the script sleeps.
    """

    def __init__(
        self,
        backend: Backend,
        config: VehicleConfig,
        timeHelper: Any,
        link: Backend | None = None,
    ) -> None:
        super().__init__(backend, config, timeHelper)
        self._link = link or backend
        self.prefix = f"/{config.name}"
        self.uri = config.uri
        self.status: dict[str, Any] = Record()
        self.poseStamped = PoseStamped()
        self.pose = Record()
        self.position: list[float] = [0.0, 0.0, 0.0]
        self._frame = config.reference_frame

    def _spin(self) -> None:
        """Take over what the link has reported since the last sleep."""
        telemetry = self._backend.telemetry(self.id)
        sec, nanosec = split_seconds(max(0.0, telemetry.timestamp))
        self.status = Record(
            id=self._frame,
            timestamp_sec=sec,
            timestamp_nsec=nanosec,
            supervisor=telemetry.supervisor or 0,
            battery=telemetry.battery if telemetry.battery is not None else math.nan,
            pm_state=telemetry.power_state or 0,
            rssi=-telemetry.rssi if telemetry.rssi is not None else math.nan,
            num_rx_broadcast=0,
            num_tx_broadcast=0,
            num_rx_unicast=0,
            num_tx_unicast=0,
        )
        if telemetry.state is None:
            return
        state = telemetry.state
        self.position = [float(value) for value in state.position]
        sec, nanosec = split_seconds(state.timestamp)
        pose = PoseMessage(
            Point(*self.position), Quaternion(*(float(value) for value in state.quaternion))
        )
        self.poseStamped = PoseStamped(
            id=self._frame, timestamp_sec=sec, timestamp_nsec=nanosec, pose=pose
        )
        self.pose = Record(position=pose.position, orientation=pose.orientation)

    @property
    def paramTypeDict(self) -> dict[str, int]:
        """Declared ROS types of the parameters, ``group.name``: 2 integer, 3 double."""
        return _param_types(self._link, self.id)

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
        whole = getattr(self._link, "param_is_whole", None)
        try:
            is_whole = (
                isinstance(self._backend.get_param(self.id, dotted), int)
                if whole is None
                else whole(self.id, dotted)
            )
        except BackendError as error:
            warn(f"setParam: {error}")
            return
        self._send(c.SetParam(dotted, int(value) if is_whole else value))

    def cmdHover(self, vx: float, vy: float, yaw_rate: float, z_distance: float) -> None:
        """Stream body velocities m/s, yaw rate rad/s counter-clockwise, absolute height m."""
        self._send(c.Hover(vx, vy, yaw_rate, z_distance))

    def get_status(self) -> dict[str, Any]:
        """Latest status; empty before the first sleep."""
        return self.status

    def get_pose(self) -> Record:
        """Latest pose: ``["position"]`` with x, y, z and ``["orientation"]`` with x, y, z, w;
        empty before the first one."""
        return self.pose

    def get_position(self) -> list[float]:
        """Latest position, list of 3, m."""
        return self.position


class CrazyflieServer(FleetCore, NodeLike):
    """The fleet: ``crazyflies``, ``crazyfliesById``, ``crazyfliesByName`` and the broadcasts; of
    a ROS node what needs no ROS."""

    def __init__(
        self,
        timeHelper: Any,
        fleet: FleetConfig,
        backend: str = "ideal",
        mocap: str | None = None,
        watchdog: bool = False,
        guard: str | None = None,
        limits: LinkLimits | None = None,
    ) -> None:
        link, guarded = open_fleet(backend, fleet, timeHelper, guard)
        configs = by_config(fleet, link)
        cfs = [Crazyflie(guarded or link, config, timeHelper, link) for config in configs]
        super().__init__(link, guarded, cfs, timeHelper)
        self._init_node(timeHelper)
        for config, cf in zip(configs, self.crazyflies, strict=True):
            # Upstream's key; the last of several with the same last byte of the address.
            self.crazyfliesById[int(str(config.uri)[-2:], 16)] = cf
        self.crazyfliesByName = {
            config.name: cf for config, cf in zip(configs, self.crazyflies, strict=True)
        }
        if isinstance(timeHelper, TimeHelper):
            # Viewers and logs ask for position() and rpy(), which only the older face has.
            timeHelper.crazyflies = [Viewed(link, config, timeHelper) for config in configs]
        timeHelper.after_sleep(self._spin)
        if backend == "radio":
            self._start_hardware(fleet, timeHelper.clock, mocap, watchdog, limits)

    @property
    def paramTypeDict(self) -> dict[str, int]:
        """Declared ROS types of the parameters that all vehicles have: 2 integer, 3 double."""
        each = [_param_types(self._link, cf.id) for cf in self.crazyflies]
        return {
            name: kind
            for name, kind in (each[0] if each else {}).items()
            if all(other.get(name) == kind for other in each)
        }

    def _spin(self) -> None:
        for cf in self.crazyflies:
            cf._spin()

    def arm(self, arm: bool = True) -> None:
        """Arm or disarm every vehicle."""
        self._send(c.Arm(bool(arm)))

    def setParam(self, name: str, value: float) -> None:
        """Set the parameter ``group.name`` of every vehicle; a warning for those without it."""
        self._set_param(check_param_name(EVERYBODY, name), value)

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
        server = _server_of(fleet, parsed.sim)
        if not parsed.sim:
            parsed.mocap = _cameras_of(fleet, parsed.given.mocap)
            fleet = replace(fleet, read_all=server.read_all)
        self.timeHelper: TimeHelper | WallTimeHelper
        if parsed.sim:
            self.timeHelper = make_time_helper(parsed, open_visualizer(parsed.vis), ExactTimeHelper)
            if parsed.writecsv or parsed.video:
                atexit.register(self.timeHelper.close)
        else:
            # Of viewers, only this one draws elsewhere than where the script flies.
            vis = VisViser(pace=0.0) if parsed.vis == "viser" else None
            self.timeHelper = WallTimeHelper(WallClock(), vis)
        self.allcfs = CrazyflieServer(
            self.timeHelper,
            with_uris(fleet, parsed.uri),
            parsed.backend,
            parsed.mocap,
            parsed.watchdog,
            parsed.guard,
            server.limits,
        )
        record_script(parsed.record, self.timeHelper, self.allcfs)
        self.input = Joystick(self.timeHelper)


def _folder(fleet: FleetConfig) -> Path | None:
    """Where Crazyswarm2's other files would be."""
    named = fleet.source.endswith((".yaml", ".yml"))
    return Path(fleet.source).parent if named else None


def _server_of(fleet: FleetConfig, sim: bool) -> ServerFile:
    folder = _folder(fleet)
    found = None if folder is None else read_server(folder, sim)
    if found is None:
        return ServerFile(LinkLimits(), False, ())
    for remark in found.unread:
        warn(remark, stacklevel=4)
    return found


def _cameras_of(fleet: FleetConfig, given: str | None) -> str | None:
    """Where poses come from: the flag, or else what ``motion_capture.yaml`` says."""
    folder = _folder(fleet)
    if given == NO_MOCAP:
        return None
    if folder is None or given is not None:
        return given
    spec, remark = read_motion_capture(folder)
    if remark is not None:
        warn(remark, stacklevel=4)
    if spec is not None:
        print(f"{folder / MOTION_CAPTURE}: poses from --mocap {spec}", file=sys.stderr)
    return spec


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
