"""Several episodes in one run: each begins clean, however the one before it ended."""

from __future__ import annotations

import math

import pytest

from crazyarena.levels import load_level
from crazyarena.runner.contestant.in_process import InProcess
from crazyarena.runner.contestant.submission import Submission
from crazyarena.runner.rig.rig import simulated
from crazyarena.runner.trial.arena_staging import ArenaStaging
from crazyarena.runner.trial.control_loop import Deadlines
from crazyarena.runner.trial.phases import Crew
from crazyarena.runner.trial.tracked_world import TrackedWorld
from crazyarena.runner.trial.trial import Trial
from crazyarena.safety.events import Action
from crazyarena.sim_backend import arena_world
from crazyarena.sim_backend.physics.competition_step import B_OMEGA

EMPTY = [
    "track.gates=[]",
    "track.obstacles=[]",
    "start.position=[0, -0.5, 0.03]",
    "goal.position=[0, -0.5, 1.0]",
    "goal.hold=0.5",
]
RISE = """
from competition_utils import Command

class Controller:
    def __init__(self, initial_obs, initial_info, use_firmware=False, verbose=False):
        self.x, self.y = initial_obs[0], initial_obs[2]

    def cmdFirmware(self, time, obs, reward=None, done=None, info=None):
        {trouble}
        rise = min(time / 2.0, 1.0)
        rise = rise * rise * (3.0 - 2.0 * rise)
        place = [self.x, self.y, max(rise, 0.05)]
        return Command.FULLSTATE, [place, [0, 0, 0], [0, 0, 0], 0.0, [0, 0, 0]]
"""


def remembering(made):
    class Arena(arena_world.SimulatedArena):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            made.append(self)

    return Arena


def fly(
    tmp_path, trouble="pass", overrides=(), on_step=None, episodes=3, entry=None, contestant=None
):
    """Results of some episodes of a vehicle that rises to a metre, and the rig it had."""
    if entry is None:
        entry = tmp_path / "rise.py"
        entry.write_text(RISE.format(trouble=trouble))
    level = load_level("sim2real", [*EMPTY, *overrides])
    arenas = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(arena_world, "SimulatedArena", remembering(arenas))
        rig = simulated(level, 3)
    (arena,) = arenas
    world = TrackedWorld(rig)
    contestant = contestant or InProcess(Submission(entry, tmp_path))
    try:
        crew = Crew(rig, world, level, anywhere=True)
        result = Trial(
            level,
            contestant,
            world,
            staging=ArenaStaging(crew, world, level, rig.safeguard),
            deadlines=Deadlines(),
            episodes=episodes,
            on_step=None
            if on_step is None
            else lambda index, time: on_step(rig, arena, index, time),
        ).run()
    finally:
        contestant.close()
        world.close()
    return result


def take(action):
    def on_step(rig, arena, index, time):
        if time > 1.5:
            rig.safeguard.watchdog.request(action, "test")

    return on_step


def tumble(rig, arena, index, time):
    if time > 1.5:
        # As when it hits something: it turns over and falls.
        arena.fleet.bodies[0, B_OMEGA : B_OMEGA + 3] = 40.0


ENDINGS = {
    "complete": ({}, "TASK COMPLETION"),
    "time limit": ({"overrides": ["episode_length=1.5"]}, "MAX EPISODE DURATION"),
    "hold": ({"on_step": take(Action.HOLD)}, "SAFETY"),
    "cut": ({"on_step": take(Action.CUT)}, "SAFETY"),
    "crash": ({"on_step": tumble}, ""),
    "error": ({"trouble": "assert time < 1.5"}, "CONTROLLER ERROR"),
    "finished": (
        {"trouble": "if time > 1.5: return Command.FINISHED, []"},
        "",
    ),
}


@pytest.mark.parametrize("ending", ENDINGS)
def test_three_episodes_with_the_same_ending(tmp_path, ending):
    options, termination = ENDINGS[ending]
    result = fly(tmp_path, **options)
    assert len(result.episodes) == 3, [e.error for e in result.episodes]
    first = result.episodes[0]
    for episode in result.episodes:
        assert termination in episode.termination
        assert episode.termination == first.termination
        spread = 2.0 if ending == "crash" else 0.3  # how it falls is a matter of chance
        assert episode.flight_time == pytest.approx(first.flight_time, abs=spread)
        assert episode.flight_time > 1.4
        assert not episode.error or ending in ("hold", "cut", "crash", "error")
        rules = [event.name for event in episode.events if event.name.startswith("safety")]
        # Nothing of an earlier episode is told again, or still in force.
        if ending in ("complete", "time limit", "finished", "error"):
            assert rules == []
        elif ending != "crash":
            assert sum(name == "safety: test" for name in rules) == 1


def test_a_takeover_is_no_reason_not_to_fly_the_next(tmp_path):
    def on_step(rig, arena, index, time):
        if index == 0 and time > 1.5:
            rig.safeguard.watchdog.request(Action.CUT, "test")

    result = fly(tmp_path, on_step=on_step)
    assert [e.completed for e in result.episodes] == [False, True, True]


def test_episodes_after_the_first_are_flown_alike(tmp_path):
    result = fly(tmp_path)
    assert all(e.completed for e in result.episodes)
    assert all(math.isfinite(e.flight_time) for e in result.episodes)
    assert all("return-and-land" in e.phases for e in result.episodes)


TOWARDS_THE_FENCE = """
import math
from competition_utils import Command

class Controller:
    def __init__(self, initial_obs, initial_info, use_firmware=False, verbose=False):
        self.x, self.y = initial_obs[0], initial_obs[2]

    def place(self, t):
        rise = min(t / 1.5, 1.0)
        way = min(max(t - 1.5, 0.0) / 2.5, 1.0)
        rise, way = (s**3 * (10.0 - s * (15.0 - 6.0 * s)) for s in (rise, way))
        # At the goal it swings, and the run ends on the way towards the fence.
        swing = max(t - 4.0, 0.0)
        swung = 0.09 * math.sin(5.0 * swing - 3.25) * min(1.0, swing / 0.5)
        return self.x, self.y + way * ({goal} - self.y) + swung, rise

    def cmdFirmware(self, time, obs, reward=None, done=None, info=None):
        a, p, b = (self.place(max(time + d, 0.0)) for d in (-1e-3, 0.0, 1e-3))
        v = [(y - x) / 2e-3 for x, y in zip(a, b)]
        return Command.FULLSTATE, [list(p), v, [0, 0, 0], {yaw}, [0, 0, 0]]
"""


def test_a_run_that_ends_drifting_close_to_the_fence_is_brought_home(tmp_path):
    # Slower than what counts as moving, and 0.1 m from the fence: a plan from there swings out.
    drift = TOWARDS_THE_FENCE.replace(
        "0.09 * math.sin(5.0 * swing - 3.25) * min(1.0, swing / 0.5)", "0.06 * swing"
    )
    entry = tmp_path / "drift.py"
    entry.write_text(drift.format(goal=2.86, yaw=0.0))
    overrides = ["start.position=[0, 1.5, 0.03]", "goal.position=[2, 2, 1]"]
    result = fly(tmp_path, overrides=[*EMPTY, *overrides, "episode_length=5"], entry=entry)
    assert [episode.error for episode in result.episodes] == [None] * 3


@pytest.mark.parametrize("yaw", [0.0, 2.5])
@pytest.mark.parametrize(
    "seconds",
    [4.65, *(pytest.param(s, marks=pytest.mark.slow) for s in (4.6, 4.7))],
)
def test_a_run_that_ends_towards_the_fence_is_brought_home(tmp_path, yaw, seconds):
    entry = tmp_path / "swing.py"
    entry.write_text(TOWARDS_THE_FENCE.format(goal=2.87, yaw=yaw))
    overrides = [*EMPTY, "start.position=[0, 1.5, 0.03]", "goal.position=[2, 2, 1]"]
    result = fly(tmp_path, overrides=[*overrides, f"episode_length={seconds}"], entry=entry)
    for episode in result.episodes:
        assert episode.termination == "MAX EPISODE DURATION", episode.error
        assert episode.error is None
        rules = {event.name for event in episode.events if event.name.startswith("safety")}
        assert rules <= {"safety: gate_clamped"}
        assert episode.phases["return-and-land"] > 5.0
