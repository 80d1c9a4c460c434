"""What happens around a run: from connecting to a vehicle that is down and disarmed again.

The same phases whether vehicle and cameras are simulated or real. Each has a time limit, and
whatever goes wrong in one of them ends on the abort path, which ends with the vehicle down.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.errors import BackendError, CommandError, CrazyarenaError, InputError
from crazyarena.levels.schema import Level
from crazyarena.mocap.estimator import BodyEstimate, FrameResult, Freshness
from crazyarena.mocap.survey import SurveyConfig, SurveyReport, survey
from crazyarena.runner.rig import Rig
from crazyarena.runner.tracked_world import TrackedWorld, heading_like, roll_pitch_yaw
from crazyarena.safety.estop import Hold
from crazyarena.safety.fence import Fence
from crazyarena.sim_backend.arena_world import track_truth
from crazyarena.sim_backend.firmware.supervisor import (
    INFO_ARMED,
    INFO_AUTO_ARM,
    INFO_CAN_ARM,
    INFO_CAN_FLY,
    INFO_CRASHED,
    INFO_FLYING,
    INFO_LOCKED,
    INFO_TUMBLED,
)
from crazyarena.types import Pose, PoseFrame, VehicleState

Array = NDArray[np.float64]

_TICK = 0.02  # s, between looks at a condition
_SETTLED = 0.5  # s for which the on-board estimate must agree with the cameras
_AGREEMENT = 0.05  # m
_PEAK_SPEED = 1.0  # m/s on the way home
_PEAK_OVER_MEAN = 35.0 / 16.0  # of the firmware's rest-to-rest polynomial
_DESCENT = 0.3  # m/s
_BRAKING = 3.0  # m/s2, after the run
_STILL = 0.1  # m/s
_ASIDE = 0.25  # m from the fence, from where it flies home
_DRAW_BACK = 0.4  # m/s on the way there
_ABOVE_TRACK = 0.35  # m above the highest gate, on the way home
_GRIP_TIME = 1.0  # s of holding the dead-man's key until it is believed
_DOWN = 0.08  # m: what is lower stands on the ground
# The controller that full-state setpoints were made for.
MELLINGER = 2
_KALMAN = 2


class Phase(StrEnum):
    """Phases of a trial, in order; COMPLETE or FAIL end the run."""

    CONNECT = "connect"
    PREFLIGHT = "pre-flight"
    SURVEY = "survey"
    ARM = "arm"
    COUNTDOWN = "countdown"
    RUN = "run"
    COMPLETE = "complete"
    FAIL = "fail"
    RETURN = "return-and-land"
    DISARM = "disarm"
    REPORT = "report"


class Aborted(CrazyarenaError):
    """A phase failed; ``phase`` says which. The vehicle is down, or was told to go down."""

    def __init__(self, phase: Phase, reason: str) -> None:
        super().__init__(f"{phase.value}: {reason}")
        self.phase = phase


@dataclass(frozen=True, slots=True)
class Timeouts:
    """Longest duration of each phase, s on the trial's clock."""

    connect: float = 20.0
    preflight: float = 30.0
    survey: float = 15.0
    grip: float = 30.0
    arm: float = 5.0
    countdown: float = 3.0
    land: float = 30.0
    disarm: float = 5.0


@dataclass(frozen=True, slots=True)
class MeasuredTrack:
    """gates (n, 7) and obstacles (m, 6) as the referee takes them, and where that is from."""

    gates: Array
    obstacles: Array
    source: str


@dataclass(frozen=True, slots=True)
class Grip:
    """What the operator has to hold from arming until the vehicle is down.

    ``what`` in words; ``limit`` s: the longest silence that still counts as holding.
    """

    hold: Hold
    what: str
    limit: float

    @property
    def held(self) -> bool:
        return self.hold.age() <= self.limit


Confirm = Callable[[str], bool]
OnPhase = Callable[[Phase, str], None]


class Crew:
    """Brings one vehicle from its start place into the air and home again.

    Parameters
    ----------
    confirm: asks the operator a yes/no question before the motors are armed.
    on_phase: told of every phase and of what it found, in plain words.
    surveyed: poses of the track by body name, from an earlier survey; None measures them.
    checks: further pre-flight checks; each returns what is wrong, in plain words.
    anywhere: the vehicle need not stand at the level's start.

    ``grip`` is what the operator must hold, if anything; it is looked at from arming on.

    ``interrupted()`` is asked in every phase before the run; True aborts it.
    """

    def __init__(
        self,
        rig: Rig,
        world: TrackedWorld,
        level: Level,
        *,
        confirm: Confirm = lambda question: True,
        on_phase: OnPhase = lambda phase, text: None,
        timeouts: Timeouts | None = None,
        surveyed: dict[str, Pose] | None = None,
        checks: tuple[Callable[[], list[str]], ...] = (),
        anywhere: bool = False,
    ) -> None:
        self._rig = rig
        self._world = world
        self._level = level
        self._confirm = confirm
        self._on_phase = on_phase
        self._timeouts = timeouts or Timeouts()
        self._surveyed = surveyed
        self._checks = checks
        self._anywhere = anywhere
        self.grip: Grip | None = None
        self._home: Array | None = None
        self._may_stop = False
        self.interrupted: Callable[[], bool] = lambda: False
        self.durations: dict[str, float] = {}
        self.survey_report: SurveyReport | None = None

    # Before the run

    def prepare(self) -> MeasuredTrack:
        """Connect, check, survey; raises :class:`Aborted`."""
        self.durations = {}
        with self._phase(Phase.CONNECT):
            self._connect()
        with self._phase(Phase.PREFLIGHT):
            self._preflight()
        with self._phase(Phase.SURVEY):
            return self._survey()

    def launch(self) -> None:
        """Ask the operator, arm, count down; raises :class:`Aborted`."""
        with self._phase(Phase.ARM):
            name = f"vehicle {self._rig.vehicle}"
            if not self._confirm(f"Arm {name} and start the run on {self._level.name}?"):
                raise Aborted(Phase.ARM, "the operator said no")
            self._await_grip()
            self._arm()
        with self._phase(Phase.COUNTDOWN):
            clock = self._rig.clock
            begin = clock.now()
            left = math.ceil(self._timeouts.countdown)
            while left > 0:
                self._on_phase(Phase.COUNTDOWN, f"{left}")
                self._wait_quietly(begin + self._timeouts.countdown - left + 1)
                self._keep_quiet()
                left -= 1

    def _wait_quietly(self, deadline: float) -> None:
        """Sleep, in short naps if the operator may let go meanwhile."""
        clock = self._rig.clock
        while self.grip is not None and clock.now() < deadline - _TICK:
            clock.sleep_until(clock.now() + _TICK)
            if not self.grip.held:
                raise Aborted(Phase.COUNTDOWN, f"the operator let go of {self.grip.what}")
        clock.sleep_until(deadline)
        self._look_for_interrupt(Phase.COUNTDOWN)

    def _await_grip(self) -> None:
        """Until the operator has held on for a while: a key that repeats begins with a pause."""
        grip, clock = self.grip, self._rig.clock
        if grip is None:
            return
        self._on_phase(
            Phase.ARM,
            f"hold {grip.what} now, and until the vehicle is down and disarmed: it lands "
            f"{grip.limit:g} s after you let go",
        )
        since = math.nan

        def steady() -> bool:
            nonlocal since
            if not grip.held:
                since = math.nan
            elif math.isnan(since):
                since = clock.now()
            return clock.now() - since >= _GRIP_TIME

        self._until(steady, self._timeouts.grip, Phase.ARM, lambda: f"nobody holds {grip.what}")

    def _connect(self) -> None:
        rig = self._rig
        self._until(
            lambda: rig.backend.telemetry(rig.vehicle).supervisor is not None,
            self._timeouts.connect,
            Phase.CONNECT,
            lambda: f"vehicle {rig.vehicle} does not answer; is it switched on, is its URI right?",
        )
        self._until(
            lambda: self._estimate().freshness is Freshness.FRESH,
            self._timeouts.connect,
            Phase.CONNECT,
            lambda: (
                f"the cameras do not see {rig.body!r}"
                if rig.pipeline.live
                else f"no frames from the cameras ({rig.pipeline.source.status.error or 'silent'})"
            ),
        )

    def _preflight(self) -> None:
        rig = self._rig
        place = self._estimate().state
        for command in preparations(place):
            self._send(command)
            rig.clock.sleep_until(rig.clock.now() + _TICK)
        self._check_place(place.position)
        agreed_since = [math.nan]

        def settled() -> bool:
            now = rig.clock.now()
            if self._disagreement() > _AGREEMENT:
                agreed_since[0] = math.nan
            elif math.isnan(agreed_since[0]):
                agreed_since[0] = now
            return now - agreed_since[0] >= _SETTLED

        self._until(
            settled,
            self._timeouts.preflight,
            Phase.PREFLIGHT,
            lambda: (
                f"the on-board estimate is {self._disagreement():.2f} m from what the cameras "
                "see; do external poses reach the vehicle?"
            ),
        )
        problems = [problem for check in self._checks for problem in check()]
        if problems:
            raise Aborted(Phase.PREFLIGHT, "; ".join(problems))
        self._home = self._estimate().state.position.copy()

    def _disagreement(self) -> float:
        told = self._rig.backend.telemetry(self._rig.vehicle).state
        if told is None:
            return math.inf
        return float(np.linalg.norm(told.position - self._estimate().state.position))

    def _check_place(self, position: Array) -> None:
        start = self._level.start
        wanted = np.array(start.position[:2])
        away = float(np.linalg.norm(position[:2] - wanted))
        allowed = math.inf if self._anywhere else start.tolerance
        if away > allowed:
            raise Aborted(
                Phase.PREFLIGHT,
                f"vehicle {self._rig.vehicle} stands {away:.2f} m from the start "
                f"({wanted[0]:g}, {wanted[1]:g}); at most {allowed:g} m are allowed. Move it",
            )

    def _survey(self) -> MeasuredTrack:
        level = self._level
        nominal_gates = np.array([[*gate.row] for gate in level.track.gates]).reshape(-1, 7)
        nominal_obstacles = np.array([o.row for o in level.track.obstacles]).reshape(-1, 6)
        nominal = track_truth(nominal_gates, nominal_obstacles)
        poses = self._surveyed
        source = "earlier survey"
        if poses is None and nominal:
            poses, source = self._measure(nominal), "measured"
        missing = [name for name in nominal if name not in (poses or {})]
        if missing:
            raise Aborted(Phase.SURVEY, f"no pose of {', '.join(missing)}")
        gates, obstacles = nominal_gates.copy(), nominal_obstacles.copy()
        for i, row in enumerate(gates):
            _put(row, poses[f"gate{i + 1}"])  # type: ignore[index]
            # Bodies are at the foot; posts have one length, so the kind tells the height.
            row[2] = level.track.gates[i].centre[2]
        for i, row in enumerate(obstacles):
            _put(row, poses[f"obstacle{i + 1}"])  # type: ignore[index]
            row[2] = nominal_obstacles[i, 2]
        return MeasuredTrack(gates, obstacles, source)

    def _measure(self, nominal: dict[str, Pose]) -> dict[str, Pose]:
        rig = self._rig
        config = SurveyConfig(
            position_tolerance=_track_tolerance(self._level)[0],
            yaw_tolerance=_track_tolerance(self._level)[1],
            full_turn=False,
        )
        frames: list[PoseFrame] = []

        def listen(frame: PoseFrame, result: FrameResult) -> None:
            frames.append(frame)

        rig.listeners.frames.append(listen)
        try:
            self._until(
                lambda: len(frames) >= config.frames,
                self._timeouts.survey,
                Phase.SURVEY,
                lambda: f"{len(frames)} of {config.frames} frames came",
            )
        finally:
            rig.listeners.frames.remove(listen)
        moving = [f"gate{i + 1}" for i in self._level.track.tracked]
        report = self.survey_report = survey(frames, nominal, config, moving)
        try:
            return report.track()
        except InputError as error:
            raise Aborted(Phase.SURVEY, str(error)) from None

    def _arm(self) -> None:
        rig = self._rig
        self._send(cs.Arm(True))

        def ready() -> bool:
            info = self._supervisor()
            return bool(info & INFO_ARMED and info & INFO_CAN_FLY)

        self._until(ready, self._timeouts.arm, Phase.ARM, lambda: self._why_not_armed())
        self._on_phase(Phase.ARM, f"vehicle {rig.vehicle} is armed")

    def _why_not_armed(self) -> str:
        info = self._supervisor()
        for bit, text in (
            (INFO_TUMBLED, "it lies on its side"),
            (INFO_CRASHED, "it has crashed; recover it"),
            (INFO_LOCKED, "its supervisor is locked; restart it"),
        ):
            if info & bit:
                return f"vehicle {self._rig.vehicle} does not arm: {text}"
        can = "it could" if info & INFO_CAN_ARM else "its own checks fail"
        return f"vehicle {self._rig.vehicle} does not arm ({can}; supervisor.info {info:#x})"

    def _keep_quiet(self) -> None:
        """Between arming and start nothing moves; what does is an abort."""
        if self._home is not None and self._height() > _DOWN:
            raise Aborted(Phase.COUNTDOWN, "the vehicle left the ground before the start")

    # After the run

    def announce(self, phase: Phase, text: str) -> None:
        """Tell of a phase that is not the crew's own work."""
        self._on_phase(phase, text)

    def bring_home(self) -> None:
        """Fly back above the track and land at the start, as long as the vehicle can; then disarm.

        Raises :class:`Aborted` if it cannot be brought down, or not there.
        """
        problem: Aborted | None = None
        try:
            with self._phase(Phase.RETURN, land_on_failure=False):
                self._return()
        except Aborted as error:
            problem = error
            self._come_down()
        if self._taken():
            self.stand_down()
        else:
            with self._phase(Phase.DISARM, land_on_failure=False):
                self._disarm()
        if problem is not None:
            raise problem

    def stand_down(self) -> None:
        """For a vehicle that the watchdog has taken and brought down: only make sure of it."""
        with self._phase(Phase.DISARM, land_on_failure=False):
            self._send_quietly(cs.CutMotors())
            self._until(
                lambda: self._height() <= _DOWN or not self._flyable(),
                self._timeouts.disarm,
                Phase.DISARM,
                lambda: f"the vehicle is still {self._height():.2f} m high",
            )
        self._may_let_go()

    def abort(self) -> None:
        """Down, by the shortest way: land where it is; cut the motors if that does not work."""
        self._may_stop = False
        self._come_down()
        self._send_quietly(cs.Arm(False))

    def _come_down(self) -> None:
        """By the watchdog if it has the vehicle, else where it is; motors off if that fails."""
        guard = self._rig.safeguard
        if guard is not None and self._taken():
            guard.end()
            return
        try:
            self._land_here()
        except CrazyarenaError:
            self._send_quietly(cs.Emergency())

    def _taken(self) -> bool:
        """The watchdog has the vehicle."""
        guard = self._rig.safeguard
        return guard is not None and guard.verdict() is not None

    def _flyable(self) -> bool:
        info = self._supervisor()
        return info & (INFO_TUMBLED | INFO_CRASHED | INFO_LOCKED) == 0

    def _return(self) -> None:
        if not self._flyable():
            self._on_phase(Phase.RETURN, "the vehicle cannot fly any more; motors off")
            self._send_quietly(cs.CutMotors())
            return
        if self._height() <= _DOWN:
            self._send(cs.NotifySetpointsStop())
            self._send(cs.Stop())
            return
        assert self._home is not None
        place, yaw = self._stop_moving()
        above = self._safe_height()
        self._send(cs.NotifySetpointsStop())
        self._go(np.array([place[0], place[1], max(above, place[2])]), yaw)
        self._go(np.array([self._home[0], self._home[1], max(above, place[2])]), yaw)
        self._land_here()

    def _stop_moving(self) -> tuple[Array, float]:
        """Brake, and draw back from the fence; the place (3,) m and heading where it then stays.

        A plan that begins on the move swings out by a fifth of its duration times the speed: too
        much for a run that ended close to the fence.
        """
        state = self._estimate().state
        begin, velocity = state.position.copy(), state.velocity.copy()
        yaw = roll_pitch_yaw(state.quaternion)[2]
        speed = float(np.linalg.norm(velocity))
        braking = speed / _BRAKING
        rest = begin + 0.5 * braking * velocity
        rest[2] = max(rest[2], begin[2], _DOWN + 0.1)
        x, y, z = rest.tolist()
        try:
            inside = np.array(Fence.from_level(self._level).nearest((x, y, z), _ASIDE))
        except InputError:
            inside = rest
        away = inside - rest
        if speed < _STILL:
            return begin, yaw
        drawing = float(np.linalg.norm(away)) / _DRAW_BACK
        clock = self._rig.clock
        start, zero = clock.now(), np.zeros(3)
        while (now := clock.now() - start) < braking + drawing + _SETTLED:
            self._must_fly(Phase.RETURN)
            if now < braking:
                left = 1.0 - now / braking
                place = begin + velocity * now * (0.5 + 0.5 * left)
                setpoint = cs.FullState(place, velocity * left, -velocity / braking, yaw, zero)
            else:
                share = min(1.0, (now - braking) / drawing) if drawing > 0.0 else 1.0
                pace = away / drawing if share < 1.0 else zero
                setpoint = cs.FullState(rest + share * away, pace, zero, yaw, zero)
            self._send(setpoint)
            clock.sleep_until(clock.now() + _TICK)
        return inside, yaw

    def _safe_height(self) -> float:
        tops = [gate.centre[2] + 0.25 for gate in self._level.track.gates]
        tops += [obstacle.z + 0.95 for obstacle in self._level.track.obstacles]
        ceiling = self._level.arena.high[2] - self._level.arena.soft_margin - 0.1
        return min(max([*tops, 0.5]) + _ABOVE_TRACK, ceiling)

    def _go(self, place: Array, yaw: float) -> None:
        here = self._estimate().state.position
        away = float(np.linalg.norm(place - here))
        duration = max(1.0, away * _PEAK_OVER_MEAN / _PEAK_SPEED)
        self._send(cs.GoTo(place, yaw, duration))
        end = self._rig.clock.now() + duration
        while self._rig.clock.now() < end:
            self._must_fly(Phase.RETURN)
            self._rig.clock.sleep_until(min(end, self._rig.clock.now() + _TICK))
        self._until(
            lambda: float(np.linalg.norm(self._estimate().state.position - place)) < 0.25,
            3.0,
            Phase.RETURN,
            lambda: "the vehicle does not get where it is sent",
        )

    def _must_fly(self, phase: Phase) -> None:
        if not self._flyable():
            raise Aborted(phase, "the vehicle tumbled, crashed or was locked")
        if self._estimate().freshness is Freshness.STALE:
            self._send_quietly(cs.Land(0.0, 2.0))
            raise Aborted(phase, f"the cameras lost {self._rig.body!r}")

    def _land_here(self) -> None:
        height = self._height()
        if height > _DOWN:
            self._send(cs.NotifySetpointsStop())
            duration = max(1.5, height / _DESCENT)
            self._send(cs.Land(0.0, duration))
            self._until(
                lambda: self._height() <= _DOWN and self._still(),
                duration + 5.0,
                Phase.RETURN,
                lambda: f"the vehicle is still {self._height():.2f} m high",
            )
        self._send(cs.Stop())

    def _disarm(self) -> None:
        self._send_quietly(cs.CutMotors())
        self._send_quietly(cs.Arm(False))
        self._until(
            lambda: self._at_rest() or not self._flyable(),
            self._timeouts.disarm,
            Phase.DISARM,
            lambda: f"vehicle {self._rig.vehicle} does not disarm; switch it off by hand",
        )
        self._may_let_go()

    def _may_let_go(self) -> None:
        if self.grip is not None:
            self._on_phase(Phase.DISARM, f"you may let go of {self.grip.what}")

    def _at_rest(self) -> bool:
        """Disarmed; or, for firmware that arms by itself again at once, no longer flying."""
        info = self._supervisor()
        return not info & INFO_ARMED or (info & INFO_AUTO_ARM != 0 and not info & INFO_FLYING)

    # What phases are made of

    @contextmanager
    def _phase(self, phase: Phase, land_on_failure: bool = True) -> Iterator[None]:
        begin = self._rig.clock.now()
        self._on_phase(phase, "")
        # Nobody wants to interrupt a landing.
        self._may_stop = land_on_failure
        try:
            yield
        except (BackendError, CommandError) as error:
            if land_on_failure:
                self.abort()
            raise Aborted(phase, str(error)) from error
        except BaseException:
            if land_on_failure:
                self.abort()
            raise
        finally:
            self.durations[phase.value] = self._rig.clock.now() - begin

    def _until(
        self,
        condition: Callable[[], bool],
        timeout: float,
        phase: Phase,
        complaint: Callable[[], str],
    ) -> None:
        clock = self._rig.clock
        end = clock.now() + timeout
        while not condition():
            self._look_for_interrupt(phase)
            if clock.now() >= end:
                raise Aborted(phase, f"{complaint()} (waited {timeout:g} s)")
            clock.sleep_until(clock.now() + _TICK)

    def _look_for_interrupt(self, phase: Phase) -> None:
        lost = self._rig.lost()
        if lost is not None:
            raise BackendError(lost)
        if self._may_stop and self.interrupted():
            raise Aborted(phase, "interrupted by the operator")

    def _estimate(self) -> BodyEstimate:
        return self._rig.pipeline.estimate(self._rig.body)

    def _height(self) -> float:
        return float(self._estimate().state.position[2])

    def _still(self) -> bool:
        return float(np.linalg.norm(self._estimate().state.velocity)) < _STILL

    def _supervisor(self) -> int:
        return self._rig.backend.telemetry(self._rig.vehicle).supervisor or 0

    def _send(self, command: cs.Command) -> None:
        self._rig.backend.send(command, self._rig.vehicle)

    def _send_quietly(self, command: cs.Command) -> None:
        """For the way down, on which a refused command must not stop the next."""
        try:
            self._send(command)
        except (BackendError, CommandError) as error:
            self._on_phase(Phase.RETURN, f"{type(command).__name__} refused: {error}")


def preparations(place: VehicleState, controller: int = MELLINGER) -> list[cs.SetParam]:
    """What a vehicle that stands at ``place`` is told before it is armed.

    It is to fly by external poses, with this controller, and to estimate itself anew.
    """
    x, y, z = place.position.tolist()
    wanted: tuple[tuple[str, float], ...] = (
        ("stabilizer.estimator", _KALMAN),
        ("stabilizer.controller", controller),
        ("commander.enHighLevel", 1),
        ("kalman.initialX", x),
        ("kalman.initialY", y),
        ("kalman.initialZ", z),
        ("kalman.initialYaw", roll_pitch_yaw(place.quaternion)[2]),
        ("kalman.resetEstimation", 1),
        ("kalman.resetEstimation", 0),
    )
    return [cs.SetParam(name, value) for name, value in wanted]


def _put(row: Array, pose: Pose) -> None:
    """Overwrite a nominal row with a measured pose; what has no front keeps its heading."""
    row[:3] = pose.position
    row[3:6] = (0.0, 0.0, heading_like(row[5], pose.quaternion))


def _track_tolerance(level: Level) -> tuple[float, float]:
    """How far bodies of the track may be from nominal: m, rad.

    As far as the level says that they move, and the width of a measuring tape on top.
    """
    spread = level.randomization.gates_and_obstacles
    reach = 0.0
    if spread is not None:
        reach = max(abs(bound) for bound in (*spread.gates, *spread.obstacles))
    return math.hypot(reach, reach) + 0.05, reach + 0.1
