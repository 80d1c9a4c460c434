"""Does the safety leave good flights alone?

Three fifths of the episodes are the example racer's, through level 0 to 3 with new random draws
in every episode, in the competition's world, behind the command gate and under the watchdog: its
commands pass the gate, and simulated cameras (100 Hz, noise, dropouts, latency) show its flight
to the estimator and the watchdog, which watches without taking over so that every alarm of a
flight is counted.

The others are those of the Crazyswarm examples with ``--guard``, in the arenas of the same
levels: vehicles start somewhere else every time, a little inside what the example needs, and the
cameras' noise is another. Here the watchdog would take over.

    python benchmarks/false_alarms.py --episodes 200

An intervention is any wish of the watchdog to take over, and any command the gate changed or
refused. Warnings are counted apart, and so is what happened in episodes that the racer lost by
itself: there the alarm is no false one.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import importlib.util
import io
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from crazyarena.clock import VirtualClock
from crazyarena.crazyswarm_compat.crazyswarm1 import Crazyswarm
from crazyarena.crazyswarm_compat.options import CrazyswarmWarning
from crazyarena.errors import CrazyarenaError
from crazyarena.levels import load_level
from crazyarena.levels.schema import Level
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.mocap.estimator import PoseEstimator
from crazyarena.mocap.pipeline import PosePipeline
from crazyarena.mocap.sim_source import SimSource
from crazyarena.runner.contestant.in_process import InProcess
from crazyarena.runner.contestant.submission import Submission
from crazyarena.runner.dry_run import example_racer
from crazyarena.runner.rig.flight_model import flight_model
from crazyarena.runner.trial.trial import Trial
from crazyarena.safety.events import Action, SafetyEvent
from crazyarena.safety.fence import Fence
from crazyarena.safety.gate import CommandGate
from crazyarena.safety.limits import Limits
from crazyarena.safety.watchdog import Watchdog
from crazyarena.sim_backend.competition import CompetitionWorld
from crazyarena.sim_backend.trace import TR_POS, TR_QUAT, TR_TIME
from crazyarena.sim_backend.vehicles import load_vehicle
from crazyarena.types import Pose

_LEAD = 1.0  # s of frames before the take-off
_STEP = 0.005  # s, between looks of the watchdog
_LEVELS = ("level0", "level1", "level2", "level3")
_EXAMPLES = Path(__file__).resolve().parent.parent / "examples" / "crazyswarm"
_RUN_OFF = 0.6  # m, between what an example needs and the fence

Events = list[SafetyEvent]


class WatchedWorld:
    """A competition world whose flight is also seen by cameras, estimator and watchdog."""

    def __init__(self, level: Level, seed: int) -> None:
        self._world = CompetitionWorld(level.control_frequency)
        self.clock = self._world.clock
        self._fence = Fence.from_level(level)
        self._pipeline: PosePipeline
        self._watchdog: Watchdog
        self._seed = np.random.SeedSequence(seed)
        self._session = VirtualClock()
        self.episodes: list[list[SafetyEvent]] = []
        self.frames = 0

    def reset(self, draw: Any) -> None:
        self._world.reset(draw)
        self.episodes.append([])
        # A session of its own for every episode: the ladder is one-way.
        self._session = VirtualClock()
        self._rows = np.empty((0, 2))
        x, _, y, _, z, _, roll, pitch, yaw = draw.start[:9]
        self._pose = Pose(np.array([x, y, z]), _quaternion(roll, pitch, yaw))
        rng = np.random.default_rng(self._seed.spawn(1)[0])
        self._cameras = SimSource(self._session, None, CameraModel(rate=100.0), rng)
        self._gate = CommandGate(
            self._world,
            self._fence,
            self._session,
            Limits().for_vehicle(flight_model(load_vehicle("cf2022"))),
            state=lambda vehicle: self._pipeline.estimate("cf").state,
            on_event=self.episodes[-1].append,
        )
        self._pipeline = PosePipeline(
            self._cameras,
            PoseEstimator(["cf"]),
            self._session,
            on_frame=[lambda frame, result: self._watchdog.on_frame(frame, result)],
        )
        self._watchdog = Watchdog(
            self._gate,
            self._fence,
            self._session,
            {"cf": self._world.vehicles[0]},
            self._pipeline.estimate,
            grounds={self._world.vehicles[0]: float(z)},
            flies=False,
            on_event=self.episodes[-1].append,
        )
        for k in range(round(_LEAD / _STEP)):
            self._look((k + 1) * _STEP)

    def send(self, command: Any) -> None:
        vehicle = self._world.vehicles[0]
        self._gate.runner.send(command, vehicle)
        self._watchdog.controller_answered(vehicle)

    def poll(self) -> Any:
        rows = self._world.poll()
        for row in rows:
            self._pose = Pose(row[TR_POS : TR_POS + 3].copy(), row[TR_QUAT : TR_QUAT + 4].copy())
            self._look(_LEAD + float(row[TR_TIME]))
        return rows

    def _look(self, now: float) -> None:
        self._session.sleep_until(now)
        while self._cameras.next_exposure <= now:
            self._cameras.expose(self._cameras.next_exposure, {"cf": self._pose})
        if self._pipeline.poll():
            self.frames += 1
            self._watchdog.step()

    def motor_forces(self) -> Any:
        return self._world.motor_forces()

    def close(self) -> None:
        self._world.close()


def _quaternion(roll: float, pitch: float, yaw: float) -> np.ndarray:
    (cr, cp, cy), (sr, sp, sy) = (
        np.cos([roll / 2, pitch / 2, yaw / 2]),
        np.sin([roll / 2, pitch / 2, yaw / 2]),
    )
    return np.array(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ]
    )


def fly(level_name: str, episodes: int, seed: int) -> tuple[int, list[tuple[bool, Events]]]:
    """Frames looked at, and per episode whether it was completed and what happened."""
    level = load_level(level_name, ["reseed_on_reset=false"])
    world = WatchedWorld(level, seed)
    with (
        tempfile.TemporaryDirectory() as work,
        Submission(example_racer(), Path(work)) as submission,
    ):
        result = Trial(level, InProcess(submission), world, episodes=episodes, seed=seed).run()
    world.close()
    completed = [episode.completed for episode in result.episodes]
    return world.frames, list(zip(completed, world.episodes, strict=True))


@dataclass(frozen=True, slots=True)
class Example:
    """A script of examples/crazyswarm, and how far from its start each vehicle flies, m."""

    name: str
    low: tuple[float, float] = (0.0, 0.0)
    high: tuple[float, float] = (0.0, 0.0)


EXAMPLES = (
    Example("hover"),
    Example("circle", (-1.0, -0.5), (0.0, 0.5)),
    Example("figure8", (-1.0, -0.55), (1.0, 0.55)),
    Example("gates"),
    Example("swap", (-0.4, -0.4), (0.4, 0.4)),
)


def draw_starts(example: Example, level: Level, rng: np.random.Generator) -> np.ndarray:
    """(2, 2) m, x and y of two vehicles 1.5 to 2.5 m apart."""
    low = np.array(level.arena.low[:2]) + _RUN_OFF - example.low
    high = np.array(level.arena.high[:2]) - _RUN_OFF - example.high
    while True:
        first = rng.uniform(low, high)
        angle, distance = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(1.5, 2.5)
        second = first + distance * np.array([np.cos(angle), np.sin(angle)])
        if (low <= second).all() and (second <= high).all():
            return np.array([first, second])


def _load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"example_{name}", _EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def fly_example(example: Example, level_name: str, seed: int) -> tuple[bool, int, Events]:
    """Whether a flight of an example came to its own end, commands passed, what happened."""
    rng = np.random.default_rng(seed)
    starts = draw_starts(example, load_level(level_name), rng)
    fleet = "crazyflies:\n" + "".join(
        f"- {{id: {i + 1}, channel: 80, initialPosition: [{x:.4f}, {y:.4f}, 0.0]}}\n"
        for i, (x, y) in enumerate(starts)
    )
    made: list[Crazyswarm] = []

    def open_swarm(crazyflies_yaml: object) -> Crazyswarm:
        flags = f"--sim --vis null --guard {level_name},seed={rng.integers(2**31)}"
        made.append(Crazyswarm(crazyflies_yaml=fleet, args=flags))
        return made[0]

    module: Any = _load(example.name)
    module.Crazyswarm = open_swarm
    ended = True
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore", CrazyswarmWarning)
        try:
            module.main()
        except CrazyarenaError:
            ended = False
        made[0].allcfs.close()
    guard = made[0].allcfs.guard
    assert guard is not None
    return ended, guard.gate.passed, list(guard.events)


def is_intervention(event: SafetyEvent) -> bool:
    return event.severity >= Action.HOLD or event.rule.startswith("gate_")


def fly_racer(episodes: int, seed: int) -> tuple[int, int]:
    """Fly through all levels and print what was found; returns how many flights there were (one of
    each level at least), and interventions."""
    share = max(1, episodes // len(_LEVELS))
    interventions = 0
    for index, name in enumerate(_LEVELS):
        frames, flights = fly(name, share, seed + index)
        good = [event for completed, events in flights if completed for event in events]
        alarms = [event for event in good if is_intervention(event)]
        interventions += len(alarms)
        print(
            f"racer, {name}: {share} episodes, {sum(done for done, _ in flights)} completed, "
            f"{frames} frames, {len(alarms)} interventions, warnings {_warnings(good)}",
            flush=True,
        )
        for event in alarms[:5]:
            print(f"  {event}")
        for number, (completed, events) in enumerate(flights):
            if not completed:
                rules = [event.rule for event in events if is_intervention(event)]
                print(f"  episode {number} was not completed: {rules}")
    return share * len(_LEVELS), interventions


def fly_examples(episodes: int, seed: int) -> tuple[int, int]:
    """The same for the Crazyswarm examples."""
    share = max(1, episodes // (len(_LEVELS) * len(EXAMPLES)))
    interventions = 0
    for example in EXAMPLES:
        flights = [
            fly_example(example, level, seed + share * index + number)
            for index, level in enumerate(_LEVELS)
            for number in range(share)
        ]
        told = [event for _, _, events in flights for event in events]
        alarms = [event for event in told if is_intervention(event)]
        interventions += len(alarms)
        print(
            f"{example.name}.py: {len(flights)} episodes, "
            f"{sum(ended for ended, _, _ in flights)} completed, "
            f"{sum(passed for _, passed, _ in flights)} commands, {len(alarms)} "
            f"interventions, warnings {_warnings(told)}",
            flush=True,
        )
        for event in alarms[:5]:
            print(f"  {event}")
    return share * len(_LEVELS) * len(EXAMPLES), interventions


def _warnings(events: Events) -> dict[str, int]:
    return dict(collections.Counter(e.rule for e in events if not is_intervention(e)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=200, help="racer and examples together")
    parser.add_argument("--seed", type=int, default=2022)
    options = parser.parse_args()
    scripts = 2 * options.episodes // 5
    raced, interventions = fly_racer(options.episodes - scripts, options.seed)
    flown, more = fly_examples(scripts, options.seed)
    interventions += more
    print(f"{raced + flown} episodes: {interventions} interventions")
    raise SystemExit(interventions > 0)


if __name__ == "__main__":
    main()
