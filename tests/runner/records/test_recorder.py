"""Recordings: readable by others, complete, the same bytes for the same flight."""

import json

import numpy as np
import pytest
from mcap.reader import make_reader

from crazyarena.clock import VirtualClock
from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.errors import InputError
from crazyarena.runner.contestant.contract_2022.command_check import Asked
from crazyarena.runner.judging import verdict_row
from crazyarena.runner.records import export, validate_flights
from crazyarena.runner.records.recorder import SENT_KINDS, Recorder
from tests.runner.fakes import rows
from tests.waiting import eventually

ASKED = Asked(1, cs.FullState([1, 2, 3], [4, 5, 6], [7, 8, 9], 0.5, [10, 11, 12]))


def fill(recorder: Recorder, steps: int, first: int = 0, clock: VirtualClock | None = None):
    rng = np.random.default_rng(first)
    for k in range(first, first + steps):
        recorder.command(k / 30, ASKED, ASKED.command)
        verdict = rng.random(verdict_row.SIZE)
        verdict[0] = (17 * k + 17) / 500
        if clock is not None:
            clock.sleep_until(k * 0.1)
        recorder.step(rows(rng.random((17, 3)), 17 * k + 1), verdict)


def recorder(file, clock=None) -> Recorder:
    scene = {"deletions": [], "entities": []}
    return Recorder(file, {"level": "level0"}, scene, clock or VirtualClock())


def test_another_reader_reads_all_of_it(tmp_path):
    file = tmp_path / "a.mcap"
    writing = recorder(file)
    fill(writing, 3)
    writing.event(0.05, 25, "gate passed", "gate 0")
    writing.gate(0.06, 2, np.arange(6.0))
    writing.scene(0.06, {"deletions": [], "entities": []})
    writing.close()
    with open(file, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        counts = {
            summary.channels[i].topic: n
            for i, n in summary.statistics.channel_message_counts.items()
        }
        assert counts == {
            "/state": 51,
            "/command": 3,
            "/referee": 3,
            "/pose": 3,
            "/event": 1,
            "/scene": 2,
            "/gate": 1,
        }
        # Through the index, in the order of time, only the second step.
        picked = list(reader.iter_messages(topics=["/state"], starting_at=36_000_000))
        assert [m.log_time for _, _, m in picked] == [2_000_000 * k for k in range(18, 52)]
        state = np.frombuffer(picked[0][2].data[4:], "<f8")
        assert state[0] == 0.036
        (_, _, gate) = next(iter(reader.iter_messages(topics=["/gate"])))
        assert gate.log_time == 60_000_000
        assert np.frombuffer(gate.data[4:], "<f8").tolist() == [0.06, 2.0, 0, 1, 2, 3, 4, 5]
        (_, _, event) = next(iter(reader.iter_messages(topics=["/event"])))
        assert json.loads(event.data)["event"] == "gate passed"
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
        assert metadata["crazyarena"] == {"level": "level0"}
        assert metadata["verbs"]["asked 1"] == "FULLSTATE"


def test_poses_are_ros_poses(tmp_path):
    writing = recorder(tmp_path / "a.mcap")
    fill(writing, 1)
    writing.close()
    with open(tmp_path / "a.mcap", "rb") as stream:
        schema, _, message = next(iter(make_reader(stream).iter_messages(topics=["/pose"])))
    assert schema.name == "geometry_msgs/msg/PoseStamped"
    data = message.data[4:]
    assert np.frombuffer(data[:8], "<u4").tolist() == [0, 34_000_000]
    assert data[8:16] == b"\x04\0\0\0map\0"
    assert np.frombuffer(data[16:], "<f8")[3:].tolist() == [0, 0, 0, 1]


def test_round_trip(tmp_path):
    file = tmp_path / "a.mcap"
    writing = recorder(file)
    fill(writing, 5)
    writing.event(0.05, 25, "gate passed", "gate 0")
    writing.close()
    back = export.read(file)
    assert back.complete
    np.testing.assert_array_equal(back.tables["state"], writing.states)
    command = dict(zip(back.columns["command"], back.tables["command"][0], strict=True))
    assert command["asked"] == 1
    assert SENT_KINDS[int(command["sent"]) - 1] is cs.FullState
    for side in ("asked", "sent"):
        args = [command[f"{side}_args_{i}"] for i in range(13)]
        assert args == [1, 2, 3, 4, 5, 6, 7, 8, 9, 0.5, 10, 11, 12]
    assert back.columns["referee"][verdict_row.VD_REWARD] == "reward"
    assert len(back.columns["referee"]) == verdict_row.SIZE
    assert back.events == [{"time": 0.05, "tick": 25, "event": "gate passed", "detail": "gate 0"}]


def test_same_flight_same_bytes_however_long_it_took(tmp_path):
    for name, clock in (("a", None), ("b", VirtualClock())):
        writing = recorder(tmp_path / name, clock)
        fill(writing, 30, clock=clock)
        writing.close()
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b"]


def test_it_can_be_read_before_anything_happened(tmp_path):
    recorder(tmp_path / "a.mcap")  # never closed: the process was killed at once
    (part,) = export.recordings(tmp_path)
    back = export.read(part)
    assert not back.complete
    assert {name: len(table) for name, table in back.tables.items()} == {
        "state": 0,
        "command": 0,
        "referee": 0,
        "gate": 0,
    }


def test_a_killed_process_loses_at_most_a_second(tmp_path):
    clock = VirtualClock()
    writing = recorder(tmp_path / "a.mcap", clock)
    fill(writing, 35, clock=clock)  # 0.1 s of wall time each; never closed
    (part,) = export.recordings(tmp_path)
    eventually(lambda: len(export.read(part).tables["command"]) >= 25)
    back = export.read(part)
    assert not back.complete
    assert 25 <= len(back.tables["command"]) <= 35
    count = len(back.tables["state"])
    np.testing.assert_array_equal(back.tables["state"], writing.states[:count])
    # Even cut in the middle of a record.
    torn = tmp_path / "torn.mcap.part"
    torn.write_bytes(part.read_bytes()[:-100])
    assert 0 < len(export.read(torn).tables["state"]) <= count


def test_tables(tmp_path):
    writing = recorder(tmp_path / "a.mcap")
    fill(writing, 2)
    writing.event(0.05, 25, "contact", 'a "wall"')
    writing.close()
    back = export.read(tmp_path / "a.mcap")
    files = {p.name for p in export.write_csv(back, tmp_path / "a")}
    assert files == {"a_state.csv", "a_command.csv", "a_referee.csv", "a_event.csv"}
    table = np.genfromtxt(tmp_path / "a_state.csv", delimiter=",", names=True)
    np.testing.assert_array_equal(table["position_0"], writing.states[:, 1])
    (npz,) = export.write_npz(back, tmp_path / "a")
    with np.load(npz) as archive:
        np.testing.assert_array_equal(archive["state"], writing.states)
        assert archive["state_columns"][0] == "time"
        assert json.loads(str(archive["metadata_json"])) == {"level": "level0"}


def test_where_it_cannot_be_written_is_told_before_the_flight(tmp_path):
    with pytest.raises(InputError, match=r"a\.mcap\.part: cannot write.*No such file.*--out"):
        recorder(tmp_path / "none" / "a.mcap")


def test_what_is_no_recording_is_named(tmp_path):
    file = tmp_path / "x.mcap"
    file.write_bytes(b"not a recording")
    with pytest.raises(InputError, match=r"x\.mcap"):
        export.read(file)
    file.unlink()
    with pytest.raises(InputError, match=r"no \.mcap recording"):
        export.recordings(tmp_path)


def test_what_a_vehicle_tells_of_itself_is_read_back(tmp_path):
    file = tmp_path / "a.mcap"
    writing = Recorder(file, {}, {}, VirtualClock(), logs=True)
    fill(writing, 20)
    told = np.random.default_rng(1).random((40, 9))
    told[:, 0] = np.arange(40) / 50.0
    writing.vehicle(told[:15])
    writing.flush()
    writing.vehicle(told[15:])
    writing.close()
    flight = validate_flights.load(file)
    assert np.array_equal(flight.motors.value, told[:, 2:6])
    assert np.array_equal(flight.volts.value, told[:, 1])
    assert np.array_equal(flight.acceleration.value, told[:, 6:9])
    assert np.array_equal(flight.acceleration.time, told[:, 0])
    assert len(flight.attitude) == len(flight.pose)


def test_a_recording_without_such_a_vehicle_has_no_channel_for_it(tmp_path):
    writing = recorder(tmp_path / "a.mcap")
    fill(writing, 3)
    writing.vehicle(np.ones((5, 9)))
    writing.close()
    assert b"/vehicle" not in (tmp_path / "a.mcap").read_bytes()
