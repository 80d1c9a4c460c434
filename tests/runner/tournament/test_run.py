"""A whole tournament: begun, gone on with, refused; on workers that die or are unfit."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from crazyarena.errors import CrazyarenaError, InputError, StorageError
from crazyarena.runner.cli import make_app
from crazyarena.runner.tournament import worker
from crazyarena.runner.tournament.engine import Engine, SchedulerLost
from crazyarena.runner.tournament.flight import Flown, NoWalls, Order
from crazyarena.runner.tournament.journal import JOURNAL
from crazyarena.runner.tournament.plan import PLAN, read_plan
from crazyarena.runner.tournament.run import open_tournament
from tests.runner.fakes import controller
from tests.runner.tournament import made_up
from tests.waiting import eventually

pytest.importorskip("distributed")

HOVER = controller("return (Command.TAKEOFF, [1.0, 1.0]) if time == 0 else (Command.NONE, [])")
RAISES = controller("raise RuntimeError('told you')")
TIMES = ("wall", "learning_time", "compute_ms", "noise_ms", "worker")


@pytest.fixture
def teams(tmp_path: Path) -> Path:
    folder = tmp_path / "teams"
    folder.mkdir()
    (folder / "alpha.py").write_text(HOVER)
    (folder / "bravo.py").write_text(RAISES)
    (folder / "broken.py").write_text("class Controller:")
    (folder / "empty").mkdir()
    return folder


@pytest.fixture
def level(tmp_path: Path) -> str:
    from crazyarena.levels import dump_level, load_level

    file = tmp_path / "short.yaml"
    file.write_text(dump_level(load_level("level3", ["episode_length=1.0", "name=short"])))
    return str(file)


def command(*arguments: object) -> Any:
    return CliRunner().invoke(make_app(), ["tournament", *map(str, arguments)])


def but_for_times(out: Path) -> dict[str, Any]:
    lines = [json.loads(text) for text in (out / JOURNAL).read_text().splitlines()]
    keys = [line["key"] for line in lines]
    assert len(keys) == len(set(keys)), "an episode was flown twice"
    return {e["key"]: {k: v for k, v in e.items() if k not in TIMES} for e in lines}


def identities() -> dict[str, Any]:
    return {**worker.identity(), "address": "tcp://here"}


def test_from_a_folder_to_a_page_and_on_from_there(tmp_path, teams, level):
    out = tmp_path / "out"
    done = command(teams, "--levels", level, "--seeds", 2, "--out", out, "--title", "Mine & yours")
    assert done.exit_code == 0, done.output
    assert "empty does not fly: empty: no edit_this.py" in done.output
    for name in ("index.html", "results.csv", "standings.json", "teams/alpha.html"):
        assert (out / name).is_file()
    assert "<title>Mine &amp; yours</title>" in (out / "index.html").read_text()
    lines = but_for_times(out)
    assert len(lines) == 8
    assert lines["bravo/short/0"]["outcome"] == "CONTROLLER ERROR"
    assert lines["broken/short/1"]["outcome"] == "SUBMISSION ERROR"
    assert (out / "draws").stat().st_mode & 0o777 == 0o755
    before = (out / JOURNAL).read_bytes()
    again = command("--out", out)
    assert again.exit_code == 0
    assert "8 episodes were there already" in again.output
    assert (out / JOURNAL).read_bytes() == before
    # The whole of it, once more, replays from its draw file.
    replay = CliRunner().invoke(
        make_app(),
        ["dry-run", str(teams / "alpha.py"), "--draw", str(out / "draws" / "short-000.yaml"),
         "--out", str(tmp_path / "replay"), "--no-figure", "--sandbox"],
    )  # fmt: skip
    assert replay.exit_code == 1, replay.output
    for number in (0, 1):
        flown = (out / "recordings" / "alpha" / f"short-{number:04d}.mcap").read_bytes()
        assert (tmp_path / "replay" / f"episode_{number:03d}.mcap").read_bytes() == flown


def test_draws_are_the_organisers_alone_until_all_is_flown(tmp_path, teams, level):
    tournament = open_tournament(tmp_path / "out", teams, [level], {"seeds": 2})
    tournament.close()
    for path in (tmp_path / "out" / "draws", tmp_path / "out" / PLAN):
        assert path.stat().st_mode & 0o077 == 0
    plan = read_plan(tmp_path / "out")
    assert plan.levels == tournament.plan.levels
    assert plan.teams == tournament.plan.teams


def test_what_was_begun_is_gone_on_with_as_it_was(tmp_path, teams, level):
    out = tmp_path / "out"
    open_tournament(out, teams, [level], {"seeds": 2}).close()
    open_tournament(out, teams, [level], {"seeds": 2}, "iros2022").close()
    wrong: list[tuple[tuple[Any, ...], str]] = [
        ((teams, [level], {"seeds": 3}), "--seeds 2, not 3"),
        ((teams, ["level0"]), "--levels short, not level0"),
        ((None, None, {"record": False}), "--record True, not False"),
        ((None, None, None, "lsy"), "--rules IROS 2022"),
    ]
    for arguments, words in wrong:
        with pytest.raises(InputError, match=words):
            open_tournament(out, *arguments)
    (teams / "alpha.py").write_text(HOVER + "# changed\n")
    with pytest.raises(InputError, match="team alpha: its submission has changed"):
        open_tournament(out, teams)
    (teams / "late.py").write_text(HOVER)
    with pytest.raises(InputError, match="the teams"):
        open_tournament(out, teams)
    open_tournament(out, None).close()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["{teams}", "--levels", "level9"], "no such level file"),
        (["{teams}", "--levels", "{tmp}/none.yaml"], "no such level file"),
        (["{teams}", "--levels", "level0,level0"], "two levels are called level0"),
        (["{teams}", "--levels", "lsy/level9"], "no such level file"),
        (["{teams}", "--levels", "lsy/level2"], "none of the levels is of its contract"),
        (["{teams}", "--levels", ","], "no level given"),
        (["{tmp}/nowhere"], "no such file or folder"),
        (["{teams}", "--rules", "mine.yaml"], "no such file"),
        (["{teams}", "--compute", "fast"], "write measured, free or fixed"),
        (["{teams}", "--patience", "0"], "need 0.05 to 600 s"),
        ([], "no tournament here to go on with"),
        (["{teams}", "--out", "{tmp}/teams"], "holds something else"),
        (["{teams}", "--out", "{tmp}/teams/alpha.py/x"], "cannot make this folder"),
    ],
)
def test_bad_input_is_told_before_anything_flies(tmp_path, teams, arguments, words):
    filled = [a.format(tmp=tmp_path, teams=teams) for a in arguments]
    if "--out" not in filled:
        filled += ["--out", str(tmp_path / "out")]
    done = command(*filled)
    assert done.exit_code == 2, done.output
    assert words in " ".join(done.output.split())
    assert not (tmp_path / "out" / JOURNAL).exists()


def test_two_teams_of_one_name(tmp_path, teams):
    file = tmp_path / "teams.csv"
    file.write_text("team,path\nA,teams/alpha.py\na,teams/bravo.py\n")
    done = command(file, "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert "two teams are called 'a' (teams/alpha.py and teams/bravo.py)" in done.output


def test_a_scheduler_that_does_not_answer(tmp_path, teams, level):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    out = tmp_path / "out"
    done = command(teams, "--levels", level, "--out", out, "--scheduler", f"tcp://127.0.0.1:{port}")
    assert done.exit_code == 2
    assert f"--scheduler tcp://127.0.0.1:{port}: nobody answers" in done.output
    assert "dask scheduler" in done.output
    # The plan stands; another scheduler, or none, goes on with it.
    assert read_plan(out).teams
    done = command(teams, "--out", out, "--scheduler", "nonsense://x")
    assert done.exit_code == 2
    assert "nobody answers" in done.output


def test_no_room_for_the_recordings_is_told_first(tmp_path, teams, level, monkeypatch):
    import shutil

    usage = shutil.disk_usage(tmp_path)._replace(free=10_000_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    tournament = open_tournament(tmp_path / "out", teams, [level], {"seeds": 20})
    with pytest.raises(InputError, match=r"recordings will take about 0\.\d GB.*--no-record"):
        tournament.fly(lambda: pytest.fail("no cluster is needed for that"))
    tournament.close()


class Fake:
    """An engine that flies nothing but hands over what it is told to."""

    def __init__(self, flown: dict[str, Flown], failed: tuple[tuple[Order, str], ...] = ()):
        self.failed = list(failed)
        self.dashboard = None
        self._flown = flown

    def __enter__(self) -> Fake:
        return self

    def __exit__(self, *exc: object) -> None: ...

    def run(self, orders, archives, on_flown, tick=lambda: None):
        for order in orders:
            if order.key in self._flown:
                on_flown(order, self._flown[order.key], identities())


def block(team: str, data: bytes = b"recording") -> Flown:
    return Flown([made_up.line(team, "short", k) for k in (0, 1)], dict.fromkeys((0, 1), data), 1.0)


def test_a_disk_that_fills_in_the_middle_loses_nothing(tmp_path, teams, level, monkeypatch):
    from crazyarena.runner.tournament import journal, run

    tournament = open_tournament(tmp_path / "out", teams, [level], {"seeds": 2})
    flown = {f"{team}/short/0": block(team) for team in ("alpha", "bravo", "broken")}
    write, write_whole = journal.os_write, run.write_whole
    error = OSError(28, "No space left on device")

    def full(file, data):
        if b'"bravo/short/1"' in data:
            os.write(file, data[: len(data) // 2])
            raise error
        write(file, data)

    def full_for(path, data):
        if tournament.journal.episodes.get("alpha/short/0"):
            raise StorageError.of(path, error) from error
        write_whole(path, data)

    monkeypatch.setattr(journal, "os_write", full)
    monkeypatch.setattr(run, "write_whole", full_for)
    with pytest.raises(CrazyarenaError, match=r"No space left on device.*are safe; make room"):
        tournament.fly(lambda: Fake(flown))  # type: ignore[arg-type,return-value]
    tournament.close()
    monkeypatch.undo()
    again = open_tournament(tmp_path / "out", None)
    assert "alpha/short/1" in again.journal.episodes
    assert "bravo/short/0" not in again.journal.episodes
    assert not list((tmp_path / "out").rglob("*.new"))
    assert [order.team for order in again.missing()] == ["bravo", "broken"]
    assert again.fly(lambda: Fake(flown)) == []  # type: ignore[arg-type,return-value]
    again.close()


def test_a_block_that_comes_back_twice_counts_once(tmp_path, teams, level):
    tournament = open_tournament(tmp_path / "out", teams, [level], {"seeds": 2})
    flown = {f"{team}/short/0": block(team) for team in ("alpha", "bravo", "broken")}
    tournament.fly(lambda: Fake(flown))  # type: ignore[arg-type,return-value]
    size = (tmp_path / "out" / JOURNAL).stat().st_size
    order = next(tournament.plan.orders())
    tournament._keep(order, flown[order.key], identities())
    assert (tmp_path / "out" / JOURNAL).stat().st_size == size
    tournament.close()


# Workers


def made_order(tmp_path: Path) -> tuple[Order, Path]:
    teams = tmp_path / "one"
    teams.mkdir()
    (teams / "alpha.py").write_text(HOVER)
    tournament = open_tournament(tmp_path / "out", teams, ["level0"], {"seeds": 1})
    tournament.close()
    return next(tournament.plan.orders()), tmp_path / "out" / "submissions"


def test_a_worker_of_another_version_is_given_nothing(tmp_path):
    order, archives = made_order(tmp_path)
    for name, found in (("numpy", "1.0"), ("sources", "0" * 64), ("crazyarena", "9.9.9")):
        wanted = worker.identity()
        wanted["versions"] = {**wanted["versions"], name: found}
        answer = worker.work(order, wanted, str(archives))
        assert answer.flown is None
        assert answer.unfit is not None
        assert answer.unfit.startswith(f"{name}: it has ")
    other = {**worker.identity(), "machine": "sparc"}
    assert "processor" in str(worker.work(order, other, str(archives)).unfit)


def test_a_worker_without_walls_is_given_nothing(tmp_path, monkeypatch):
    order, archives = made_order(tmp_path)

    def no_walls(order, submission):
        raise NoWalls("this machine does not shut off files")

    monkeypatch.setattr(worker, "fly", no_walls)
    monkeypatch.setattr(worker, "_kept", lambda: tmp_path / "kept")
    answer = worker.work(order, worker.identity(), str(archives))
    assert answer.unfit == "this machine does not shut off files"


def test_a_worker_far_away_asks_for_the_archive(tmp_path, monkeypatch):
    order, archives = made_order(tmp_path)
    monkeypatch.setattr(worker, "fly", lambda order, submission: submission)
    monkeypatch.setattr(worker, "_kept", lambda: tmp_path / "kept")
    assert worker.work(order, worker.identity(), None).lacks
    assert worker.work(order, worker.identity(), str(tmp_path / "not here")).lacks
    data = (archives / f"{order.archive}.tar").read_bytes()
    flown: Any = worker.work(order, worker.identity(), None, data).flown
    assert flown.read_text() == HOVER
    assert not worker.work(order, worker.identity(), None).lacks


def test_all_workers_unfit_is_told(tmp_path, monkeypatch):
    order, archives = made_order(tmp_path)
    from crazyarena.runner.tournament import engine

    wrong = worker.identity()
    wrong["versions"] = {**wrong["versions"], "numpy": "1.0"}
    monkeypatch.setattr(engine, "identity", lambda: wrong)
    said: list[str] = []
    with (
        Engine(workers=1, say=said.append) as cluster,
        pytest.raises(
            InputError, match=r"no worker is fit to fly: numpy: it has .* organiser 1\.0"
        ),
    ):
        cluster.run([order], archives, lambda *arguments: pytest.fail("nothing may fly"))
    assert len(said) == 1


@pytest.mark.parametrize(
    ("cores", "asked", "count", "pins"),
    [
        ([0, 1], None, 1, [[0, 1]]),
        ([0, 1, 2, 3, 7], None, 2, [[0, 1], [2, 3]]),
        ([0], None, 1, []),
        ([0, 1], 2, 2, []),
    ],
)
def test_measured_thinking_gets_two_processors_or_is_not_comparable(
    monkeypatch, cores, asked, count, pins
):
    from crazyarena.runner.tournament import engine

    monkeypatch.setattr(engine.os, "sched_getaffinity", lambda pid: set(cores))
    cluster = Engine(workers=asked, measured=True)
    assert cluster._count == count
    assert list(cluster._pins.values()) == pins
    assert not Engine(workers=asked)._pins


def test_a_worker_and_its_contestants_stay_on_their_processors(tmp_path):
    order, archives = made_order(tmp_path)
    code = """
import os, pickle, sys
from crazyarena.runner.tournament import worker
order, archives, core = pickle.loads(bytes.fromhex(sys.argv[1]))
wanted = {**worker.identity(), "pins": {"": [core]}}
seen = []
worker._kept = lambda: __import__("pathlib").Path(archives) / "kept"
worker.fly = lambda order, place: seen.append(__import__("subprocess").check_output(
    [sys.executable, "-c", "import os; print(sorted(os.sched_getaffinity(0)))"], text=True).strip())
answer = worker.work(order, wanted, archives)
print(answer.worker["cores"], answer.worker["pinned"], *seen)
"""
    import pickle

    core = max(os.sched_getaffinity(0))
    packed = pickle.dumps((order, str(archives), core)).hex()
    done = subprocess.run(
        [sys.executable, "-c", code, packed], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == f"[{core}] True [{core}]"


# On a cluster of its own


@contextmanager
def dask(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    environ = {**os.environ, "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "20s"}
    process = subprocess.Popen(
        [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:]],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environ,
        start_new_session=True,
    )  # fmt: skip
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


@contextmanager
def scheduler() -> Iterator[tuple[str, subprocess.Popen[str]]]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    with dask(
        "dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"
    ) as process:
        yield address, process


def one_worker(address: str, folder: Path) -> Any:
    folder.mkdir(exist_ok=True)
    return dask(
        "dask_worker", address, "--nthreads", "1", "--no-dashboard", "--no-nanny",
        "--local-directory", str(folder), "--host", "127.0.0.1",
    )  # fmt: skip


@pytest.mark.slow
def test_three_workers_one_killed_and_the_organiser_killed_come_to_the_same(tmp_path, teams):
    """As the local run but for times, whoever was killed on the way."""
    levels, seeds = "level0,level3", "6"
    local, spread = tmp_path / "local", tmp_path / "spread"
    whole = [sys.executable, "-m", "crazyarena", "tournament", str(teams)]
    whole += ["--levels", levels, "--seeds", seeds]
    rules = tmp_path / "rules.yaml"
    # A controller an episode, so that there are many blocks.
    rules.write_text("name: ours\ncategories: [{name: time, points: [1]}]\n")
    whole += ["--rules", str(rules)]
    subprocess.run([*whole, "--out", str(local)], check=True, capture_output=True)
    # The same draws: the plan is the local one's.
    spread.mkdir()
    for name in (PLAN, "draws", "submissions"):
        subprocess.run(["cp", "-a", str(local / name), str(spread / name)], check=True)

    def count() -> int:
        file = spread / JOURNAL
        return file.read_bytes().count(b"\n") if file.exists() else 0

    with scheduler() as (address, _):
        go = [sys.executable, "-m", "crazyarena", "tournament", "--out", str(spread)]
        go += ["--scheduler", address]
        with (
            one_worker(address, tmp_path / "w1") as victim,
            one_worker(address, tmp_path / "w2"),
            one_worker(address, tmp_path / "w3"),
        ):
            organiser = subprocess.Popen(go, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
            try:
                broken = 2 * int(seeds)  # known before anything flies
                eventually(lambda: count() > broken + 4, 200)
                victim.send_signal(signal.SIGKILL)
                after = count()
                eventually(lambda: count() > after + 4, 200)
            finally:
                organiser.send_signal(signal.SIGKILL)
                organiser.communicate()
            interrupted = count()
            assert interrupted < 4 * 2 * int(seeds), "it was killed too late to tell"
            done = subprocess.run(go, capture_output=True, text=True)
            assert done.returncode == 0, done.stdout + done.stderr
            assert f"{interrupted} episodes were there already" in done.stdout
    one, other = but_for_times(local), but_for_times(spread)
    assert len(one) == 4 * 2 * int(seeds)
    assert one == other
    for file in (local / "recordings").rglob("*.mcap"):
        twin = spread / file.relative_to(local)
        assert twin.read_bytes() == file.read_bytes()


@pytest.mark.slow
def test_a_scheduler_that_dies_in_the_middle(tmp_path, teams, level):
    tournament = open_tournament(tmp_path / "out", teams, [level], {"seeds": 2})
    with scheduler() as (address, process), one_worker(address, tmp_path / "w1"):
        with Engine(address) as cluster:
            kept: list[Order] = []

            def take(order: Order, flown: Flown, who: Any) -> None:
                kept.append(order)
                os.killpg(process.pid, signal.SIGKILL)

            with pytest.raises(SchedulerLost, match="What was flown is safe"):
                cluster.run(tournament.missing(), tmp_path / "out" / "submissions", take)
        assert len(kept) == 1
    tournament.close()


@pytest.mark.slow
def test_a_worker_that_dies_is_replaced_and_its_block_flown_again(tmp_path, teams, level):
    import psutil

    tournament = open_tournament(tmp_path / "out", teams, [level], {"seeds": 2})
    killed: list[int] = []

    def kill(lines: Any) -> None:
        if not killed:
            for child in psutil.Process().children(recursive=True):
                words = " ".join(child.cmdline())
                parents = [p.pid for p in child.parents()]
                if "spawn_main" in words and os.getpid() in parents[:1]:
                    killed.append(child.pid)
            os.kill(killed[0], signal.SIGKILL)

    failed = tournament.fly(lambda: Engine(workers=1), kill)
    tournament.close()
    assert killed
    assert not failed
    assert len(but_for_times(tmp_path / "out")) == 8
