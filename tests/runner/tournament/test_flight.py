"""Blocks as they are flown: the same worlds for all, secret, repeatable, and nobody else's harm."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rich.console import Console

from crazyarena.levels import load_level
from crazyarena.levels.draw import LevelRandom, SeparateDraws
from crazyarena.levels.draw_file import dump_draw, read_draw
from crazyarena.runner.dry_run import DryRun, example_racer
from crazyarena.runner.records.mcap_records import read_records
from crazyarena.runner.tournament.flight import NOT_FLOWN, SUBMISSION_ERROR, Order, fly, thinned
from crazyarena.runner.trial.options import FlightOptions
from tests.runner.fakes import controller
from tests.runner.lsy_controllers import ATTITUDE, STATE

SHORT = ["episode_length=3.0"]
SEEDS = (2**127 + 1, 7)


def order(level="level3", seeds=SEEDS, overrides=(), toml=None, **fields):
    text = (
        dump_draw(load_level(level, [*SHORT, *overrides]), seeds, "free")
        if toml is None
        else dump_draw(level, seeds, "free", overrides)
    )
    return Order(
        key="t/l/0", team="t", level="l", draws=tuple(range(len(seeds))), archive="", place="",
        contract="iros2022", draw_file=text, toml=toml, **fields,
    )  # fmt: skip


def write(folder: Path, text: str, name: str = "pilot.py") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text)
    return folder / name


def metadata(data: bytes, tmp_path: Path) -> dict[str, str]:
    file = tmp_path / "some.mcap"
    file.write_bytes(data)
    return read_records(file).metadata


HOVER = controller("return (Command.TAKEOFF, [1.0, 1.0]) if time == 0 else (Command.NONE, [])")


# The same worlds


@pytest.mark.parametrize("level", ["level1", "level3"])
def test_every_team_meets_the_same_worlds_however_long_it_flew(tmp_path, level):
    """Also on a level whose random stream runs on from episode to episode."""
    quitter = controller("return Command.FINISHED, []")
    worlds = []
    for name, text in (("stays", HOVER), ("quits", quitter)):
        flown = fly(order(level, (5, 6, 7)), write(tmp_path / name, text))
        assert len(flown.episodes) == 3
        worlds.append(
            [
                {k: metadata(flown.recordings[n], tmp_path)[k]
                 for k in ("seed", "start", "mass", "inertia", "gates", "obstacles")}
                for n in range(3)
            ]
        )  # fmt: skip
    assert worlds[0] == worlds[1]
    assert [world["seed"] for world in worlds[0]] == ["5", "6", "7"]
    assert len({world["start"] for world in worlds[0]}) == 3


@given(st.lists(st.integers(0, 2**128 - 1), min_size=1, max_size=4), st.integers(0, 200))
def test_separate_draws_do_not_hang_together(seeds, ticks):
    level = load_level("level3")
    together = SeparateDraws(level, seeds)
    for seed in seeds:
        draw, alone = together.reset(), LevelRandom(level, seed).reset()
        assert draw.start.tolist() == alone.start.tolist()
        assert draw.gates.tolist() == alone.gates.tolist()
        assert draw.tick_noise(ticks).tolist() == alone.tick_noise(ticks).tolist()


def test_a_draw_file_repeats_an_episode_to_the_byte(tmp_path):
    submission = write(tmp_path / "team", HOVER)
    job = order()
    flown = fly(job, submission)
    (tmp_path / "draw.yaml").write_text(job.draw_file)
    drawn = read_draw(tmp_path / "draw.yaml")
    assert drawn.seeds == SEEDS
    run = DryRun(
        submission, drawn.level, out=tmp_path / "again", figure=False, seeds=drawn.seeds,
        console=Console(file=io.StringIO()), options=FlightOptions(sandbox=True, compute="free"),
    )  # fmt: skip
    run.run()
    for number in (0, 1):
        again = (tmp_path / "again" / f"episode_{number:03d}.mcap").read_bytes()
        assert again == flown.recordings[number]
    assert json.loads((tmp_path / "again" / "result.json").read_text())["provenance"][
        "seeds"
    ] == list(SEEDS)


# Secret

THIEF = """
import sys
import numpy as np
import edit_honest
from crazyarena.levels import load_level
from crazyarena.levels.draw import LevelRandom

class Controller(edit_honest.Controller):
    '''Finds the seed by its start pose, and then knows where every gate is.'''

    def __init__(self, initial_obs, initial_info, *arguments, **options):
        level = load_level("level3")
        for seed in [1337, *range(2000)]:
            draw = LevelRandom(level, seed).reset()
            if np.allclose(draw.start[[0, 2, 4]], np.array(initial_obs)[[0, 2, 4]], atol=1e-12):
                raise RuntimeError(f"the seed is {seed}")
        super().__init__(initial_obs, initial_info, *arguments, **options)
"""


def test_who_looks_for_the_seed_does_no_better_than_the_honest(tmp_path):
    from crazyarena.runner.tournament.plan import plan_level, secret_seeds
    from crazyarena.runner.tournament.rules import Lives

    honest = tmp_path / "honest"
    shutil.copytree(example_racer(), honest, ignore=shutil.ignore_patterns("__pycache__"))
    thief = tmp_path / "thief"
    shutil.copytree(honest, thief)
    (thief / "edit_this.py").rename(thief / "edit_honest.py")
    (thief / "edit_this.py").write_text(THIEF)
    # It works where the seed is one of those it knows ...
    found = fly(order(seeds=(1337,), overrides=["episode_length=33.0"], record=False), thief)
    assert "the seed is 1337" in found.episodes[0]["error"]
    # ... and not in a tournament, where it flies what it would have flown without.
    level = plan_level("level3", secret_seeds(2), Lives.LEVEL)
    assert all(seed > 2**64 for seed in level.seeds)
    job = order(seeds=level.seeds, overrides=["episode_length=33.0"], record=False)
    one, other = fly(job, thief).episodes, fly(job, honest).episodes
    for mine, theirs in zip(one, other, strict=True):
        for name in ("outcome", "flight_time", "gate_times", "path", "clean"):
            assert mine[name] == theirs[name]


def test_seeds_are_the_systems_and_new_each_time():
    from crazyarena.runner.tournament.plan import secret_seeds

    seeds = {seed for _ in range(50) for seed in secret_seeds(20)}
    assert len(seeds) == 1000
    assert max(seeds) > 2**126


def test_neither_seed_nor_draw_file_are_in_its_process(tmp_path):
    look = controller(
        "return Command.FINISHED, []",
        init="import glob, os; print(sorted(glob.glob('/**/draw*.yaml', recursive=True)), "
        "[k for k in os.environ if 'SEED' in k or 'DRAW' in k]); "
        "from crazyarena.levels.schema import Level; import gc; "
        "assert not [o for o in gc.get_objects() if isinstance(o, Level) and o.seed]; "
        "assert not glob.glob('/**/draw*.yaml', recursive=True)",
    )
    flown = fly(order(record=False), write(tmp_path / "spy", look))
    assert flown.episodes[0]["outcome"] == "FINISHED", flown.episodes[0]["error"]


# Harm


def test_one_that_fails_ends_its_own_block(tmp_path):
    step = "assert time == 0.0\n        return Command.TAKEOFF, [1.0, 1.0]"
    flown = fly(order(seeds=(1, 2, 3)), write(tmp_path / "team", controller(step)))
    assert [e["outcome"] for e in flown.episodes] == ["CONTROLLER ERROR", NOT_FLOWN, NOT_FLOWN]
    assert "AssertionError" in flown.episodes[0]["error"]
    assert str(tmp_path) not in json.dumps(flown.episodes)
    assert sorted(flown.recordings) == [0]


def test_one_that_hangs_is_not_waited_for_longer_than_said(tmp_path):
    step = "while True: pass"
    job = order(seeds=(1, 2), patience=0.5, record=False)
    flown = fly(job, write(tmp_path / "team", controller(step)))
    assert [e["outcome"] for e in flown.episodes] == ["CONTROLLER TIMEOUT", NOT_FLOWN]
    assert "0.5 s" in flown.episodes[0]["error"]


def test_one_that_is_slow_all_the_time_is_ended_too(tmp_path):
    """Each answer in time, and all of them together for ever."""
    import time

    from crazyarena.levels.lsy import lsy_text

    slow = "__import__('time').sleep(0.09)"
    toml = ("level.toml", lsy_text("lsy/level2"))
    lsy = STATE.replace("        place = self", f"        {slow}\n        place = self")
    take_off = "return (Command.TAKEOFF, [1.0, 1.0]) if time == 0 else (Command.NONE, [])"
    long = order(seeds=(1,), patience=0.1, record=False, overrides=["episode_length=33.0"])
    jobs = {
        "a": (long, controller(f"{slow}\n        {take_off}")),
        "b": (order("level.toml", (1,), toml=toml, patience=0.1, record=False), lsy),
    }
    for name, (job, source) in jobs.items():
        began = time.monotonic()
        (line,) = fly(job, write(tmp_path / name, source)).episodes
        assert "wall time" in (line["error"] or ""), line
        assert not line["clean"]
        assert time.monotonic() - began < 60.0


def test_one_that_does_not_load_says_why(tmp_path):
    flown = fly(order(), write(tmp_path / "team", "import nothing_of_this_name\n"))
    assert [e["outcome"] for e in flown.episodes] == [SUBMISSION_ERROR, SUBMISSION_ERROR]
    assert "nothing_of_this_name" in flown.episodes[0]["error"]
    assert not any(e["clean"] for e in flown.episodes)


def test_parameters_are_told_in_both_ways(tmp_path):
    init = (
        "import json, os; assert initial_info['parameters'] == {'speed': 1.5}; "
        "assert json.loads(os.environ['CRAZYARENA_PARAMETERS']) == {'speed': 1.5}"
    )
    text = controller("return Command.FINISHED, []", init=init)
    job = order(seeds=(1,), record=False, parameters={"speed": 1.5})
    assert fly(job, write(tmp_path / "team", text)).episodes[0]["outcome"] == "FINISHED"


# lsy_drone_racing


def test_controllers_of_lsy_fly_their_own_levels(tmp_path):
    from crazyarena.levels.lsy import lsy_text

    toml = ("level.toml", lsy_text("lsy/level2"))
    job = order("level.toml", toml=toml)
    flown = fly(job, write(tmp_path / "team", STATE))
    assert [e["gates"] for e in flown.episodes] == [4, 4]
    assert all(e["path"] for e in flown.episodes)
    gates = [metadata(flown.recordings[k], tmp_path)["gates"] for k in (0, 1)]
    assert gates[0] != gates[1]
    other = fly(job, write(tmp_path / "other", STATE.replace("15, len", "12, len")))
    assert [metadata(other.recordings[k], tmp_path)["gates"] for k in (0, 1)] == gates
    attitude = order("level.toml", toml=toml, overrides=["env.control_mode=attitude"])
    hovers = fly(attitude, write(tmp_path / "third", ATTITUDE))
    assert [e["outcome"] for e in hovers.episodes] == ["CONTROLLER FINISHED"] * 2


# Paths


@given(
    hnp.arrays(float, st.tuples(st.integers(0, 40), st.just(3)), elements=st.floats(-3, 3)),
)
def test_a_thinned_path_is_never_far_from_the_flown_one(points):
    import numpy as np

    kept = np.array(thinned(points)).reshape(-1, 3)
    if not len(points):
        assert not len(kept)
        return
    for point in points:
        if len(kept) == 1:
            away = np.linalg.norm(kept[0] - point)
        else:
            start, line = kept[:-1], np.diff(kept, axis=0)
            length = np.maximum((line**2).sum(axis=1), 1e-12)
            along = np.clip(((point - start) * line).sum(axis=1) / length, 0, 1)
            away = np.linalg.norm(start + along[:, None] * line - point, axis=1).min()
        assert away <= 0.02 + 0.011  # and rounding
