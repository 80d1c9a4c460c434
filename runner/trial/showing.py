"""A trial as viewers see it: what it publishes of itself while it flies.

Everything here runs in the trial's own thread and must be worth less than it costs: some ten
microseconds a control step, and a tenth of a millisecond thirty times a second, in time that the
flight waits anyway. Nobody waits for a viewer.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.clock import Clock, WallClock
from crazyarena.levels.schema import Level
from crazyarena.live import POSITION, QUATERNION, SETPOINT, STOP, VELOCITY, Live
from crazyarena.mocap.estimator import FrameResult
from crazyarena.plain_text import shown, shown_line
from crazyarena.runner.judging.referee import Event, Verdict
from crazyarena.runner.judging.result import EpisodeResult
from crazyarena.runner.records.shown_scene import level_scene
from crazyarena.runner.rig.rig import Rig
from crazyarena.runner.trial.pace import Pace
from crazyarena.runner.trial.phase import Phase
from crazyarena.safety.fence import Fence
from crazyarena.safety.frame_rate import FrameRate
from crazyarena.safety.limits import Limits
from crazyarena.safety.observation import Observation
from crazyarena.safety.stopping import stopping_path
from crazyarena.sim_backend.firmware import supervisor as sv
from crazyarena.sim_backend.trace import TR_POS, TR_QUAT, TR_SETPOINT, TR_VEL
from crazyarena.types import PoseFrame

Array = NDArray[np.float64]

PERIOD = 1.0 / 30.0  # s, between pictures
_MOST_EVENTS = 12
_WORDS = (
    (sv.INFO_LOCKED, "locked"),
    (sv.INFO_CRASHED, "crashed"),
    (sv.INFO_TUMBLED, "tumbled"),
    (sv.INFO_FLYING, "flying"),
    (sv.INFO_ARMED, "armed"),
    (sv.INFO_CAN_FLY, "can fly"),
    (sv.INFO_CAN_ARM, "can arm"),
)


def supervisor_words(info: int | None) -> list[str]:
    """What a vehicle's ``supervisor.info`` says, in words."""
    if info is None:
        return []
    return [word for bit, word in _WORDS if info & bit] or ["disarmed"]


class Showing:
    """Publishes one trial.

    Parameters
    ----------
    live: where to.
    episodes: how many there will be.
    limits: of the watchdog; they say where a vehicle would come to rest.
    pace: times real time that simulated time may pass with; 0 for as fast as it goes.
    control: a viewer may stop and land what flies.
    """

    def __init__(
        self,
        live: Live,
        level: Level,
        episodes: int,
        *,
        limits: Limits | None = None,
        pace: float = 0.0,
        control: bool = False,
        wall: Clock | None = None,
    ) -> None:
        self.live = live
        self._level = level
        self._fence = Fence.from_arena(level.arena)
        self._limits = limits or Limits()
        self._wall = wall if wall is not None else WallClock()
        self._pace = Pace(pace, self._wall)
        self._rig: Rig | None = None
        self._rate = FrameRate()
        self._bodies = 0
        self._captured = -math.inf
        self._published = -math.inf
        self._events: deque[list[Any]] = deque(maxlen=_MOST_EVENTS)
        self._facts: dict[str, Any] = {
            "level": level.name,
            "episode": 0,
            "episodes": episodes,
            "gates": len(level.track.gates),
            "phase": "",
            "control": control,
            "checklist": [],
            "question": None,
        }
        self._scene = level_scene(level, *_nominal(level))
        live.scene(self._scene)

    def attach(self, rig: Rig) -> None:
        """Show the vehicle of a rig from now on, in every phase."""
        self._rig = rig
        self.live.scene(level_scene(self._level, *_nominal(self._level), vehicles=[rig.body]))
        rig.listeners.frames.append(self._see)

    def phase(self, phase: Phase, text: str) -> None:
        """A phase has begun, or has found something."""
        self._facts["phase"] = phase.value
        if text:
            self.note(phase.value, text)
        self._publish()

    def note(self, name: str, detail: str, time: float | None = None) -> None:
        """Something happened, at ``time`` s of the run, if there is one."""
        self._events.append([time, shown_line(name), shown(detail)[:200]])

    def checklist(self, lines: Iterable[Sequence[Any]]) -> None:
        """Lines of the pre-flight check: name, ok, found, remedy, waived."""
        self._facts["checklist"] = [list(line) for line in lines]
        self._publish()

    def ask(self, question: dict[str, str] | None) -> None:
        """What the operator is asked now: ``id`` and ``text``."""
        self._facts["question"] = question
        self._publish()

    def begin(self, index: int, gates: Array, obstacles: Array) -> None:
        """An episode begins on this track."""
        names = [] if self._rig is None else [self._rig.body]
        self._scene = level_scene(self._level, gates, obstacles, names)
        self.live.scene(self._scene)
        self.live.begin()
        self._pace.begin()
        self._facts |= {"episode": index, "gate": 0, "time": 0.0, "missed": 0, "why": ""}
        if self._rig is None:
            self._facts["phase"] = Phase.RUN.value

    def drawn(self, entities: list[dict[str, Any]]) -> None:
        """All that the contestant has drawn now, as entities of a ``foxglove.SceneUpdate``."""
        self._scene["drawn"] = entities
        self.live.scene(self._scene)

    def running(self) -> None:
        """The run itself begins now."""
        self._facts["phase"] = Phase.RUN.value
        self._publish()

    def step(self, verdict: Verdict, time: float, row: Array | None, missed: int) -> None:
        """A control step was judged: ``row`` is the last of the trace, if there was any."""
        facts = self._facts
        facts["time"], facts["gate"], facts["missed"] = time, int(verdict.gate), missed
        facts["exact"] = bool(verdict.info.get("current_target_gate_in_range", False))
        self._take(verdict.events)
        if row is not None:
            self._place(
                row[TR_POS : TR_POS + 3],
                row[TR_QUAT : TR_QUAT + 4],
                row[TR_VEL : TR_VEL + 3],
                row[TR_SETPOINT : TR_SETPOINT + 3],
            )
            self.live.extend()
        if self._rig is None:
            self._pace.keep(time)
            self._publish_now_and_then()

    def end(self, result: EpisodeResult) -> None:
        """The episode is over."""
        self._facts["why"] = shown(result.why or result.termination)
        self.note(result.termination, self._facts["why"], result.flight_time)
        if self._rig is None:
            ended = Phase.COMPLETE if result.completed else Phase.FAIL
            self._facts["phase"] = ended.value
        self._publish()

    def close(self, why: str = "") -> None:
        """Nothing more will be shown of this trial."""
        self._rig = None  # what it was asked of is closed
        self._facts |= {"phase": "over", "control": False, "question": None, "taken": None}
        if why:
            self._facts["why"] = shown(why)
        self._publish()

    # What flies

    def _take(self, events: Iterable[Event]) -> None:
        for event in events:
            self.note(event.name, event.detail, event.time)

    def _place(self, position: Array, turn: Array, velocity: Array, setpoint: Array) -> None:
        row = self.live.rows[0]
        row[POSITION : POSITION + 3] = position
        row[QUATERNION : QUATERNION + 4] = turn
        row[VELOCITY : VELOCITY + 3] = velocity
        row[SETPOINT : SETPOINT + 3] = setpoint

    def _see(self, frame: PoseFrame, result: FrameResult) -> None:
        """A frame of the cameras: the moment at which the flight waits for the next tick."""
        rig = self._rig
        assert rig is not None
        self._rate.note(frame.timestamp)
        self._bodies = len(frame.bodies)
        self._captured = frame.timestamp
        self._pace.keep(rig.clock.now())
        self._publish_now_and_then()

    def _publish_now_and_then(self) -> None:
        if self._wall.now() - self._published >= PERIOD:
            self._publish()

    def _publish(self) -> None:
        self._published = self._wall.now()
        if self._rig is not None:
            self._look(self._rig)
        row = self.live.rows[0]
        x, y, z = row[POSITION : POSITION + 3].tolist()
        rest = (math.nan,) * 3
        if math.isfinite(x + y + z):
            speed = tuple(np.nan_to_num(row[VELOCITY : VELOCITY + 3]).tolist())
            turn = tuple(row[QUATERNION : QUATERNION + 4].tolist())
            if self._facts["phase"] in _MOVING:
                seen = Observation(0.0, position=(x, y, z), velocity=speed, quaternion=turn)
                _, rest = stopping_path(seen, self._limits)
                self._facts["room_at_rest"] = round(self._fence.room(*rest), 3)
            else:
                self._facts["room_at_rest"] = None
            self._facts["room"] = round(self._fence.room(x, y, z), 3)
            self._facts["speed"] = round(math.hypot(*speed), 3)
        row[STOP : STOP + 3] = rest
        self._facts["events"] = list(self._events)
        self.live.publish(self._facts)

    def _look(self, rig: Rig) -> None:
        """At what the vehicle, its link and the cameras tell."""
        facts, now = self._facts, rig.clock.now()
        told = rig.backend.telemetry(rig.vehicle)
        facts["battery"] = told.battery
        facts["link"] = told.link_quality
        facts["rssi"] = told.rssi
        heard = now - told.timestamp
        facts["heard"] = round(heard, 3) if math.isfinite(heard) else None
        facts["supervisor"] = supervisor_words(told.supervisor)
        facts["motors"] = None if told.motors is None else [round(float(m), 3) for m in told.motors]
        age = now - self._captured
        facts["cameras"] = {
            "rate": self._rate.rate,
            "age": round(age, 3) if math.isfinite(age) else None,
            "bodies": self._bodies,
        }
        if rig.safeguard is not None:
            facts["ladder"] = rig.safeguard.ladder
            facts["taken"] = rig.safeguard.verdict()
        if facts["phase"] != Phase.RUN.value:
            # Estimates come with frames, which is when this is called.
            state = rig.pipeline.estimate(rig.body).state
            self._place(state.position, state.quaternion, state.velocity, np.full(3, np.nan))
            if self._facts["phase"] in _MOVING:
                self.live.extend()


_MOVING = (Phase.RUN.value, Phase.COMPLETE.value, Phase.FAIL.value, Phase.RETURN.value)


def _nominal(level: Level) -> tuple[Array, Array]:
    """Gates (n, 7) and obstacles (m, 6) as the level file has them, z of gates that of openings."""
    gates = np.array([[*g.row[:2], g.centre[2], *g.row[3:]] for g in level.track.gates])
    obstacles = np.array([o.row for o in level.track.obstacles])
    return gates.reshape(-1, 7), obstacles.reshape(-1, 6)
