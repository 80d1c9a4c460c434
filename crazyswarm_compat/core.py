"""What both generations of the Crazyswarm API share: one vehicle, one fleet, over a backend.

The method names are those of the API (camel case), so that scripts run unmodified. Every call
is checked before it is sent; the error names the vehicle and the argument. Flight commands are
asynchronous: they return at once, the motion happens while the script sleeps.
"""

from __future__ import annotations

import atexit
import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.backend import Backend
from crazyarena.crazyswarm_compat.checks import check
from crazyarena.crazyswarm_compat.config import FleetConfig, VehicleConfig
from crazyarena.crazyswarm_compat.guard import FleetGuard, FlightEnded
from crazyarena.crazyswarm_compat.hardware import PoseFeed, land_flying, start_hardware
from crazyarena.crazyswarm_compat.link_watch import LinkWatch
from crazyarena.crazyswarm_compat.options import warn
from crazyarena.crazyswarm_compat.registry import open_backend, open_guard, open_lookout
from crazyarena.crazyswarm_compat.server_files import LinkLimits
from crazyarena.errors import BackendError, CommandError
from crazyarena.types import VehicleContact, VehicleState

EVERYBODY = "all vehicles"
# How long a script waits for the first pose of a vehicle that nobody has seen yet.
FIRST_POSE_TIMEOUT = 10.0
_AXES = ("px", "py", "pz", "pyaw")


def vector(value: ArrayLike) -> Any:
    """Own copy of a vector argument, so that the script may reuse its array."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return value  # the check that follows says what is wrong with it


def pieces_of(trajectory: Any, who: str) -> NDArray[np.float64]:
    """Rows (n, 33) of a ``uav_trajectory.Trajectory``; CommandError names piece and axis."""
    polynomials = getattr(trajectory, "polynomials", None)
    if polynomials is None:
        raise CommandError(f"{who}: uploadTrajectory: {trajectory!r} has no polynomials")
    rows = np.empty((len(polynomials), 33))
    for index, piece in enumerate(polynomials):
        rows[index, 0] = piece.duration
        for axis, name in enumerate(_AXES):
            p = np.asarray(getattr(piece, name).p, dtype=np.float64)
            if p.shape != (8,):
                raise CommandError(
                    f"{who}: uploadTrajectory: piece {index}, {name} has shape {p.shape}; a "
                    "polynomial must have 8 coefficients, ascending powers"
                )
            rows[index, 1 + 8 * axis : 9 + 8 * axis] = p
    return rows


class VehicleCore:
    """One vehicle: the verbs that Crazyswarm 1 and 2 have in common.

    ``groupMask`` 0 addresses the vehicle in any case, otherwise only if its own mask shares a
    bit. SI units, yaw in rad, world frame x forward, y left, z up.
    """

    def __init__(self, backend: Backend, config: VehicleConfig, timeHelper: Any) -> None:
        self.id = config.id
        self.initialPosition = np.array(config.initial_position, dtype=np.float64)
        self._name = config.name
        self._backend = backend
        self._time_helper = timeHelper

    def _send(self, command: c.Command) -> None:
        check(command, self._name)
        self._backend.send(command, self.id)

    def _state(self) -> VehicleState:
        """Last known state; waits for the first one."""
        clock = self._time_helper.clock
        deadline = clock.now() + FIRST_POSE_TIMEOUT
        while (state := self._backend.telemetry(self.id).state) is None:
            if clock.now() >= deadline:
                raise BackendError(
                    f"{self._name}: no pose within {FIRST_POSE_TIMEOUT:g} s; is the vehicle in "
                    "view of the motion-capture system?"
                )
            clock.sleep_until(clock.now() + 0.01)
        return state

    def setGroupMask(self, groupMask: int) -> None:
        """Set the 8-bit mask of groups that this vehicle belongs to."""
        self._send(c.SetGroupMask(groupMask))

    def takeoff(self, targetHeight: float, duration: float, groupMask: int = 0) -> None:
        """Rise to ``targetHeight`` m (absolute) in ``duration`` s, turning to yaw 0.

        Ignored in flight.
        """
        self._send(c.Takeoff(targetHeight, duration, 0.0, groupMask))

    def land(self, targetHeight: float, duration: float, groupMask: int = 0) -> None:
        """Descend to ``targetHeight`` m (absolute) in ``duration`` s, turning to yaw 0."""
        self._send(c.Land(targetHeight, duration, 0.0, groupMask))

    def goTo(
        self,
        goal: ArrayLike,
        yaw: float,
        duration: float,
        relative: bool = False,
        groupMask: int = 0,
    ) -> None:
        """Fly to ``goal`` (3,) m and ``yaw`` rad, at rest there after ``duration`` s.

        ``relative`` adds both to the present setpoint. CommandError (a ValueError) where the
        high-level commander is not in charge: before takeoff, or after a streamed setpoint
        without :meth:`notifySetpointsStop`.
        """
        self._send(c.GoTo(vector(goal), yaw, duration, bool(relative), groupMask))

    def uploadTrajectory(self, trajectoryId: int, pieceOffset: int, trajectory: Any) -> None:
        """Store a trajectory; ``pieceOffset`` counts the pieces stored before it (31 in all)."""
        pieces = pieces_of(trajectory, self._name)
        self._send(c.UploadTrajectory(trajectoryId, pieceOffset, pieces))

    def startTrajectory(
        self,
        trajectoryId: int,
        timescale: float = 1.0,
        reverse: bool = False,
        relative: bool = True,
        groupMask: int = 0,
    ) -> None:
        """Fly an uploaded trajectory; ``timescale`` 2 takes twice as long.

        ``relative`` shifts it so that it begins where the vehicle is; yaw is not shifted.
        CommandError (a KeyError) if the id has not been uploaded.
        """
        self._send(
            c.StartTrajectory(trajectoryId, timescale, bool(reverse), bool(relative), groupMask)
        )

    def notifySetpointsStop(self, remainValidMillisecs: int = 100, groupMask: int = 0) -> None:
        """Hand control from streamed setpoints back to the high-level commander."""
        self._send(c.NotifySetpointsStop(remainValidMillisecs, groupMask))

    def cmdFullState(
        self, pos: ArrayLike, vel: ArrayLike, acc: ArrayLike, yaw: float, omega: ArrayLike
    ) -> None:
        """Stream position m, velocity m/s, acceleration m/s², yaw rad and body rates rad/s."""
        self._send(c.FullState(vector(pos), vector(vel), vector(acc), yaw, vector(omega)))

    def cmdPosition(self, pos: ArrayLike, yaw: float = 0.0) -> None:
        """Stream an absolute position m and yaw rad."""
        self._send(c.Position(vector(pos), yaw))


def _close(link: weakref.ref[Backend]) -> None:
    backend = link()
    if backend is not None:
        backend.close()


def _land(link: weakref.ref[Backend], clock: Clock) -> None:
    backend = link()
    if backend is not None:
        land_flying(backend, clock)


class VehiclesById(dict[int, Any]):
    """Vehicles by id; a missing id says which there are."""

    def __missing__(self, key: object) -> Any:
        known = ", ".join(str(number) for number in self) or "none"
        raise KeyError(f"no vehicle with id {key!r}; the fleet has {known}")


class FleetCore:
    """All vehicles, and the broadcasts that both generations have in common."""

    guard: FleetGuard | None
    """The safety around the fleet, if ``--guard`` asked for it."""

    def __init__(
        self, link: Backend, guard: FleetGuard | None, vehicles: Sequence[Any], timeHelper: Any
    ) -> None:
        self._link = link
        self._backend: Backend = guard or link
        self.guard = guard
        self._feed: PoseFeed | None = None
        self._time_helper = timeHelper
        self.crazyflies = list(vehicles)
        self.crazyfliesById = VehiclesById((cf.id, cf) for cf in self.crazyflies)
        timeHelper.visualizer.follow(link, guard)
        if timeHelper.visualizer.in_wall_time:
            # Where time passes by itself, nobody else tells it to draw.
            timeHelper.while_sleeping(
                lambda: timeHelper.visualizer.update(timeHelper.time(), self.crazyflies)
            )
        # A script has no call that ends a fleet, and may keep only one of its vehicles: the
        # link is released at exit, unless it has gone before. A guard stays to the end.
        report = getattr(link, "script_report", None)
        self._report = None if report is None else report(guard is not None)
        if self._report is not None:
            # Registered first, so that it has the last word.
            atexit.register(self._report.exit)
            timeHelper.while_sleeping(self._report.check)
        if guard is None:
            atexit.register(_close, weakref.ref(link))
        else:
            atexit.register(guard.close)
            timeHelper.while_sleeping(guard.check)

    def _send(self, command: c.Command) -> None:
        check(command, EVERYBODY)
        self._backend.send(command, None)

    def _set_param(self, name: str, value: float) -> None:
        command = c.SetParam(name, value)
        check(command, EVERYBODY)
        for vehicle in self._backend.vehicles:
            try:
                self._backend.send(command, vehicle)
            except FlightEnded:
                raise
            except BackendError as error:
                warn(f"setParam: ignored; {error}")

    def _start_hardware(
        self,
        fleet: FleetConfig,
        clock: Clock,
        mocap: str | None,
        watchdog: bool,
        limits: LinkLimits | None = None,
    ) -> None:
        lookout = None
        if self.guard is None and mocap is not None:
            bodies = {vehicle.name: vehicle.id for vehicle in fleet.vehicles}
            lookout = open_lookout(self._link, bodies, clock)
            self._time_helper.while_sleeping(lookout.check)
        try:
            self._feed = start_hardware(
                fleet, self._link, clock, mocap, watchdog, self.guard, lookout
            )
        except BaseException:
            self.close()
            raise
        if limits is not None:
            names = {vehicle.id: vehicle.name for vehicle in fleet.vehicles}
            poses = None if self._feed is None else self._feed.statistics
            watch = LinkWatch(limits, self._link, names, clock, poses)
            self._time_helper.while_sleeping(watch.check)
        # Threads that are inside C++ when the interpreter ends abort it. The latest registered is
        # called first: what flies is landed, with poses, then they end, then the link goes.
        if self._feed is not None:
            atexit.register(self._feed.close)
        if self.guard is not None:
            atexit.register(self.guard.finish)
        else:
            atexit.register(_land, weakref.ref(self._link), clock)

    @property
    def contacts(self) -> Sequence[VehicleContact]:
        """Contacts between vehicles so far, by their ids, each at its beginning.

        Simulations with dynamics report them (and warn); other backends know of none.
        """
        return tuple(getattr(self._link, "contacts", ()))

    def close(self) -> None:
        """Release the link; a guarded fleet is landed first. Idempotent."""
        if self.guard is not None:
            atexit.unregister(self.guard.finish)
            atexit.unregister(self.guard.close)
            self.guard.finish()
        if self._feed is not None:
            atexit.unregister(self._feed.close)
            self._feed.close()
        if self._report is not None:
            atexit.unregister(self._report.exit)
            self._report.finish()
        self._backend.close()

    def emergency(self) -> None:
        """Cut the motors of every vehicle; further commands are ignored until reboot."""
        self._send(c.Emergency())

    def takeoff(self, targetHeight: float, duration: float, groupMask: int = 0) -> None:
        """Rise to ``targetHeight`` m (absolute) in ``duration`` s."""
        self._send(c.Takeoff(targetHeight, duration, 0.0, groupMask))

    def land(self, targetHeight: float, duration: float, groupMask: int = 0) -> None:
        """Descend to ``targetHeight`` m (absolute) in ``duration`` s."""
        self._send(c.Land(targetHeight, duration, 0.0, groupMask))

    def goTo(self, goal: ArrayLike, yaw: float, duration: float, groupMask: int = 0) -> None:
        """Move every vehicle by ``goal`` (3,) m and ``yaw`` rad: always relative."""
        self._send(c.GoTo(vector(goal), yaw, duration, True, groupMask))

    def startTrajectory(
        self,
        trajectoryId: int,
        timescale: float = 1.0,
        reverse: bool = False,
        relative: bool = True,
        groupMask: int = 0,
    ) -> None:
        """Fly the trajectory that each vehicle has uploaded under this id."""
        self._send(
            c.StartTrajectory(trajectoryId, timescale, bool(reverse), bool(relative), groupMask)
        )


def open_fleet(
    backend: str, fleet: FleetConfig, timeHelper: Any, guard: str | None
) -> tuple[Backend, FleetGuard | None]:
    """Open the link, and with ``guard`` (an arena) the safety around it."""
    clock = timeHelper.clock
    options = getattr(timeHelper, "options", None)
    link = open_backend(backend, fleet, clock, options)
    if guard is None:
        return link, None
    try:
        return link, open_guard(guard, fleet, link, clock, options)
    except BaseException:
        link.close()
        raise


def by_config(fleet: FleetConfig, backend: Backend) -> list[VehicleConfig]:
    """Configurations of the vehicles that the backend really has, in its order."""
    known = {config.id: config for config in fleet.vehicles}
    return [known[number] for number in backend.vehicles if number in known]
