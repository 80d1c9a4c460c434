"""Who judges whom, and what nobody may know beforehand."""

import io
import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from crazyarena.errors import InputError
from crazyarena.levels import dump_level, load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.runner.dry_run import DryRun, example_racer
from crazyarena.runner.records import second_look
from crazyarena.runner.trial.options import FlightOptions
from tests.runner.fakes import controller

LEVEL, LEVEL2 = load_level("level3"), load_level("level2")


def test_a_secret_seed_is_drawn_from_128_bits():
    options = FlightOptions(secret=True)
    seeds = {options.seed(None, LEVEL) for _ in range(50)}
    assert len(seeds) == 50
    assert max(seeds) > 1 << 120
    assert FlightOptions().seed(None, LEVEL) == LEVEL.seed
    assert FlightOptions().seed(7, LEVEL) == 7
    with pytest.raises(InputError, match="exclude"):
        options.seed(7, LEVEL)


def test_a_secret_is_kept_from_the_submission():
    assert FlightOptions(secret=True).sandboxed(LEVEL)
    assert FlightOptions(require_sandbox=True).sandboxed(LEVEL)
    assert not FlightOptions().sandboxed(LEVEL)
    with pytest.raises(InputError, match="no secret"):
        FlightOptions(secret=True, sandbox=False).check()


@pytest.mark.parametrize("rng", ["pcg64", "gym021"])
def test_large_seeds_draw_and_ordinary_ones_draw_what_they_did(rng):
    level = load_level("level3", [f"rng={rng}"])
    secret = 1 << 127 | 12345
    first = LevelRandom(level, secret).reset()
    assert (first.gates == LevelRandom(level, secret).reset().gates).all()
    assert (first.gates != LevelRandom(level, secret + 1).reset().gates).any()


def flown(tmp_path: Path, **options):
    entry = tmp_path / "entry.py"
    entry.write_text(controller("return Command.FINISHED, []"))
    stream = io.StringIO()
    run = DryRun(
        entry,
        "level3",
        ["episode_length=1.0"],
        1,
        out=tmp_path / "out",
        figure=False,
        console=Console(file=stream, width=120),
        options=replace(FlightOptions(), **options),
    )
    result = run.run()
    return result, json.loads((tmp_path / "out" / "result.json").read_text()), stream.getvalue()


def test_without_walls_the_result_says_so(tmp_path):
    result, document, said = flown(tmp_path)
    assert not result.isolated
    assert document["isolated"] is False
    assert "not isolated" in said
    assert "--require-sandbox" in said


def test_behind_walls_the_seed_is_told_by_the_result_alone(tmp_path):
    result, document, said = flown(tmp_path, secret=True)
    seed = document["provenance"]["seed"]
    assert seed > 1 << 64
    assert str(seed) not in said
    assert document["isolated"] == result.isolated
    if not document["provenance"]["contestant"]["missing"]:
        assert result.isolated
        assert "not isolated" not in said
    assert str(seed) not in str(os.environ)


FORGED = (
    "import sys; r = sys.modules['crazyarena.runner.judging.result'].EpisodeResult\n"
    "        old = r.__init__\n"
    "        def forged(self, **k):\n"
    "            k.update(termination='TASK COMPLETION', completed=True, gates_passed=k['gates'],\n"
    "                     collisions=0, violations=0)\n"
    "            old(self, **k)\n"
    "            r.__init__ = old\n"
    "        r.__init__ = forged\n"
    "        return Command.FINISHED, []"
)


@pytest.mark.parametrize("sandbox", [False, True])
def test_a_result_that_the_submission_has_patched_is_not_clean(tmp_path, sandbox):
    """A submission in the judge's process, which replaces the judge's record without flying."""
    entry = tmp_path / "entry.py"
    entry.write_text(controller(FORGED))
    stream = io.StringIO()
    run = DryRun(
        entry,
        "level3",
        ["episode_length=1.0"],
        1,
        out=tmp_path / "out",
        figure=False,
        console=Console(file=stream, width=200),
        options=FlightOptions(sandbox=sandbox),
    )
    result = run.run()
    assert not result.clean
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    assert not document["episodes"][0]["clean"]
    assert not document["score"]["qualified"]
    if sandbox:
        assert not result.episodes[0].completed
    else:
        assert "not isolated" in stream.getvalue()
        assert "not borne out by its recording: completed: True said, False" in stream.getvalue()
        assert "gates passed: 4 said, 0 recorded" in document["episodes"][0]["doubt"]


def test_honest_flights_are_borne_out(tmp_path):
    stream = io.StringIO()
    run = DryRun(
        example_racer(),
        "level1",
        [],
        2,
        out=tmp_path / "out",
        figure=False,
        console=Console(file=stream, width=200),
    )
    result = run.run()
    assert result.clean
    assert not result.isolated
    assert "borne out" not in stream.getvalue()
    # Another number is noticed, whichever it is.
    for index, name in enumerate(("completed", "gates_passed", "collisions", "violations")):
        (file, *_) = sorted((tmp_path / "out").glob("*.mcap"))
        claim = {"file": str(file), "completed": True, "gates_passed": 4}
        claim |= {"collisions": 0, "violations": 0}
        claim["flight_time"] = second_look.judged_again(load_level("level1"), file)["flight_time"]
        claim[name] = claim[name] + 1 if index else False
        told = second_look.judged_again(load_level("level1"), file)
        assert [k for k in told if told[k] != claim[k]] == [name]


def test_a_time_that_was_not_flown_is_not_borne_out(tmp_path):
    run = DryRun(
        example_racer(),
        "level1",
        [],
        1,
        out=tmp_path / "out",
        figure=False,
        console=Console(file=io.StringIO()),
    )
    (episode,) = run.run().episodes
    assert episode.doubt == ""
    episode.flight_time = 3.2
    (told,) = second_look.look_again(load_level("level1"), tmp_path / "out", [episode])
    assert "flight time: 3.2 said" in told


def test_a_recording_that_cannot_be_read_bears_out_nothing(tmp_path):
    file = tmp_path / "none.mcap"
    file.write_bytes(b"nothing")
    claim = {"file": str(file), "completed": True, "gates_passed": 0, "collisions": 0}
    claim |= {"violations": 0, "flight_time": 0.0}
    (told,) = second_look.doubts(dump_level(LEVEL2), [claim])
    assert "cannot be judged again" in told
