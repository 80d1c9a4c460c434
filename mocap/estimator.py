"""Position, velocity, attitude and body rates of every body, from the poses of a source.

Outliers never pass: a measurement must lie where the body can have come since it was last
accepted. What is rejected long enough makes the body stale, and only a run of measurements
that agree with each other makes it fresh again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from crazyarena.errors import InputError
from crazyarena.mocap import estimator_kernels as kernels
from crazyarena.mocap.events import EventKind, MocapEvent
from crazyarena.types import Pose, PoseFrame, VehicleState

# Capture times may seem to lie this far ahead by errors of clock conversion, s.
_CLOCK_SLACK = 1e-3


class Freshness(StrEnum):
    """How far an estimate may be trusted."""

    NEVER = "never"  # not seen since the start
    FRESH = "fresh"  # rests on a measurement no older than ``fresh_within``
    BRIDGED = "bridged"  # carried on by prediction, not longer than ``stale_after``
    STALE = "stale"  # older: good for nothing but a look back


@dataclass(frozen=True, slots=True)
class EstimatorConfig:
    """Settings of :class:`PoseEstimator`.

    Attributes
    ----------
    position_std, attitude_std: noise of the camera system per axis, m and rad.
    jerk, angular_jerk: how briskly bodies change their acceleration: square root of the white
        jerk's spectral density, m/s^2.5 and rad/s^2.5.
    stale_after: age, s since capture, at which a body is reported stale; estimates are not
        extrapolated further than this.
    fresh_within: age, s, up to which an estimate counts as fresh rather than bridged.
    jump_gate: largest believable distance of a measurement from its prediction, m; it grows
        with ``max_acceleration`` (m/s^2) times half the squared age, up to ``jump_limit`` (m).
    flip_gate: the same for the attitude, rad, with ``max_angular_acceleration`` (rad/s^2) and
        ``flip_limit`` (rad).
    confirm_frames: consecutive consistent measurements that start or restart a track.
    max_tilt: a track never starts further from upright than this, rad; pi to allow anything.
    correct_swaps: give measurements back to the body they continue when names are mixed up.
    frozen_after: time, s, after which a pose that does not change by a bit counts as not seen;
        None to allow it (noise-free simulation). Real cameras always tremble.
    """

    position_std: float = 0.0007
    attitude_std: float = 0.01
    jerk: float = 10.0
    angular_jerk: float = 60.0
    stale_after: float = 0.15
    fresh_within: float = 0.03
    jump_gate: float = 0.08
    max_acceleration: float = 40.0
    jump_limit: float = 0.4
    flip_gate: float = 0.7
    max_angular_acceleration: float = 300.0
    flip_limit: float = 2.2
    confirm_frames: int = 3
    max_tilt: float = 1.6
    correct_swaps: bool = True
    frozen_after: float | None = None

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if name == "correct_swaps" or (name == "frozen_after" and value is None):
                continue
            if not (value > 0 and math.isfinite(value)):
                raise InputError(f"estimator {name}: found {value!r}; need a number above 0")
        if self.confirm_frames < 2:
            raise InputError(
                f"estimator confirm_frames: found {self.confirm_frames}; need 2 or more, "
                "one frame alone may be an outlier"
            )

    def vector(self) -> np.ndarray:
        """Return the settings in the order of the kernels."""
        settings = np.zeros(kernels.SETTINGS)
        settings[kernels.POSITION_VARIANCE] = self.position_std**2
        settings[kernels.JERK_DENSITY] = self.jerk**2
        settings[kernels.ATTITUDE_VARIANCE] = self.attitude_std**2
        settings[kernels.RATE_JERK_DENSITY] = self.angular_jerk**2
        settings[kernels.JUMP_GATE] = self.jump_gate
        settings[kernels.JUMP_GROWTH] = self.max_acceleration
        settings[kernels.JUMP_LIMIT] = self.jump_limit
        settings[kernels.FLIP_GATE] = self.flip_gate
        settings[kernels.FLIP_GROWTH] = self.max_angular_acceleration
        settings[kernels.FLIP_LIMIT] = self.flip_limit
        settings[kernels.STALE_AFTER] = self.stale_after
        settings[kernels.CONFIRM] = self.confirm_frames
        settings[kernels.CANDIDATE_GATE] = 0.03
        settings[kernels.CANDIDATE_SPEED] = 5.0
        settings[kernels.MIN_UPRIGHT] = math.cos(min(self.max_tilt, math.pi))
        frozen_after = math.inf if self.frozen_after is None else self.frozen_after
        settings[kernels.FROZEN_AFTER] = frozen_after
        settings[kernels.CORRECT_SWAPS] = float(self.correct_swaps)
        return settings


@dataclass(frozen=True, slots=True)
class BodyEstimate:
    """Estimate of one body at ``state.timestamp``.

    ``age`` is the time since the capture of the last accepted pose, s (inf when there was
    none); position and attitude of a stale estimate are the last extrapolated ones.
    """

    name: str
    state: VehicleState
    freshness: Freshness
    age: float


@dataclass(frozen=True, slots=True)
class FrameResult:
    """What one frame brought: poses fit to be passed on, as measured, and events."""

    accepted: Mapping[str, Pose]
    events: tuple[MocapEvent, ...]


class PoseEstimator:
    """Estimate the state of the named bodies from pose frames.

    Call :meth:`update` for every frame in order, :meth:`check` at least as often as staleness
    must be noticed, and :meth:`estimate` whenever needed. Not thread-safe: one owner.
    Equal frames and calls give equal results, bit for bit.
    """

    def __init__(self, bodies: Sequence[str], config: EstimatorConfig | None = None) -> None:
        if len(set(bodies)) != len(bodies):
            raise InputError(f"bodies: a name occurs twice in {list(bodies)}")
        self.config = config or EstimatorConfig()
        self.bodies = tuple(bodies)
        count = len(self.bodies)
        self._index = {name: i for i, name in enumerate(self.bodies)}
        self._settings = self.config.vector()
        self._rows = kernels.blank_rows(count)
        self._poses = np.zeros((count, 7))
        self._seen = np.zeros(count, dtype=np.bool_)
        self._taken = np.zeros(count, dtype=np.int64)
        self._outcome = np.zeros(count, dtype=np.int64)
        self._state = np.zeros((count, 13))
        # One event per disturbance, not one per frame.
        self._disturbed = [kernels.ACCEPTED] * count
        self._stale = [False] * count
        self._was_tracked = [False] * count
        self.rejected = 0
        self.swaps = 0

    def warm_up(self) -> None:
        """Compile the kernels now, so that the first frame does not wait for it."""
        rows = kernels.blank_rows(1)
        flags = np.zeros(1, dtype=np.bool_)
        whole = np.zeros(1, dtype=np.int64)
        kernels.step(rows, np.zeros((1, 7)), flags, 0.0, self._settings, whole, whole.copy())
        kernels.extrapolate(rows, 0.0, 0.0, np.zeros((1, 13)))

    def reset(self, name: str) -> None:
        """Forget a body, e.g. after it was turned over by hand."""
        i = self._row(name)
        self._rows[i] = kernels.blank_rows(1)[0]
        self._stale[i] = self._was_tracked[i] = False
        self._disturbed[i] = kernels.ACCEPTED

    def update(self, frame: PoseFrame) -> FrameResult:
        """Take one frame; bodies nobody asked for are ignored."""
        if not frame.timestamp <= frame.received + _CLOCK_SLACK:
            # Believed, it would make every body look long unseen.
            self.rejected += 1
            message = f"frame {frame.frame_id} claims a capture time after its arrival; not used"
            event = MocapEvent(frame.received, EventKind.BAD_FRAME, None, message)
            return FrameResult({}, (event,))
        poses = self._poses
        seen = self._seen
        bodies = frame.bodies
        for i, name in enumerate(self.bodies):
            pose = bodies.get(name)
            if pose is None:
                seen[i] = False
            else:
                seen[i] = True
                poses[i, :3] = pose.position
                poses[i, 3:] = pose.quaternion
        kernels.step(
            self._rows, poses, seen, frame.timestamp, self._settings, self._taken, self._outcome
        )
        accepted: dict[str, Pose] = {}
        events: list[MocapEvent] = []
        taken = self._taken.tolist()
        for i, outcome in enumerate(self._outcome.tolist()):
            if outcome == kernels.ACCEPTED and taken[i] == i:
                self._disturbed[i] = kernels.ACCEPTED
                accepted[self.bodies[i]] = bodies[self.bodies[i]]
            elif outcome != kernels.ABSENT and outcome != kernels.PENDING:
                self._unusual(i, outcome, taken, frame, accepted, events)
        return FrameResult(accepted, tuple(events))

    def _unusual(
        self,
        i: int,
        outcome: int,
        taken: list[int],
        frame: PoseFrame,
        accepted: dict[str, Pose],
        events: list[MocapEvent],
    ) -> None:
        name = self.bodies[i]

        def tell(kind: EventKind, message: str) -> None:
            events.append(MocapEvent(frame.received, kind, name, message))

        if outcome == kernels.ACQUIRED:
            accepted[name] = frame.bodies[name]
            if self._was_tracked[i]:
                tell(EventKind.BODY_RECOVERED, f"{name} is tracked again")
            else:
                tell(EventKind.BODY_TRACKED, f"{name} is tracked")
            self._was_tracked[i] = True
            self._stale[i] = False
            self._disturbed[i] = kernels.ACCEPTED
            return
        swapped = taken[i] >= 0 and taken[i] != i
        if swapped:
            self.swaps += 1
            other = self.bodies[taken[i]]
            if outcome == kernels.ACCEPTED:
                accepted[name] = frame.bodies[other]
            if self._disturbed[i] != -1 - taken[i]:
                self._disturbed[i] = -1 - taken[i]
                tell(EventKind.SWAP_CORRECTED, f"{name} arrived under the name {other}")
        elif outcome == kernels.JUMP:
            self.rejected += 1
            if self._disturbed[i] != outcome:
                self._disturbed[i] = outcome
                tell(EventKind.JUMP_REJECTED, f"{name} jumped; its pose is not used")
        if outcome == kernels.FROZEN:
            self.rejected += 1
            if self._disturbed[i] != outcome:
                self._disturbed[i] = outcome
                tell(EventKind.BODY_FROZEN, f"pose of {name} does not change by a bit; not used")
        if outcome == kernels.FLIP:
            self.rejected += 1
            if self._disturbed[i] != outcome:
                self._disturbed[i] = outcome
                tell(EventKind.FLIP_REJECTED, f"attitude of {name} jumped; its pose is not used")

    def check(self, now: float) -> tuple[MocapEvent, ...]:
        """Return an event for every body that has become stale, once per loss."""
        events = []
        for i, name in enumerate(self.bodies):
            if not self._was_tracked[i]:
                continue
            age = now - self._last_seen(i)
            stale = age > self.config.stale_after
            if stale and not self._stale[i]:
                events.append(
                    MocapEvent(
                        now,
                        EventKind.BODY_STALE,
                        name,
                        f"{name} was last seen {age * 1e3:.0f} ms ago",
                    )
                )
            elif self._stale[i] and not stale:
                # The attitude had been stale alone and is back without a new start.
                events.append(
                    MocapEvent(now, EventKind.BODY_RECOVERED, name, f"{name} is tracked again")
                )
            self._stale[i] = stale
        return tuple(events)

    def _last_seen(self, i: int) -> float:
        row = self._rows[i]
        return float(min(row[kernels.POSITION_SEEN], row[kernels.ATTITUDE_SEEN]))

    def _row(self, name: str) -> int:
        try:
            return self._index[name]
        except KeyError:
            raise InputError(f"body {name!r} is not among {list(self.bodies)}") from None

    def estimate(self, name: str, now: float) -> BodyEstimate:
        """Return the estimate of one body at session time ``now`` (latency compensated)."""
        i = self._row(name)
        kernels.extrapolate(
            self._rows[i : i + 1], now, self.config.stale_after, self._state[i : i + 1]
        )
        return self._read(i, now)

    def estimates(self, now: float) -> dict[str, BodyEstimate]:
        """Return the estimates of all bodies at ``now``."""
        kernels.extrapolate(self._rows, now, self.config.stale_after, self._state)
        return {name: self._read(i, now) for i, name in enumerate(self.bodies)}

    def poses(self, now: float) -> dict[str, Pose]:
        """Return the poses at ``now`` of the bodies that are not stale: what contestants see."""
        return {
            name: Pose(e.state.position, e.state.quaternion)
            for name, e in self.estimates(now).items()
            if e.freshness in (Freshness.FRESH, Freshness.BRIDGED)
        }

    def _read(self, i: int, now: float) -> BodyEstimate:
        values = self._state[i].copy()
        age = now - self._last_seen(i)
        if self._rows[i, kernels.STATUS] == kernels.NEVER:
            freshness = Freshness.NEVER
        elif age > self.config.stale_after:
            freshness = Freshness.STALE
        elif age > self.config.fresh_within:
            freshness = Freshness.BRIDGED
        else:
            freshness = Freshness.FRESH
        state = VehicleState(now, values[:3], values[3:6], values[6:10], values[10:])
        return BodyEstimate(self.bodies[i], state, freshness, age)
