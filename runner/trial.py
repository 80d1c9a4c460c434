"""A trial: the episodes that one controller object lives through, as in the competition.

The controller is made once, after the first reset. Later episodes begin with the last
observation of the episode before them: a reset tells the contestant nothing.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from crazyarena import __version__
from crazyarena.clock import Clock, WallClock
from crazyarena.errors import InputError
from crazyarena.levels import dump_level
from crazyarena.levels.draw import Draw, LevelRandom
from crazyarena.levels.schema import Level
from crazyarena.runner.contestant import Submission, own_traceback
from crazyarena.runner.episode import Episode, Interrupt
from crazyarena.runner.info import Canvas, initial_info
from crazyarena.runner.recording import Recorder
from crazyarena.runner.referee import Referee, observation
from crazyarena.runner.result import CONTROLLER_ERROR, INTERRUPTED, EpisodeResult, TrialResult
from crazyarena.runner.scene import scene_update
from crazyarena.runner.world import World

_ENDS_TRIAL = (CONTROLLER_ERROR, INTERRUPTED)


def require_firmware(level: Level) -> None:
    """Raise InputError for a level that asks for the mode without firmware."""
    if not level.use_firmware:
        raise InputError(
            f"level {level.name}: use_firmware is false; only firmware mode (cmdFirmware) "
            "can be flown. Set use_firmware: true"
        )


class Trial:
    """Flies ``episodes`` episodes of a level with one submission.

    Parameters
    ----------
    level: with ``use_firmware`` (the contestant's ``cmdSimOnly`` has no counterpart here).
    submission: loaded; its ``workdir`` is the current directory meanwhile.
    world: not reset yet; the caller closes it.
    episodes: how many; default the level's own number.
    seed: replaces the level's own.
    out: existing folder for recordings, or None to record nothing.
    keep_states: keep the flight in memory for ``on_episode`` even if nothing is recorded.
    on_step: called with (episode, time s) after every control step.
    on_episode: called with each episode's result and recorder (or None) right after it.
    """

    def __init__(
        self,
        level: Level,
        submission: Submission,
        world: World,
        *,
        episodes: int | None = None,
        seed: int | None = None,
        out: Path | None = None,
        keep_states: bool = False,
        on_step: Callable[[int, float], None] | None = None,
        on_episode: Callable[[EpisodeResult, Recorder | None, Draw], None] | None = None,
        wall: Clock | None = None,
    ) -> None:
        require_firmware(level)
        self._level = level
        self._submission = submission
        self._world = world
        self._episodes = level.num_episodes if episodes is None else episodes
        self._seed = level.seed if seed is None else seed
        self._out = out.resolve() if out is not None else None
        self._keep_states = keep_states
        self._on_step = on_step
        self._on_episode = on_episode
        self._wall = wall if wall is not None else WallClock()

    def run(self) -> TrialResult:
        """Fly; raises InputError when the controller cannot be constructed."""
        random = LevelRandom(self._level, self._seed)
        referee = Referee(self._level)
        results: list[EpisodeResult] = []
        canvas = Canvas()
        controller: Any = None
        obs: list[Any] = []
        try:
            with Interrupt() as interrupt:
                for index in range(self._episodes):
                    draw = random.reset()
                    self._world.reset(draw)
                    referee.begin(draw.gates, draw.obstacles)
                    if controller is None:
                        obs = observation(draw.start)
                        info = initial_info(self._level, canvas, draw.start)
                        interrupt.in_controller = True
                        controller = self._submission.make(
                            list(obs), info, self._level.use_firmware, self._level.verbose
                        )
                        interrupt.in_controller = False
                    result, obs = self._fly(index, controller, referee, obs, draw, interrupt)
                    results.append(result)
                    if interrupt.asked or result.termination in _ENDS_TRIAL:
                        break
                    if index + 1 < self._episodes:
                        self._between(controller, "interEpisodeReset", result, interrupt)
                        if result.error is not None:
                            break
        finally:
            canvas.close()
        return TrialResult(results, self._episodes)

    def _fly(
        self,
        index: int,
        controller: Any,
        referee: Referee,
        obs: list[Any],
        draw: Draw,
        interrupt: Interrupt,
    ) -> tuple[EpisodeResult, list[Any]]:
        recorder = self._recorder(index, draw)
        on_step = self._on_step
        try:
            result, obs = Episode(
                index,
                controller,
                self._world,
                referee,
                self._level.control_frequency,
                self._wall,
                interrupt,
                recorder,
                None if on_step is None else lambda time: on_step(index, time),
            ).fly(obs)
        finally:
            if recorder is not None:
                recorder.close()
        if recorder is not None and recorder.file is not None:
            result.files["recording"] = recorder.file.name
        if result.termination not in _ENDS_TRIAL:
            result.interepisode_learning_time = self._between(
                controller, "interEpisodeLearn", result, interrupt
            )
        if self._on_episode is not None:
            self._on_episode(result, recorder, draw)
        return result, obs

    def _between(
        self, controller: Any, method: str, result: EpisodeResult, interrupt: Interrupt
    ) -> float:
        """Call a hook that not every variant has; returns its wall time, s."""
        hook = getattr(controller, method, None)
        if hook is None:
            return 0.0
        started = self._wall.now()
        try:
            interrupt.in_controller = True
            hook()
        except KeyboardInterrupt:
            interrupt.asked = True
        except (Exception, SystemExit) as error:
            result.error = f"{method} raised\n{own_traceback(error)}"
            result.termination = CONTROLLER_ERROR
        finally:
            interrupt.in_controller = False
        return self._wall.now() - started

    def _recorder(self, index: int, draw: Draw) -> Recorder | None:
        if self._out is None and not self._keep_states:
            return None
        metadata = {
            "crazyarena": __version__,
            "level": self._level.name,
            "level_file": dump_level(self._level),
            "seed": str(self._seed),
            "episode": str(index),
            "submission_sha256": self._submission.digest,
            "start": json.dumps(draw.start.tolist()),
            "mass": repr(draw.mass),
            "inertia": json.dumps(draw.inertia.tolist()),
            "gates": json.dumps(draw.gates.tolist()),
            "obstacles": json.dumps(draw.obstacles.tolist()),
        }
        scene = scene_update(draw.gates, draw.obstacles, self._level)
        file = None if self._out is None else self._out / f"episode_{index:03d}.mcap"
        return Recorder(file, metadata, scene, self._wall)
