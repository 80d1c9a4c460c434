"""The beginning of a recording: on disk soon, and never waited for."""

import errno
import os
import select
from pathlib import Path

import pytest

from crazyarena.runner.records.part_file import PartFile
from tests.waiting import eventually


def test_everything_arrives_in_order(tmp_path):
    part = PartFile(tmp_path / "a.part", b"")
    for k in range(100):
        part.append([bytes([k]), memoryview(bytes([k, k]))])
    part.close()
    part.close()
    assert part.path.read_bytes() == b"".join(bytes([k] * 3) for k in range(100))


def test_on_disk_before_it_is_closed(tmp_path):
    part = PartFile(tmp_path / "a.part", b"the ")
    assert part.path.read_bytes() == b"the "
    part.append([b"flight"])
    eventually(lambda: part.path.read_bytes() == b"the flight")
    part.close()


def test_a_disk_that_takes_nothing_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "slow")
    reader = os.open(tmp_path / "slow", os.O_RDONLY | os.O_NONBLOCK)
    part = PartFile(tmp_path / "slow", b"")
    data = bytes(1 << 20)  # more than a pipe holds
    part.append([data])
    part.append([data])
    read = 0
    while read < 2 * len(data):
        assert select.select([reader], [], [], 20.0)[0]
        read += len(os.read(reader, 1 << 16))
    part.close()
    os.close(reader)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a full disk")
def test_a_full_disk_ends_it_and_nothing_else():
    part = PartFile(Path("/dev/full"), b"")
    part.append([b"flight"])
    part.append([b"on"])
    part.close()
    assert part.trouble is not None
    assert part.trouble.errno == errno.ENOSPC


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a full disk")
def test_a_disk_full_from_the_start_is_told_at_once():
    with pytest.raises(OSError, match="No space left"):
        PartFile(Path("/dev/full"), b"the beginning")


def test_where_no_file_can_be_made_is_told_at_once(tmp_path):
    with pytest.raises(FileNotFoundError):
        PartFile(tmp_path / "none" / "a.part", b"")
