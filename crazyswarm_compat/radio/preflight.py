"""Makes one vehicle ready for take-off, or says why it is not."""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.positioning import positioning
from crazyarena.crazyswarm_compat.radio.link import VehicleLink
from crazyarena.crazyswarm_compat.radio.telemetry import (
    ARMED,
    CAN_BE_ARMED,
    CRASHED,
    FLYING,
    LOCKED,
    POSITION_VARIANCES,
    TUMBLED,
    Block,
    knows,
)
from crazyarena.errors import BackendError
from crazyarena.types import Pose, VehicleState

_LOG = logging.getLogger(__name__)

_KALMAN = 2
_VARIANCES = ("kalman.varPX", "kalman.varPY", "kalman.varPZ")
_SAMPLES = 10  # of the variance, at 10 Hz
_SPREAD = 1e-3  # m², of the variance over these
_LARGEST = 0.15**2  # m², of the variance itself
_POLL = 0.05
_TELEMETRY_PATIENCE = 3.0
_LANDED_PATIENCE = 3.0


@dataclass(frozen=True, slots=True)
class Preparation:
    """What a vehicle needs before take-off.

    estimator: 1 complementary, 2 Kalman; controller: 1 PID, 2 Mellinger, None to leave it;
    params: ``group.name`` to value, written and read back; battery: at least so many volts, None
    for the warning level of the fleet's configuration; needs_pose: external poses must be coming
    in and the estimate must agree with them within position_tolerance m and yaw_tolerance rad;
    pose_age: of the latest, s; convergence_timeout s; arm: arm a vehicle that waits for it;
    onboard: instead of external poses it knows its place by a positioning deck. One that is only
    counted begins at its initial position, nose along x.
    """

    estimator: int = _KALMAN
    controller: int | None = None
    params: Mapping[str, float] = field(default_factory=dict)
    battery: float | None = None
    needs_pose: bool = True
    position_tolerance: float = 0.1
    yaw_tolerance: float = math.radians(10.0)
    pose_age: float = 0.5
    convergence_timeout: float = 15.0
    arm: bool = True
    onboard: bool = False


def prepare_vehicle(link: VehicleLink, wanted: Preparation, clock: Clock) -> None:
    """Prepare one vehicle (blocks).

    Raises
    ------
    BackendError
        naming the vehicle, what was found and what to do.
    """
    if not link.connected:
        raise BackendError(f"{link.name}: not connected; switch it on and connect again")
    _Preflight(link, wanted, clock).run()


class _Preflight:
    def __init__(self, link: VehicleLink, wanted: Preparation, clock: Clock) -> None:
        self._link = link
        self._wanted = wanted
        self._clock = clock
        self._variances = _VARIANCES

    def run(self) -> None:
        self._supervisor()
        self._battery()
        pose = None
        if self._wanted.onboard:
            pose = self._own_place()
        elif self._wanted.needs_pose:
            pose = self._pose()
        self._parameters()
        self._reset_estimator(pose)
        self._converged()
        if self._wanted.arm:
            self._arm()

    def _fail(self, text: str) -> BackendError:
        return BackendError(f"{self._link.name}: {text}")

    def _wait(self, holds: Callable[[], bool], timeout: float) -> bool:
        deadline = self._clock.now() + timeout
        while not holds():
            if self._clock.now() >= deadline:
                return False
            self._clock.sleep_until(self._clock.now() + _POLL)
        return True

    def _flags(self) -> int:
        return self._link.telemetry.latest.supervisor or 0

    def _supervisor(self) -> None:
        telemetry = self._link.telemetry
        if not self._wait(lambda: telemetry.latest.supervisor is not None, _TELEMETRY_PATIENCE):
            raise self._fail(
                "does not report its supervisor; set health_rate above 0, or update its firmware"
            )
        # The firmware says "flying" for 2 s after its motors have stopped: a script that follows
        # another at once would be turned away.
        self._wait(lambda: self._flags() & (FLYING | LOCKED) != FLYING, _LANDED_PATIENCE)
        flags = self._flags()
        if flags & LOCKED:
            raise self._fail("is locked after an emergency stop; switch it off and on again")
        if flags & (TUMBLED | CRASHED):
            raise self._fail("reports a crash or lies upside down; put it level on the floor")
        if flags & FLYING:
            raise self._fail("is flying; its estimator must not be reset in the air, land first")

    def _battery(self) -> None:
        telemetry = self._link.telemetry
        least = self._wanted.battery
        least = self._link.config.battery_warning if least is None else least
        self._wait(lambda: telemetry.latest.battery is not None, _TELEMETRY_PATIENCE)
        found = telemetry.latest.battery
        if found is None:
            raise self._fail("does not report its battery (pm.vbat)")
        if found < least:
            raise self._fail(f"battery at {found:.2f} V; at least {least:.2f} V wanted, charge it")

    def _pose(self) -> Pose:
        if not self._wait(lambda: self._fresh_pose() is not None, 2.0):
            last = self._link.last_pose
            heard = (
                "none yet" if last is None else f"the last {self._clock.now() - last[0]:.1f} s ago"
            )
            raise self._fail(
                f"no external poses are coming in ({heard}); is it in view of the motion-capture "
                "system, and its body named after it?"
            )
        pose = self._fresh_pose()
        assert pose is not None
        return pose

    def _own_place(self) -> Pose | None:
        """Where a vehicle with a positioning deck begins to estimate, None to leave it as it is."""
        link = self._link
        decks = positioning(link.parameters.get)
        if not decks.decks:
            raise self._fail(
                "has no positioning deck (deck.bcLighthouse4, bcLoco, bcFlow2 are 0); fit one and "
                "restart it, or give it poses by --mocap"
            )
        self._variances = _VARIANCES if decks.relative else POSITION_VARIANCES
        if decks.relative:
            x, y, _ = link.config.initial_position
            return Pose(np.array((x, y, 0.0)))
        state = link.telemetry.latest.state
        return None if state is None else Pose(state.position, state.quaternion)

    def _fresh_pose(self) -> Pose | None:
        last = self._link.last_pose
        if last is None or self._clock.now() - last[0] > self._wanted.pose_age:
            return None
        pose: Pose = last[1]
        return pose

    def _parameters(self) -> None:
        link, wanted = self._link, self._wanted
        values: dict[str, float] = {"stabilizer.estimator": wanted.estimator}
        if wanted.controller is not None:
            values["stabilizer.controller"] = wanted.controller
        if link.parameters.has("commander.enHighLevel"):
            values["commander.enHighLevel"] = 1
        for name, value in {**values, **wanted.params}.items():
            link.set_param(name, value)

    def _reset_estimator(self, pose: Pose | None) -> None:
        if self._wanted.estimator != _KALMAN:
            return
        link = self._link
        if pose is not None:
            for axis, value in zip("XYZ", pose.position, strict=True):
                link.set_param(f"kalman.initial{axis}", float(value))
            yaw = _yaw(pose.quaternion)
            if math.isfinite(yaw):
                link.set_param("kalman.initialYaw", yaw)
        if self._flags() & FLYING:
            raise self._fail("started to fly while it was being prepared; land first")
        link.set_param("kalman.resetEstimation", 1)
        # The firmware clears the request by itself when it has seen it.
        self._clock.sleep_until(self._clock.now() + 0.1)
        link.set_param("kalman.resetEstimation", 0)

    def _converged(self) -> None:
        link, timeout = self._link, self._wanted.convergence_timeout
        client = link.client
        if client is None:
            raise self._fail("the link was lost while it was being prepared")
        if not all(knows(client, name) for name in self._variances):
            _LOG.info("%s: no variance to watch; the estimate is compared only", link.name)
            if not self._wait(lambda: self._disagreement() is None, timeout):
                raise self._fail(str(self._disagreement()))
            return
        history: deque[tuple[float, ...]] = deque(maxlen=_SAMPLES)

        def received(values: Mapping[str, float], _: int) -> None:
            history.append(tuple(values[name] for name in self._variances))

        block = Block(client, "variance", self._variances, 100, received)
        try:
            if self._wait(lambda: _settled(history) and self._disagreement() is None, timeout):
                return
        finally:
            block.stop()
        if not history:
            raise self._fail(f"did not report the variance of its estimate within {timeout:g} s")
        if not _settled(history):
            spread = np.sqrt(np.max(list(history), axis=0))
            raise self._fail(
                f"its estimator did not converge within {timeout:g} s (standard deviation "
                f"{spread.max():.2f} m); check that "
                + (
                    "its base stations are in sight"
                    if self._wanted.onboard
                    else "external poses reach it"
                )
            )
        raise self._fail(str(self._disagreement()))

    def _disagreement(self) -> str | None:
        """What keeps the estimate from agreeing with the external pose; None if nothing."""
        wanted = self._wanted
        if wanted.onboard or not wanted.needs_pose:
            return None
        pose, state = self._fresh_pose(), self._link.telemetry.latest.state
        if pose is None:
            return "external poses stopped coming in"
        if state is None:
            return "does not report its estimate; set state_rate above 0"
        return _difference(pose, state, wanted.position_tolerance, wanted.yaw_tolerance)

    def _arm(self) -> None:
        link = self._link
        if self._flags() & ARMED:
            return
        if not self._wait(lambda: bool(self._flags() & (CAN_BE_ARMED | ARMED)), 2.0):
            raise self._fail(
                f"cannot be armed (supervisor.info {self._flags():#06x}); is it level, and do its "
                "decks work?"
            )
        if not self._flags() & ARMED:
            link.send(c.Arm(True))
            if not self._wait(lambda: bool(self._flags() & ARMED), 3.0):
                raise self._fail(f"refused to arm (supervisor.info {self._flags():#06x})")


def _settled(history: deque[tuple[float, ...]]) -> bool:
    if len(history) < _SAMPLES:
        return False
    values = np.array(list(history))
    settled = values.max(axis=0) - values.min(axis=0) < _SPREAD
    return bool(settled.all() and (values[-1] < _LARGEST).all())


def _yaw(quaternion: np.ndarray) -> float:
    x, y, z, w = quaternion
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _difference(
    pose: Pose, state: VehicleState, position_tolerance: float, yaw_tolerance: float
) -> str | None:
    offset = float(np.linalg.norm(np.asarray(pose.position) - state.position))
    if not offset <= position_tolerance:
        return (
            f"its estimate is {offset:.2f} m from the external pose (limit "
            f"{position_tolerance:g} m); are bodies swapped, or frames different?"
        )
    measured = _yaw(pose.quaternion)
    if math.isfinite(measured):
        turn = abs(math.remainder(measured - _yaw(state.quaternion), 2.0 * math.pi))
        if turn > yaw_tolerance:
            return (
                f"its heading is {math.degrees(turn):.0f} degrees off the external pose (limit "
                f"{math.degrees(yaw_tolerance):.0f}); turn it, or mend the body's axes in the "
                "motion-capture system"
            )
    return None
