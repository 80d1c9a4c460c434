"""The folder of a run: for one run alone, with a result that can be read at any moment."""

import json
import os
import resource

import pytest

from crazyarena.errors import InputError, StorageError
from crazyarena.runner.records import run_folder as folders
from crazyarena.runner.records.run_folder import ResultFile, run_folder

BEGINNING = {"format": 1, "finished": False, "episodes": []}


def test_a_new_folder_each_time(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = [run_folder(None, tmp_path / "pilot.py", "level0") for _ in range(3)]
    assert len(set(made)) == 3
    assert all(folder.is_dir() and folder.parent == tmp_path / "runs" for folder in made)


@pytest.mark.parametrize(
    "trace", ["result.json", "episode_000.mcap", "episode_004.mcap.part", "compare.json", "dry_00/"]
)
def test_an_older_run_is_not_mixed_with(tmp_path, trace):
    older = tmp_path / trace
    older.parent.mkdir(exist_ok=True)
    if trace.endswith("/"):
        older.mkdir()
    else:
        older.write_bytes(b"")
    with pytest.raises(InputError, match=rf"holds an older run \({older.name}\)"):
        run_folder(tmp_path, tmp_path / "pilot.py", "level0")


def test_a_folder_may_hold_other_files(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    assert run_folder(tmp_path, tmp_path / "pilot.py", "level0") == tmp_path


def test_the_result_is_whole_after_every_episode(tmp_path):
    results = ResultFile(tmp_path, BEGINNING)
    assert json.loads(results.path.read_text()) == BEGINNING
    episodes = []
    for index in range(3):
        episodes.append({"index": index, "error": "a \x1b[31m word"})
        results.add(episodes[-1], {**BEGINNING, "clean": False, "episodes": episodes})
        document = json.loads(results.path.read_text())
        assert [e["index"] for e in document["episodes"]] == list(range(index + 1))
        assert document["clean"] is False
        assert "\x1b" not in results.path.read_text()
    results.finish({**BEGINNING, "finished": True, "episodes": episodes})
    assert json.loads(results.path.read_text())["finished"] is True
    assert [p.name for p in tmp_path.iterdir()] == ["result.json"]


def test_two_runs_at_once_do_not_get_the_same_folder(tmp_path):
    first = ResultFile(tmp_path, BEGINNING)
    with pytest.raises(InputError, match="another run writes here"):
        ResultFile(tmp_path, BEGINNING)
    first.discard()
    assert list(tmp_path.iterdir()) == []


def test_the_result_of_a_full_disk_takes_the_reserve(tmp_path, monkeypatch):
    results = ResultFile(tmp_path, BEGINNING)
    reserve = results._reserve
    assert os.fstat(reserve.fileno()).st_size == 256 * 1024
    write = folders.write_whole

    def full(path, text):
        if not reserve.closed:
            raise StorageError(f"{path}: no space")
        write(path, text)

    monkeypatch.setattr(folders, "write_whole", full)
    results.add({"index": 0}, BEGINNING)
    assert json.loads(results.path.read_text())["episodes"] == [{"index": 0}]


def test_a_result_that_cannot_be_written_leaves_the_one_before(tmp_path):
    results = ResultFile(tmp_path, BEGINNING)
    results.add({"index": 0}, BEGINNING)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (512, before[1]))
    try:
        with pytest.raises(StorageError, match=r"result\.json: cannot write it: File too large"):
            results.add({"index": 1, "error": "x" * 1000}, BEGINNING)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert json.loads(results.path.read_text())["episodes"] == [{"index": 0}]
