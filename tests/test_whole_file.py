"""Files that are there whole or not at all."""

import errno
import os

import pytest

from crazyarena.errors import StorageError
from crazyarena.whole_file import is_refusal, whole_file, write_whole


def test_it_takes_the_place_of_the_old_one(tmp_path):
    file = tmp_path / "a.json"
    write_whole(file, "old")
    write_whole(file, "new")
    assert file.read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def spoil(file, error):
    with whole_file(file) as stream:
        stream.write(b"half")
        raise error


def test_what_was_there_stays_when_writing_fails(tmp_path):
    file = tmp_path / "a.json"
    write_whole(file, "old")
    with pytest.raises(ValueError, match="a bug"):
        spoil(file, ValueError("a bug"))
    assert file.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_a_refusal_names_the_file(tmp_path):
    file = tmp_path / "a.json"
    write_whole(file, "old")
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.raises(StorageError, match=r"a\.json: cannot write it: No space left"):
        spoil(file, full)
    assert file.read_text() == "old"
    with pytest.raises(StorageError, match="nowhere/b: cannot write it: No such file"):
        write_whole(tmp_path / "nowhere" / "b", "")


def test_devices_are_written_to_and_not_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reading = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_whole(pipe, "text")
        assert os.read(reading, 10) == b"text"
    finally:
        os.close(reading)
    assert pipe.is_fifo()


def test_what_is_told_of_the_disk_and_what_is_a_bug():
    assert is_refusal(OSError(errno.ENOSPC, "full"))
    assert is_refusal(OSError(errno.EROFS, "read-only"))
    assert not is_refusal(OSError(errno.EBADF, "a file that was closed"))
