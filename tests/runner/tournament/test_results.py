"""Tables, files, remarks, imported trials and the live view."""

from __future__ import annotations

import csv
import io
import json

import pytest
from rich.console import Console

from crazyarena.errors import InputError
from crazyarena.runner.tournament.results import assemble, document, rows, write_files
from crazyarena.runner.tournament.tables import Watch, tell
from crazyarena.runner.tournament.trials import add_trial
from tests.runner.tournament import made_up


@pytest.fixture
def event(tmp_path):
    tournament = made_up.planned(tmp_path / "out", ["Alpha", "Beta [b]"], ["level0", "sim2real"])
    yield tournament
    tournament.close()


def fly(event, team, level, count=3, **fields):
    event.journal.append([made_up.line(team, level, k, **fields) for k in range(count)])


def text_of(event, width=160):
    console = Console(file=io.StringIO(), width=width)
    tell(assemble(event), console)
    return console.file.getvalue()


def test_the_table_says_points_rates_failures_and_doubt(event):
    fly(event, "alpha", "level0")
    crash = {"clean": False, "completed": False, "outcome": "COLLISION", "gates_passed": 2,
             "path": [[0, 0, 1]], "place": [0, 0, 1]}  # fmt: skip
    fly(event, "beta-b", "level0", **crash)
    text = text_of(event)
    assert "+40 3/3 8.00 s" in text
    assert "3 × collision before gate 2" in text
    assert "Beta [b]" in text, "a name is no markup"
    assert "not distinguishable on 3 draws" in text
    assert "not finished: 6 episodes are still to be flown" in text
    for width in (40, 60, 80):
        text_of(event, width)


def test_any_two_teams_are_compared_when_asked_for(event):
    fly(event, "alpha", "level0", flight_time=7.0)
    fly(event, "beta-b", "level0")
    results = assemble(event, [("beta [B]", "alpha")])
    assert next((a.name, b.name) for a, b, _ in results.comparisons) == ("Beta [b]", "Alpha")
    assert results.comparisons[0][2].difference == 1.0
    with pytest.raises(InputError, match=r"Gamma: no team of this name \(there are Alpha, Beta"):
        assemble(event, [("Alpha", "Gamma")])


def test_kinds_of_processor_are_remarked(event):
    fly(event, "alpha", "level0", worker={"cpu": "one"})
    fly(event, "beta-b", "level0", worker={"cpu": "two"})
    assert any("2 kinds of processor (one, two)" in r for r in assemble(event).remarks)


def test_measured_thinking_needs_processors_of_its_own(tmp_path):
    from dataclasses import replace

    event = made_up.planned(tmp_path / "out", ["Alpha"])
    event.plan = replace(event.plan, options=replace(event.plan.options, compute="measured"))
    fly(event, "alpha", "level0", 2, worker={"cpu": "one", "pinned": True})
    assert not any("not comparable" in r for r in assemble(event).remarks)
    event.journal.append([made_up.line("alpha", "level0", 2)])
    assert any("others used as well" in r for r in assemble(event).remarks)
    event.close()


def test_the_csv_has_a_row_an_episode_and_no_formulas(event):
    fly(event, "alpha", "level0", why="=cmd|' /C calc'!A0")
    files = write_files(assemble(event))
    table = list(csv.DictReader(files[0].read_text().splitlines()))
    assert len(table) == 3
    assert table[0]["team"] == "Alpha"
    assert table[0]["draw_file"] == "draws/level0-000.yaml"
    assert (event.out / table[0]["draw_file"]).is_file()
    assert table[0]["why"].startswith("'=")
    standings = json.loads(files[1].read_text())
    assert standings["teams"][0]["levels"]["level0"]["success_interval"][1] == 1.0


def test_parquet_holds_the_same(event):
    parquet = pytest.importorskip("pyarrow.parquet")
    fly(event, "alpha", "level0")
    results = assemble(event)
    write_files(results, parquet=True)
    table = parquet.read_table(event.out / "results.parquet").to_pylist()
    assert [row["draw"] for row in table] == [row["draw"] for row in rows(results)]


# Trials flown elsewhere


def run(folder, backend="radio://0/80/2M/E7E7E7E701", digest="0" * 64, **fields):
    folder.mkdir(parents=True)
    episode = {
        "termination": "TASK COMPLETION", "why": "TASK COMPLETION", "completed": True,
        "flight_time": 9.5, "interstep_learning_time": 0.1, "interepisode_learning_time": 0.0,
        "gates_passed": 4, "gates": 4, "collisions": 0, "violations": 0, "files": {}, **fields,
    }  # fmt: skip
    document = {
        "format": 1,
        "episodes": [episode],
        "provenance": {
            "level": "sim2real", "date": f"2026-01-01 {folder.name}", "submission_sha256": digest,
            "rig": {"backend": backend}, "level_file": "track: {gates: [{x: 1, y: 2}]}",
        },
    }  # fmt: skip
    (folder / "result.json").write_text(json.dumps(document))
    return folder


def test_a_level_with_trials_is_scored_by_them_alone(event, tmp_path):
    for team in ("alpha", "beta-b"):
        fly(event, team, "sim2real", flight_time=1.0)
    add_trial(event, f"Alpha={run(tmp_path / 'real1')}")
    results = assemble(event)
    level = results.standings.levels["sim2real"]
    assert level["alpha"].qualified
    assert level["alpha"].categories["safety and performance"].value == 9.5
    assert not level["beta-b"].qualified, "it has not flown in the arena"
    assert any(r.startswith("sim2real: scored by trials") for r in results.remarks)
    assert document(results)["teams"][0]["levels"]["sim2real"]["flown"] == 1
    # The last of several counts, as everywhere.
    add_trial(event, f"alpha={run(tmp_path / 'real2', collisions=1)}")
    assert not assemble(event).standings.levels["sim2real"]["alpha"].qualified
    assert any(row["source"].startswith("radio") for row in rows(assemble(event)))


def test_a_trial_of_a_level_that_was_not_planned_is_a_level_more(tmp_path):
    event = made_up.planned(tmp_path / "out", ["Alpha"], ["level0"])
    fly(event, "alpha", "level0")
    add_trial(event, f"Alpha={run(tmp_path / 'real', backend='sim')}")
    results = assemble(event)
    assert [level.key for level in results.levels] == ["level0", "sim2real"]
    assert results.standings.totals["alpha"] == 80.0
    assert any("some of them in simulation" in r for r in results.remarks)
    event.close()


def test_bad_trials_are_refused(event, tmp_path):
    good = run(tmp_path / "good")
    cases = {
        str(tmp_path / "nowhere"): "no result.json here",
        f"Gamma={good}": "no team of this name",
        f"Alpha={run(tmp_path / 'time', flight_time='fast')}": "flight_time: expected s",
        f"Alpha={run(tmp_path / 'nan', flight_time=float('nan'))}": "flight_time: expected s",
        f"Alpha={run(tmp_path / 'count', collisions=-1)}": "collisions: expected a whole number",
    }
    (tmp_path / "no").mkdir()
    (tmp_path / "no" / "result.json").write_text("[]")
    cases[f"Alpha={tmp_path / 'no'}"] = "not the result of a run"
    for argument, words in cases.items():
        with pytest.raises(InputError, match=words):
            add_trial(event, argument)
    add_trial(event, f"Alpha={good}")
    with pytest.raises(InputError, match="is there already"):
        add_trial(event, f"Alpha={good}")
    assert len(event.journal.episodes) == 1


def test_a_trial_finds_its_team_by_what_flew(tmp_path):
    from crazyarena.runner.contestant.submission import submission_hash
    from crazyarena.runner.tournament.run import open_tournament

    teams = tmp_path / "teams"
    for name in ("one", "two"):
        (teams / name).mkdir(parents=True)
        (teams / name / "edit_this.py").write_text(f"# {name}\nclass Controller:\n    pass\n")
    event = open_tournament(tmp_path / "out", teams, ["level0"])
    digest = submission_hash(teams / "two")
    (line,) = add_trial(event, str(run(tmp_path / "real", digest=digest)))
    assert line["team"] == "two"
    with pytest.raises(InputError, match="the submission of no team"):
        add_trial(event, str(run(tmp_path / "other", digest="f" * 64)))
    event.close()


def test_a_real_result_folder_is_taken_in_with_its_recording(tmp_path):
    """That of the command itself, in simulation."""
    from crazyarena.runner.dry_run import DryRun
    from tests.runner.fakes import controller

    file = tmp_path / "pilot.py"
    step = "return (Command.TAKEOFF, [1.0, 1.0]) if time < 0.2 else (Command.FINISHED, [])"
    file.write_text(controller(step))
    DryRun(
        file, "level0", out=tmp_path / "run", figure=False, console=Console(file=io.StringIO())
    ).run()
    event = made_up.planned(tmp_path / "out", ["Alpha"])
    (line, *_) = add_trial(event, f"Alpha={tmp_path / 'run'}")
    assert (event.out / line["recording"]).is_file()
    assert line["path"]
    assert line["trial"]["track"]["gates"]
    event.close()


# Live


def test_the_live_view_counts_and_tells_the_rest(event):
    now = [0.0]
    console = Console(file=io.StringIO(), width=100, force_terminal=True)
    watch = Watch(event, console, 2, True, clock=lambda: now[0])
    assert watch.left() is None
    fly(event, "alpha", "level0")
    now[0] = 30.0
    watch.flown(list(event.journal.episodes.values()))
    assert watch.left() == pytest.approx(90.0)
    with console.capture() as shown:
        console.print(watch.render())
    assert "3 of 12 episodes, about 1 min 30 s left" in shown.get()
    assert "Beta [b]" in shown.get()
    with watch:
        watch.tick()


def test_without_a_terminal_it_is_a_line_a_block(event):
    console = Console(file=io.StringIO(), width=100)
    with Watch(event, console, 2, True) as watch:
        fly(event, "beta-b", "level0")
        watch.flown(list(event.journal.episodes.values()))
        watch.tick()
    assert console.file.getvalue() == "3 of 12: Beta [b] on level0, 3 of 3 clean\n"
