"""A contestant's folder: bounded, locked while its runner lives, and removed after that."""

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from crazyarena.runner.contestant.sandbox import quota
from crazyarena.runner.contestant.sandbox.box import Box, remove_abandoned
from tests.runner.fakes import controller

LIMIT = 1 << 20


@pytest.fixture
def entry(tmp_path):
    folder = tmp_path / "entry"
    (folder / "data").mkdir(parents=True)
    (folder / "edit_this.py").write_text(controller())
    (folder / "data" / "table.bin").write_bytes(b"x" * 5000)
    return folder


@pytest.fixture(autouse=True)
def own_temporaries(tmp_path, monkeypatch):
    """Other people's folders are not looked at."""
    folder = tmp_path / "temporaries"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def test_the_copy_is_whole_and_measured(entry):
    box = Box(entry, LIMIT)
    try:
        assert (box.submission / "data" / "table.bin").read_bytes() == b"x" * 5000
        size, count = quota.used(str(box.files), LIMIT, 1000)
        assert count <= box.count
        assert size <= box.size <= size + 16 * 4096
    finally:
        box.remove()
    assert not box.root.exists()


def test_a_box_that_is_used_is_never_removed(entry, own_temporaries):
    first, second = Box(entry, LIMIT), Box(entry, LIMIT)
    assert remove_abandoned(own_temporaries, os.stat(first.root).st_mtime + 1e6) == []
    assert first.submission.exists()
    first.remove()
    first.remove()
    assert second.submission.exists()
    second.remove()
    assert list(own_temporaries.iterdir()) == []


def test_what_a_killed_runner_left_goes_at_the_next_start(entry, own_temporaries):
    code = (
        "import sys, time; from pathlib import Path;"
        "from crazyarena.runner.contestant.sandbox.box import Box;"
        "box = Box(Path(sys.argv[1]), 1 << 20); print(box.root, flush=True); time.sleep(100)"
    )
    environment = {**os.environ, "TMPDIR": str(own_temporaries)}
    with subprocess.Popen(
        [sys.executable, "-c", code, str(entry)],
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    ) as runner:
        left = Path(runner.stdout.readline().strip())
        living = Box(entry, LIMIT)
        assert left.exists()
        runner.send_signal(signal.SIGKILL)
        runner.wait()
    assert left.parent == own_temporaries
    locked = left / "files" / "home"
    (locked / "deep").mkdir()
    (locked / "deep" / "file").touch()
    box = Box(entry, LIMIT)
    assert not left.exists()
    assert living.submission.exists()
    box.remove()
    living.remove()


def test_only_old_folders_without_a_lock_and_no_strangers_are_removed(own_temporaries, tmp_path):
    target = tmp_path / "precious"
    target.mkdir()
    (target / "file").touch()
    (own_temporaries / "crazyarena-contestant-link").symlink_to(target)
    (own_temporaries / "crazyarena-contestant-file").touch()
    (own_temporaries / "something-else").mkdir()
    young = own_temporaries / "crazyarena-contestant-young"
    young.mkdir()
    now = young.stat().st_mtime
    assert remove_abandoned(own_temporaries, now + 60.0) == []
    assert remove_abandoned(own_temporaries, now + 7200.0) == [young]
    assert (target / "file").exists()
    assert len(list(own_temporaries.iterdir())) == 3


def test_a_tree_of_any_depth_is_counted_and_removed(entry):
    box = Box(entry, LIMIT)
    here = os.getcwd()
    try:
        os.chdir(box.work)
        for _ in range(3000):
            os.mkdir("d")
            os.chdir("d")
        Path("deepest").touch()
    finally:
        os.chdir(here)
    assert quota.used(str(box.files), 1 << 30, 100_000)[1] > 100_000
    (box.home / "locked" / "in").mkdir(parents=True)
    (box.home / "locked").chmod(0o000)
    box.remove()
    assert not box.root.exists()


def test_use_is_counted_up_to_the_limits(tmp_path):
    folder = tmp_path / "folder"
    (folder / "a" / "b").mkdir(parents=True)
    for k in range(20):
        (folder / "a" / "b" / str(k)).write_bytes(b"x" * 8192)
    (folder / "link").symlink_to("/usr")
    size, count = quota.used(str(folder), 1 << 30, 1000)
    assert count == 23
    assert 20 * 8192 <= size <= 20 * 8192 + 6 * 4096
    assert quota.words(size, count, 1 << 30, 1000) is None
    assert "files" in quota.words(*quota.used(str(folder), 1 << 30, 10), 1 << 30, 10)
    assert "0 MiB of disk" in quota.words(*quota.used(str(folder), 30000, 99), 30000, 99)
    sparse = folder / "sparse"
    with open(sparse, "wb") as stream:
        stream.truncate(1 << 30)
    assert quota.used(str(folder), 1 << 30, 1000)[0] < 1 << 20


def watch(folder, most_bytes, most_files, pid):
    return subprocess.Popen(
        [sys.executable, "-I", "-S", quota.__file__, folder, str(most_bytes), str(most_files)]
        + [str(pid)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def test_the_watch_ends_who_uses_too_much(tmp_path):
    (tmp_path / "big").write_bytes(b"x" * 300_000)
    with subprocess.Popen(["sleep", "100"]) as culprit:
        with watch(tmp_path, 200_000, 100, culprit.pid) as guard:
            assert guard.wait(timeout=30) == quota.EXCEEDED
            assert "of disk" in guard.stdout.read()
        assert culprit.wait() == -signal.SIGKILL


def test_the_watch_ends_with_its_owner(tmp_path):
    with watch(tmp_path, 1 << 30, 100, os.getpid()) as guard:
        guard.stdin.close()
        assert guard.wait(timeout=30) == 0
