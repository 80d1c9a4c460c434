"""What a flight shows of itself: newest value wins, nothing torn, nothing left behind."""

from __future__ import annotations

import mmap
import os
import struct
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.errors import InputError
from crazyarena.live import (
    COLUMNS,
    ID,
    MOST_VEHICLES,
    POSITION,
    Live,
    Watched,
    live_flights,
    live_folder,
)
from crazyarena.slot import HEAD, Slot


@pytest.fixture
def slot():
    return Slot(mmap.mmap(-1, HEAD + 64), 0, 64)


def test_the_newest_value_wins(slot):
    assert slot.get() is None
    for value in (b"one", b"", b"three"):
        slot.put(value)
    assert slot.get() == b"three"
    assert slot.version == 3


@given(st.lists(st.binary(max_size=64), min_size=1))
def test_what_was_put_last_is_there(values):
    slot = Slot(mmap.mmap(-1, HEAD + 64), 0, 64)
    for value in values:
        slot.put(value)
    assert slot.get() == values[-1]


def test_too_long_a_value_is_refused_and_harms_nothing(slot):
    slot.put(b"good")
    with pytest.raises(InputError, match="at most 64 fit"):
        slot.put(bytes(65))
    assert slot.get() == b"good"


def test_a_torn_value_is_no_value(slot):
    slot.put(b"good")
    slot._memory[HEAD] ^= 1
    assert slot.get() is None


def test_after_a_writer_that_died_while_it_wrote_the_next_value_is_whole(slot):
    slot.put(b"good")
    struct.pack_into("<Q", slot._memory, 0, 3)  # odd: being written
    assert slot.get() is None
    slot.put(b"next")
    assert slot.get() == b"next"


_WRITER = """
import sys, mmap, os
from crazyarena.slot import Slot
memory = mmap.mmap(os.open(sys.argv[1], os.O_RDWR), 0)
slot = Slot(memory, 0, 60000)
print(flush=True)
value = 0
while os.getppid() == int(sys.argv[2]):
    value = (value + 1) % 256
    slot.put(bytes([value]) * (30000 + 100 * value))
"""


def test_no_torn_value_is_read_from_a_busy_writer_in_another_process(tmp_path):
    file = tmp_path / "slot"
    file.write_bytes(bytes(HEAD + 60000))
    writer = subprocess.Popen(
        [sys.executable, "-c", _WRITER, file, str(os.getpid())], stdout=subprocess.PIPE
    )
    try:
        writer.stdout.readline()
        slot = Slot(mmap.mmap(os.open(file, os.O_RDWR), 0), 0, 60000)
        seen = set()
        while len(seen) < 20:
            value = slot.get()
            if value is not None:
                assert value == value[:1] * (30000 + 100 * value[0])
                seen.add(value[0])
    finally:
        writer.kill()
        writer.wait()
        writer.stdout.close()


@pytest.fixture
def live(tmp_path):
    live = Live(2, tmp_path)
    yield live
    live.close()


def test_a_viewer_sees_scene_state_and_paths(live):
    watched = Watched(live.file)
    assert watched.state() is None
    assert watched.scene() == {}
    assert watched.paths()[0].shape == (2, 0, 3)
    live.scene({"title": "level3"})
    live.rows[:, POSITION : POSITION + 3] = [[1, 2, 3], [4, 5, 6]]
    live.begin()
    live.extend()
    live.publish({"time": 0.5, "phase": "run"})
    assert watched.scene() == {"title": "level3"}
    state = watched.state()
    assert state.facts == {"time": 0.5, "phase": "run"}
    np.testing.assert_array_equal(state.rows[:, POSITION], [1, 4])
    np.testing.assert_array_equal(state.rows[:, ID], [1, 2])
    np.testing.assert_array_equal(watched.paths()[0][1], [[4, 5, 6]])
    live.begin()
    assert watched.paths()[0].shape == (2, 0, 3)


def test_the_newest_points_of_a_long_path_are_kept_in_order(tmp_path):
    live = Live(MOST_VEHICLES, tmp_path)
    watched = Watched(live.file)
    length = 65536 // MOST_VEHICLES
    for k in range(length + 10):
        live.extend(np.full((MOST_VEHICLES, 3), float(k)))
    points, count = watched.paths()
    assert count == length + 10
    path = points[0, :, 0]
    np.testing.assert_array_equal(path, np.arange(10, length + 10))
    live.close()


def test_a_viewer_answers(live):
    assert live.reply() == {}
    Watched(live.file).reply({"browsers": 2})
    assert live.reply() == {"browsers": 2}


def test_facts_that_do_not_fit_leave_the_vehicles_visible(live):
    live.publish({"time": 1.0, "phase": "run", "text": "x" * (1 << 20)})
    state = Watched(live.file).state()
    assert state.facts == {"time": 1.0, "phase": "run"}
    assert state.rows.shape == (2, COLUMNS)


def test_a_flight_that_has_ended_is_over_and_keeps_its_last_state(tmp_path):
    live = Live(1, tmp_path)
    live.publish({"time": 1.0})
    watched = Watched(live.file)
    assert not watched.over
    live.close()
    assert watched.over
    assert watched.state().facts == {"time": 1.0}
    assert list(tmp_path.iterdir()) == []
    live.close()


def test_a_killed_flight_is_over_and_its_remains_go(tmp_path):
    code = (
        "import sys, os; from crazyarena.live import Live; from pathlib import Path;"
        "live = Live(1, Path(sys.argv[1])); print(live.file, flush=True); sys.stdin.read()"
    )
    flight = subprocess.Popen(
        [sys.executable, "-c", code, tmp_path],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with flight:
        file = flight.stdout.readline().strip()
        watched = Watched(tmp_path / file)
        assert [str(f) for f in live_flights(tmp_path)] == [file]
        assert not watched.over
        flight.kill()
        flight.wait()
    assert watched.over
    assert live_flights(tmp_path) == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "content", [b"", b"x", b"CRAZYLV1", b"CRAZYLV1" + bytes(1000), b"CRAZYLV1" + b"\xff" * 1000]
)
def test_what_is_no_live_flight_is_refused(tmp_path, content):
    file = tmp_path / "x.live"
    file.write_bytes(content)
    with pytest.raises(InputError, match="no live flight"):
        Watched(file)
    with pytest.raises(InputError, match="no live flight"):
        Watched(tmp_path / "none")


@pytest.mark.parametrize("vehicles", [0, MOST_VEHICLES + 1])
def test_too_many_vehicles_are_refused(tmp_path, vehicles):
    with pytest.raises(InputError, match="it shows 1 to"):
        Live(vehicles, tmp_path)


def test_the_folder_is_the_users_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("CRAZYARENA_RUNTIME_DIR", str(tmp_path))
    folder = live_folder()
    assert folder.parent == tmp_path
    folder.chmod(0o777)
    assert live_folder().stat().st_mode & 0o777 == 0o700
    folder.rmdir()
    folder.write_text("")
    with pytest.raises(InputError, match=r"is no folder|File exists"):
        live_folder()
