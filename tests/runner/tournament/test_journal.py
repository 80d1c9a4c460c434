"""What was flown is never lost, and nothing half written is believed."""

from __future__ import annotations

import errno
import json
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.errors import InputError
from crazyarena.runner.tournament import journal as module
from crazyarena.runner.tournament.journal import JOURNAL, Journal, StorageFull
from tests.runner.tournament.made_up import line


def lines(count):
    return [line("a", "level0", k) for k in range(count)]


@given(st.integers(0, 5), st.integers(0, 3000))
def test_cut_anywhere_it_keeps_whole_lines(tmp_path_factory, count, cut):
    out = tmp_path_factory.mktemp("journal")
    journal = Journal(out)
    journal.append(lines(count))
    journal.close()
    data = (out / JOURNAL).read_bytes()
    cut = min(cut, len(data))
    (out / JOURNAL).write_bytes(data[:cut])
    whole = data[:cut].count(b"\n")
    again = Journal(out)
    assert len(again.episodes) == whole
    assert again.dropped == cut - (data[:cut].rfind(b"\n") + 1)
    # What is written now does not go on in the middle of a line.
    again.append([line("b", "level0", 0)])
    again.close()
    last = Journal(out)
    assert len(last.episodes) == whole + 1
    last.close()


def test_it_is_on_disk_when_append_returns(tmp_path, monkeypatch):
    synced = []
    fsync = os.fsync
    monkeypatch.setattr(module.os, "fsync", lambda file: (fsync(file), synced.append(file)))
    journal = Journal(tmp_path)
    journal.append(lines(2))
    assert len(synced) == 1
    assert (tmp_path / JOURNAL).read_bytes().count(b"\n") == 2
    journal.close()


def test_a_full_disk_takes_nothing_away(tmp_path, monkeypatch):
    journal = Journal(tmp_path)
    journal.append(lines(3))
    write = os.write

    def half(file, data):
        if len(data) > 10:
            write(file, bytes(data[:10]))
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(module.os, "write", half)
    with pytest.raises(StorageFull, match=r"No space left.*3 episodes are safe.*same --out"):
        journal.append([line("b", "level0", 0)])
    monkeypatch.undo()
    journal.append([line("c", "level0", 0)])
    journal.close()
    again = Journal(tmp_path)
    assert list(again.episodes) == ["a/level0/0", "a/level0/1", "a/level0/2", "c/level0/0"]
    assert not again.dropped
    again.close()


def test_a_file_size_limit_is_a_full_disk(tmp_path):
    """The real thing, in a process of its own: the system refuses to make the file larger."""
    import subprocess
    import sys

    code = """
import resource, signal, sys
from pathlib import Path
from crazyarena.runner.tournament.journal import Journal, StorageFull
from tests.runner.tournament.made_up import line
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
journal = Journal(Path(sys.argv[1]))
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))
for k in range(100):
    try:
        journal.append([line("a", "level0", k)])
    except StorageFull as error:
        print(len(journal.episodes), error)
        break
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True
    )
    kept = int(done.stdout.split()[0])
    assert "File too large" in done.stdout
    journal = Journal(tmp_path)
    assert len(journal.episodes) == kept > 2
    assert journal.dropped == 0
    journal.close()


def test_a_damaged_line_is_named(tmp_path):
    good = json.dumps(line("a", "level0", 0))
    (tmp_path / JOURNAL).write_text(f"{good}\nnonsense\n{good}\n")
    with pytest.raises(InputError, match=r"episodes\.jsonl:2: not a line of a journal"):
        Journal(tmp_path)


def test_two_organisers_do_not_share_a_folder(tmp_path):
    journal = Journal(tmp_path)
    with pytest.raises(InputError, match="another tournament is being flown into this folder"):
        Journal(tmp_path)
    journal.close()
    Journal(tmp_path).close()
