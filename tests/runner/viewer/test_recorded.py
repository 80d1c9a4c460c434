"""Recordings as a replay reads them, whole, cut short and spoilt."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.errors import InputError
from crazyarena.runner.viewer.recorded import MOST_FLIGHTS, flights, read_flight
from crazyarena.runner.viewer.replay import flight_at, speed_colours, told_at
from tests.runner.viewer.flights import circle


def test_a_flight_comes_with_its_arena_and_track(tmp_path):
    flight = read_flight(circle(tmp_path / "episode_000.mcap"))
    assert flight.complete
    assert flight.scene["title"] == "level1"
    assert {e["id"] for e in flight.scene["track"]} >= {"gate 0", "obstacle 0", "goal"}
    assert len(flight.scene["nominal"]) == len(flight.scene["track"]) - 1
    assert flight.scene["arena"]["low"][2] == pytest.approx(-0.1)
    place, turn, setpoint = flight_at(flight, 1.0)
    np.testing.assert_allclose(place, [0.0, 1.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(setpoint - place, [0.0, 0.0, 0.1], atol=1e-9)
    np.testing.assert_array_equal(turn, [0, 0, 0, 1])


def test_before_and_after_a_flight_it_stands_where_it_began_and_ended(tmp_path):
    flight = read_flight(circle(tmp_path / "a.mcap", seconds=2.0))
    np.testing.assert_array_equal(flight_at(flight, -5.0)[0], flight.position[0])
    np.testing.assert_array_equal(flight_at(flight, 99.0)[0], flight.position[-1])


@pytest.mark.parametrize("share", [0.5, 0.7, 0.9, 0.999])
def test_a_recording_that_was_cut_short_is_shown_as_far_as_it_goes(tmp_path, share):
    whole = circle(tmp_path / "whole.mcap").read_bytes()
    # As a killed flight leaves it: messages without a chunk around them.
    part = tmp_path / "episode_000.mcap.part"
    part.write_bytes(_unchunked(whole, share))
    flight = read_flight(part)
    assert not flight.complete
    assert 0 < len(flight.time) <= 401
    assert flight.name == "episode_000"


def _unchunked(whole: bytes, share: float) -> bytes:
    """The records of the file's chunk as they stand, up to a share of the bytes."""
    from io import BytesIO

    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    reader = StreamReader(BytesIO(whole), emit_chunks=True)
    data = next(record.data for record in reader.records if isinstance(record, Chunk))
    start = whole.index(data)
    head = whole[: start - 49]  # before the chunk's own head
    return head + data[: int(share * len(data))]


def test_a_recording_of_another_time_is_shown_without_its_arena(tmp_path):
    flight = read_flight(circle(tmp_path / "a.mcap", level_file="nonsense: [1"))
    assert "arena" not in flight.scene
    assert flight.fence is None
    assert "to the fence" not in told_at(flight, 1.0)


def test_folders_of_folders_are_read_and_names_differ(tmp_path):
    for run in ("one", "two"):
        (tmp_path / run).mkdir()
        circle(tmp_path / run / "episode_000.mcap")
    found = flights([tmp_path])
    assert [flight.name for flight in found] == ["one/episode_000", "two/episode_000"]


def test_bad_runs_are_refused_by_name(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        flights([tmp_path / "none"])
    with pytest.raises(InputError, match="no recordings"):
        flights([tmp_path])
    text = tmp_path / "text.mcap"
    text.write_text("hello")
    with pytest.raises(InputError, match=r"text\.mcap: not an MCAP"):
        flights([text])


def test_too_many_flights_are_refused(tmp_path):
    for k in range(MOST_FLIGHTS + 1):
        (tmp_path / f"{k}.mcap").write_text("")
    with pytest.raises(InputError, match="Name some of them"):
        flights([tmp_path])


def test_what_a_recording_says_is_told_as_text(tmp_path):
    flight = read_flight(circle(tmp_path / "a.mcap"))
    told = told_at(flight, 4.0)
    assert "<script" not in told
    assert "&lt;script&gt;" in told
    assert "gate passed" in told
    assert "gate passed" not in told_at(flight, 0.9)


def test_faster_is_another_colour():
    shades = speed_colours(np.array([0.0, 1.0, 2.0, np.nan]))
    assert len({tuple(shade) for shade in shades[:3].tolist()}) == 3
    assert speed_colours(np.zeros(2)).shape == (2, 3)
