"""What happens around a run: from connecting to a vehicle that is down and disarmed again.

The same phases whether vehicle and cameras are simulated or real. Each has a time limit, and
whatever goes wrong in one of them ends on the abort path, which ends with the vehicle down.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.errors import InputError
from crazyarena.levels.schema import Level
from crazyarena.mocap.estimator import FrameResult, Freshness
from crazyarena.mocap.survey import SurveyConfig, SurveyReport, survey
from crazyarena.runner.rig.rig import Rig
from crazyarena.runner.trial.hands import DOWN, TICK
from crazyarena.runner.trial.homecoming import Homecoming
from crazyarena.runner.trial.phase import (
    Aborted,
    Array,
    Confirm,
    MeasuredTrack,
    OnPhase,
    Phase,
    Timeouts,
)
from crazyarena.runner.trial.site import LevelSite, Site
from crazyarena.runner.trial.tracked_world import TrackedWorld, roll_pitch_yaw
from crazyarena.sim_backend.firmware.supervisor import (
    INFO_ARMED,
    INFO_CAN_ARM,
    INFO_CAN_FLY,
    INFO_CRASHED,
    INFO_LOCKED,
    INFO_TUMBLED,
)
from crazyarena.types import Pose, PoseFrame, VehicleState

_SETTLED = 0.5  # s for which the on-board estimate must agree with the cameras
_AGREEMENT = 0.05  # m
_GRIP_TIME = 1.0  # s of holding the dead-man's key until it is believed
# The controller that full-state setpoints were made for.
MELLINGER = 2
_KALMAN = 2


class Crew(Homecoming):
    """Brings one vehicle from its start place into the air and home again.

    Parameters
    ----------
    confirm: asks the operator a yes/no question before the motors are armed.
    on_phase: told of every phase and of what it found, in plain words.
    surveyed: poses of the track by body name, from an earlier survey; None measures them.
    checks: further pre-flight checks; each returns what is wrong, in plain words.
    anywhere: the vehicle need not stand at the level's start.
    site: where the track's bodies are to stand; as the level says by default.

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
        site: Site | None = None,
    ) -> None:
        super().__init__(rig, level, on_phase, timeouts or Timeouts())
        self._world = world
        self._confirm = confirm
        self._surveyed = surveyed
        self._checks = checks
        self._anywhere = anywhere
        self._site: Site = site or LevelSite(level)
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
            alone = ""
            if self._rig.onboard is not None:
                alone = f"Nothing but {name} itself sees where it is. "
            if not self._confirm(f"{alone}Arm {name} and start the run on {self._level.name}?"):
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
        while self.grip is not None and clock.now() < deadline - TICK:
            clock.sleep_until(clock.now() + TICK)
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
                f"{self._doubt()}; check its decks, base stations, floor"
                if rig.onboard is not None
                else f"the cameras do not see {rig.body!r}"
                if rig.pipeline.live
                else f"no frames from the cameras ({rig.pipeline.source.status.error or 'silent'})"
            ),
        )

    def _preflight(self) -> None:
        rig = self._rig
        place = self._estimate().state
        if rig.onboard is not None and rig.onboard.decks.relative:
            place = standing_at(self._level, place)
            self._on_phase(
                Phase.PREFLIGHT,
                f"nothing on board knows its place: it is counted from the level's start "
                f"({place.position[0]:g}, {place.position[1]:g}), nose at "
                f"{math.degrees(self._level.start.attitude[2]):g} deg; it must stand there",
            )
        for command in preparations(place):
            self._send(command)
            rig.clock.sleep_until(rig.clock.now() + TICK)
        self._check_place(place.position)
        agreed_since = [math.nan]

        def settled() -> bool:
            now = rig.clock.now()
            seen = rig.onboard is None or self._estimate().freshness is not Freshness.STALE
            if not seen or self._disagreement() > _AGREEMENT:
                agreed_since[0] = math.nan
            elif math.isnan(agreed_since[0]):
                agreed_since[0] = now
            return now - agreed_since[0] >= _SETTLED

        self._until(
            settled,
            self._timeouts.preflight,
            Phase.PREFLIGHT,
            lambda: (
                f"its estimate does not settle: {self._doubt()}"
                if rig.onboard is not None
                else f"the on-board estimate is {self._disagreement():.2f} m from what the cameras "
                "see; do external poses reach the vehicle?"
            ),
        )
        problems = [problem for check in self._checks for problem in check()]
        wrong = self._site.start_problem(place.position)
        if wrong is not None:
            problems.append(f"vehicle {rig.vehicle} {wrong}; move it")
        if problems:
            raise Aborted(Phase.PREFLIGHT, "; ".join(problems))
        self._home = self._estimate().state.position.copy()

    def _doubt(self) -> str:
        """Why the vehicle's own estimate is not believed."""
        onboard, told = self._rig.onboard, self._rig.backend.telemetry(self._rig.vehicle)
        if onboard is None or told.state is None:
            return "it tells no estimate of its place"
        return onboard.certainty.doubt(told) or "its estimates come late, or jump"

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
        site = self._site
        poses = self._surveyed
        source = "earlier survey"
        if poses is None and (taped := self._rig.taped()):
            poses, source = taped, "measured by hand"
        if poses is None and site.nominal and self._rig.onboard is not None:
            raise Aborted(Phase.SURVEY, "no cameras measure the track; --survey FILE")
        if poses is None and site.nominal:
            poses, source = self._measure(), "measured"
        missing = [name for name in site.nominal if name not in (poses or {})]
        if missing:
            raise Aborted(Phase.SURVEY, f"no pose of {', '.join(missing)}")
        return MeasuredTrack(*site.track(poses or {}), source)

    def _measure(self) -> dict[str, Pose]:
        rig, site = self._rig, self._site
        config = SurveyConfig(
            allowed=site.allowed,
            full_turn=site.full_turn,
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
        report = self.survey_report = survey(frames, site.nominal, config, site.moving)
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
        if self._home is not None and self._height() > DOWN:
            raise Aborted(Phase.COUNTDOWN, "the vehicle left the ground before the start")


def standing_at(level: Level, seen: VehicleState) -> VehicleState:
    """The state of a vehicle that stands at the level's start, nose as the level has it."""
    x, y, _ = level.start.position
    yaw = level.start.attitude[2]
    quaternion = np.array((0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)))
    return replace(seen, position=np.array((x, y, 0.0)), quaternion=quaternion)


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
