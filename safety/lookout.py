"""Looks at the heading of vehicles that nobody guards.

A body whose nose is not the vehicle's throws every vehicle out of its place, with an arena around
it or without. This is all that is watched in flights without ``--guard``.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat.backend import Backend
from crazyarena.crazyswarm_compat.commands import Emergency
from crazyarena.crazyswarm_compat.guard import FlightEnded
from crazyarena.crazyswarm_compat.options import warn
from crazyarena.mocap.estimator import FrameResult
from crazyarena.safety.heading import Turned
from crazyarena.safety.lasting import Lasting
from crazyarena.safety.limits import Limits
from crazyarena.safety.monitors import CUT_SURELY, WARN_SURELY
from crazyarena.safety.take_off import TakeOffCheck
from crazyarena.types import Pose, PoseFrame

_FLYING = 1 << 4  # of supervisor.info
_REPEATS = 15


class Lookout:
    """Warns of turned bodies, and cuts the motors of those that are turned far.

    Parameters
    ----------
    backend: the vehicle link.
    bodies: vehicle id by the name of its body.
    """

    def __init__(
        self,
        backend: Backend,
        bodies: Mapping[str, int],
        clock: Clock,
        limits: Limits | None = None,
    ) -> None:
        self._backend = backend
        self._clock = clock
        self._bodies = dict(bodies)
        self._limits = limits or Limits()
        self._checks = {name: TakeOffCheck(self._limits.nudge) for name in bodies}
        self._slightly = {name: Lasting() for name in bodies}
        self._names = {vehicle: name for name, vehicle in bodies.items()}
        self._grounds: dict[str, float] = {}
        self._warned: set[str] = set()
        self._cut: dict[str, int] = {}
        self._told: deque[tuple[str, bool, str]] = deque()
        self._lock = threading.Lock()

    def send_external_poses(self, poses: Mapping[int, Pose]) -> None:
        """Pass on what the vehicles are told of their places, with a nudge at the take-off."""
        now = self._clock.now()
        with self._lock:
            told = {v: self._nudged(v, pose, now) for v, pose in poses.items()}
        self._backend.send_external_poses(told)

    def _nudged(self, vehicle: int, pose: Pose, now: float) -> Pose:
        name = self._names.get(vehicle)
        return pose if name is None else self._checks[name].nudged(pose, now)

    def on_frame(self, frame: PoseFrame, result: FrameResult) -> None:
        """A pose frame has been through the estimator; any thread."""
        with self._lock:
            for name, pose in frame.bodies.items():
                if name in self._bodies and name in result.accepted:
                    self._look(name, pose, frame.timestamp)

    def _look(self, name: str, pose: Pose, captured: float) -> None:
        if name in self._cut:
            self._stop(name)
            return
        told, check = self._backend.telemetry(self._bodies[name]), self._checks[name]
        height = float(pose.position[2])
        if told.state is None or not (told.supervisor or 0) & _FLYING:
            self._grounds[name] = height
            check.stands()
            return
        above = height - self._grounds.setdefault(name, height)
        self._judge(name, check.flies(captured, pose, above, told), captured)

    def _judge(self, name: str, turned: Turned, time: float) -> None:
        n, angle, yaw = self._limits, abs(turned.angle), abs(turned.yaw)
        far = angle > n.turn_cut and turned.surely >= CUT_SURELY * n.turn_cut
        if far or yaw > n.yaw_cut:
            self._cut[name] = 0
            self._stop(name)
            self._told.append((name, True, turned.remedy))
            return
        slightly = turned.known and angle > n.turn_warn
        slightly = slightly and turned.surely >= WARN_SURELY * n.turn_warn
        held = self._slightly[name].update(slightly, time)
        told = held is not None and held >= n.turn_time
        if (told or yaw > n.yaw_warn) and name not in self._warned:
            self._warned.add(name)
            self._told.append((name, False, turned.remedy))

    def _stop(self, name: str) -> None:
        if self._cut[name] < _REPEATS:
            self._cut[name] += 1
            self._backend.send(Emergency(), self._bodies[name])

    def check(self) -> None:
        """Say what was found, in the script's thread; raises FlightEnded for what was cut."""
        while self._told:
            name, cut, text = self._told.popleft()
            if cut:
                raise FlightEnded(f"{name}: motors cut: {text}")
            warn(f"{name}: {text}")


def open_lookout(backend: Backend, bodies: Mapping[str, int], clock: Clock) -> Lookout:
    """Factory named in the registry of backends."""
    return Lookout(backend, bodies, clock)
