"""Crazyswarm 1 (``pycrazyswarm``): the entry class, the fleet and the vehicle.

Deviations from the original, all on the side of what its documentation says:
``cmdVelocityWorld`` takes its yaw rate in deg/s, counter-clockwise, and integrates it;
``cmdPosition`` takes yaw in rad on every backend; parameters, ``emergency``, ``cmdStop`` and
``notifySetpointsStop`` work in simulation; a landed vehicle may take off again; ``stop``
freezes; ``--writecsv`` writes files.
"""

from __future__ import annotations

import argparse
import atexit
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazyarena.clock import WallClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.backend import Backend
from crazyarena.crazyswarm_compat.checks import check_param_name
from crazyarena.crazyswarm_compat.config import FleetConfig, load_crazyflies_1, load_types_1
from crazyarena.crazyswarm_compat.core import (
    EVERYBODY,
    FleetCore,
    VehicleCore,
    by_config,
    open_fleet,
    vector,
)
from crazyarena.crazyswarm_compat.hardware import with_uris
from crazyarena.crazyswarm_compat.joystick import Joystick
from crazyarena.crazyswarm_compat.options import parse, warn, with_guard_of
from crazyarena.crazyswarm_compat.recording import record_script
from crazyarena.crazyswarm_compat.registry import IdealState, InspectableBackend
from crazyarena.crazyswarm_compat.timehelper import TimeHelper, WallTimeHelper, make_time_helper
from crazyarena.crazyswarm_compat.visualizers import VisViser, open_visualizer
from crazyarena.errors import BackendError
from crazyarena.types import VehicleState

DEFAULT_YAML = "../launch/crazyflies.yaml"
_INFINITE = float("inf")


def _rotation(state: VehicleState) -> NDArray[np.float64]:
    x, y, z, w = state.quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


class Crazyflie(VehicleCore):
    """One vehicle of Crazyswarm 1.

    Attributes: ``id``, ``initialPosition`` (3,) m, ``prefix``; in simulation also
    ``groupMask``, ``trajectories`` (by id) and ``ledRGB``, and with perfect tracking ``mode``,
    ``planner``, ``state`` and ``setState``.
    """

    MODE_IDLE = 0
    MODE_HIGH_POLY = 1
    MODE_LOW_FULLSTATE = 2
    MODE_LOW_POSITION = 3
    MODE_LOW_VELOCITY = 4

    def __init__(self, backend: Backend, config: Any, timeHelper: Any) -> None:
        super().__init__(backend, config, timeHelper)
        self.prefix = f"/cf{config.id}"
        self.groupMask = 0
        self.trajectories: dict[int, Any] = {}
        self.ledRGB = (0.5, 0.5, 1.0)

    def setGroupMask(self, groupMask: int) -> None:
        super().setGroupMask(groupMask)
        self.groupMask = groupMask

    def uploadTrajectory(self, trajectoryId: int, pieceOffset: int, trajectory: Any) -> None:
        super().uploadTrajectory(trajectoryId, pieceOffset, trajectory)
        self.trajectories[trajectoryId] = trajectory

    def enableCollisionAvoidance(
        self,
        others: Sequence[Crazyflie],
        ellipsoidRadii: ArrayLike,
        bboxMin: ArrayLike = (-_INFINITE,) * 3,
        bboxMax: ArrayLike = (_INFINITE,) * 3,
        horizonSecs: float = 1.0,
        maxSpeed: float = 2.0,
    ) -> None:
        """Avoid the vehicles ``others`` (this one may be among them) while tracking setpoints.

        ``ellipsoidRadii`` (3,) m; ``bboxMin``, ``bboxMax`` (3,) m keep the vehicle inside a
        box; it plans ``horizonSecs`` ahead and at most ``maxSpeed`` m/s.
        """
        self._send(
            c.CollisionAvoidance(
                True,
                vector(ellipsoidRadii),
                vector(bboxMin),
                vector(bboxMax),
                horizonSecs,
                maxSpeed,
                peers=tuple(cf.id for cf in others if cf.id != self.id),
            )
        )

    def disableCollisionAvoidance(self) -> None:
        """Track setpoints without looking at the others."""
        self._send(c.CollisionAvoidance(False))

    def stop(self, groupMask: int = 0) -> None:
        """Make the high-level commander idle: motors off; perfect tracking freezes."""
        self._send(c.Stop(groupMask))

    def position(self) -> NDArray[np.float64]:
        """Position (3,) m: the truth in simulation, else the latest measured pose."""
        return np.array(self._state().position, dtype=np.float64)

    def getParam(self, name: str) -> float | None:
        """Value of a firmware parameter ``group/name``; None, with a warning, if unknown."""
        dotted = check_param_name(self._name, name)
        try:
            return self._backend.get_param(self.id, dotted)
        except BackendError as error:
            warn(f"getParam: {error}")
            return None

    def setParam(self, name: str, value: float) -> None:
        """Set the firmware parameter ``group/name``."""
        self._send(c.SetParam(check_param_name(self._name, name), value))

    def setParams(self, params: Mapping[str, float]) -> None:
        """Set several parameters, in the order of the mapping."""
        for name, value in params.items():
            self.setParam(name, value)

    def cmdVelocityWorld(self, vel: ArrayLike, yawRate: float) -> None:
        """Stream a velocity (3,) m/s, world, and a yaw rate in deg/s, counter-clockwise."""
        self._send(c.VelocityWorld(vector(vel), np.radians(yawRate)))

    def cmdVel(self, roll: float, pitch: float, yawrate: float, thrust: float) -> None:
        """Stream roll, pitch (positive: nose down) in deg, yaw rate in deg/s, thrust 0..65535.

        Perfect tracking has no attitude to command: CommandError there.
        """
        self._send(
            c.Attitude(np.radians(roll), np.radians(pitch), np.radians(yawrate), int(thrust))
        )

    def cmdStop(self) -> None:
        """Cut the motors now; perfect tracking freezes."""
        self._send(c.CutMotors())

    def setLEDColor(self, r: float, g: float, b: float) -> None:
        """Colour of the LED ring, 0..1 each (a real ring needs ``ring/effect`` 7)."""
        self._send(c.SetLed(r, g, b))
        self.ledRGB = (r, g, b)

    # What follows exists in simulation only (state from telemetry, so it also works wherever a
    # link reports attitude and velocity).

    def _inspect(self, what: str) -> InspectableBackend:
        if isinstance(self._backend, InspectableBackend):
            return self._backend
        raise AttributeError(
            f"{self._name}: '{what}' exists only with perfect tracking (--backend ideal)"
        )

    @property
    def mode(self) -> int:
        """Flight mode, one of the ``MODE_`` constants (perfect tracking only)."""
        return self._inspect("mode").mode(self.id)

    @property
    def state(self) -> IdealState:
        """True motion (perfect tracking only)."""
        return self._inspect("state").state(self.id)

    @property
    def setState(self) -> IdealState:
        """Setpoint of the latest tick (perfect tracking only)."""
        return self._inspect("setState").setpoint(self.id)

    @property
    def planner(self) -> Any:
        """Planner of the high-level commander, with its ``state`` (perfect tracking only)."""
        return self._inspect("planner").planner(self.id)

    def velocity(self) -> NDArray[np.float64]:
        """Velocity (3,) m/s, world."""
        return np.array(self._state().velocity, dtype=np.float64)

    def acceleration(self) -> NDArray[np.float64]:
        """Acceleration (3,) m/s², world, of the setpoint that is tracked (perfect tracking)."""
        return np.array(self._inspect("acceleration").state(self.id).acc)

    def yaw(self) -> float:
        """Yaw, rad; with perfect tracking it is not wrapped."""
        if isinstance(self._backend, InspectableBackend):
            return self._backend.state(self.id).yaw
        rotation = self.rotBodyToWorld()
        return float(np.arctan2(rotation[1, 0], rotation[0, 0]))

    def rotBodyToWorld(self) -> NDArray[np.float64]:
        """Rotation matrix (3, 3) from body to world."""
        return _rotation(self._state())

    def rpy(self) -> NDArray[np.float64]:
        """Roll, pitch, yaw in rad: forward acceleration pitches up, leftward rolls negative."""
        rotation = self.rotBodyToWorld()
        roll = np.arctan2(rotation[2, 1], rotation[2, 2])
        pitch = np.arcsin(np.clip(-rotation[2, 0], -1.0, 1.0))
        return np.array([roll, pitch, self.yaw()])


class CrazyflieServer(FleetCore):
    """The fleet: ``crazyflies`` in file order, ``crazyfliesById``, and the broadcasts.

    Parameters
    ----------
    timeHelper: its clock drives the simulation.
    crazyflies_yaml: path ending in ``.yaml``, or the YAML text.
    backend: name in :data:`.registry.ENTRIES`.
    uris, mocap, watchdog: see :func:`.hardware.with_uris`, :func:`.hardware.start_hardware`.
    guard: arena in which the safety keeps the fleet, as ``--guard``; None for no safety.
    """

    def __init__(
        self,
        timeHelper: Any,
        crazyflies_yaml: str | os.PathLike[str] | FleetConfig = DEFAULT_YAML,
        backend: str = "ideal",
        uris: str | None = None,
        mocap: str | None = None,
        watchdog: bool = False,
        guard: str | None = None,
    ) -> None:
        if isinstance(crazyflies_yaml, FleetConfig):
            fleet = crazyflies_yaml
        else:
            fleet = _load_fleet(crazyflies_yaml, with_types=backend == "radio")
        fleet = with_uris(fleet, uris)
        link, guarded = open_fleet(backend, fleet, timeHelper, guard)
        configs = by_config(fleet, link)
        cfs = [Crazyflie(guarded or link, config, timeHelper) for config in configs]
        super().__init__(link, guarded, cfs, timeHelper)
        timeHelper.crazyflies = self.crazyflies
        if backend == "radio":
            self._start_hardware(fleet, timeHelper.clock, mocap, watchdog)

    def stop(self, groupMask: int = 0) -> None:
        """Make every high-level commander idle."""
        self._send(c.Stop(groupMask))

    def setParam(self, name: str, value: float) -> None:
        """Set the firmware parameter ``group/name`` of every vehicle; a warning for those
        without it."""
        self._set_param(check_param_name(EVERYBODY, name), value)


def _load_fleet(given: str | os.PathLike[str], with_types: bool) -> FleetConfig:
    types = None
    if with_types and (isinstance(given, os.PathLike) or given.rstrip().endswith(".yaml")):
        path = Path(given).with_name("crazyflieTypes.yaml")
        types = load_types_1(path) if path.exists() else None
    return load_crazyflies_1(given, types)


class Crazyswarm:
    """Entry of a script: ``timeHelper``, ``allcfs`` and ``input``.

    Parameters
    ----------
    crazyflies_yaml: path ending in ``.yaml`` or YAML text; ``../launch/crazyflies.yaml`` if None.
    parent_parser: an ``ArgumentParser(add_help=False)`` with the script's own flags.
    args: command line, text or list; ``sys.argv[1:]`` if None. See :mod:`.options`.

    Raises
    ------
    InputError
        for wrong flags or a wrong vehicle list, naming the field.
    BackendError
        if the link cannot be opened.
    """

    def __init__(
        self,
        crazyflies_yaml: str | os.PathLike[str] | None = None,
        parent_parser: argparse.ArgumentParser | None = None,
        args: str | Sequence[str] | None = None,
    ) -> None:
        parsed = parse(args, parent_parser)
        if crazyflies_yaml is None:
            crazyflies_yaml = parsed.crazyflies_yaml or DEFAULT_YAML
        fleet = _load_fleet(crazyflies_yaml, with_types=parsed.backend == "radio")
        parsed = with_guard_of(parsed, fleet)
        self.timeHelper: TimeHelper | WallTimeHelper
        if parsed.sim:
            self.timeHelper = make_time_helper(parsed, open_visualizer(parsed.vis), TimeHelper)
            if parsed.writecsv or parsed.video:
                atexit.register(self.timeHelper._atexit)
        else:
            # Of viewers, only this one draws elsewhere than where the script flies.
            vis = VisViser(pace=0.0) if parsed.vis == "viser" else None
            self.timeHelper = WallTimeHelper(WallClock(), vis)
        self.allcfs = CrazyflieServer(
            self.timeHelper,
            fleet,
            parsed.backend,
            parsed.uri,
            parsed.mocap,
            parsed.watchdog,
            parsed.guard,
        )
        record_script(parsed.record, self.timeHelper, self.allcfs)
        self.input = Joystick(self.timeHelper)
