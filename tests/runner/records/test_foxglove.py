"""Recordings in Foxglove's message types, held to their schemas by other programs."""

import json
from collections import Counter
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from crazyarena.clock import VirtualClock
from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.runner.cli import make_app
from crazyarena.runner.records.foxglove import TOPICS, write_foxglove
from crazyarena.runner.records.recorder import Recorder
from tests.runner.records.test_pages import record

LAYOUT = Path(__file__).parents[3] / "docs" / "foxglove_layout.json"


@pytest.fixture
def messages(tmp_path):
    record(tmp_path, load_level("level0"))
    out = write_foxglove(tmp_path / "episode_000.mcap", tmp_path / "out.mcap")
    with open(out, "rb") as stream:
        return [
            (schema, channel.topic, message.log_time, json.loads(message.data))
            for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages()
        ]


def test_every_message_keeps_to_the_schema_in_the_file(messages):
    for schema, topic, _, content in messages:
        assert schema.name == TOPICS[topic]
        assert schema.encoding == "jsonschema"
        jsonschema.validate(content, json.loads(schema.data))


def test_the_flight_is_there_a_hundred_times_a_second(messages):
    counts = Counter(topic for _, topic, _, _ in messages)
    assert counts["/tf"] == counts["/drone/pose"] == counts["/drone/numbers"] == 401
    transforms = [(at, c) for _, topic, at, c in messages if topic == "/tf"]
    at, last = transforms[-1]
    assert at == 4_000_000_000
    assert last["translation"] == pytest.approx({"x": 1.0, "y": -2.5, "z": 1.0})
    assert (last["parent_frame_id"], last["child_frame_id"]) == ("map", "drone")
    assert last["timestamp"] == {"sec": 4, "nsec": 0}


def test_track_arena_path_and_drone_are_scenes(messages):
    scenes = {}
    for _, topic, _, content in messages:
        if "entities" in content:
            scenes.setdefault(topic, []).extend(content["entities"])
    assert {"gate 0", "obstacle 0", "goal"} <= {entity["id"] for entity in scenes["/track"]}
    assert len(scenes["/arena"][0]["lines"][0]["points"]) == 24
    assert scenes["/drone/path"][0]["lines"][0]["points"][-1]["x"] == pytest.approx(1.0)
    assert scenes["/drone/model"][0]["frame_id"] == "drone"


def test_events_have_the_level_of_what_they_are(messages):
    told = {c["message"]: c["level"] for _, topic, _, c in messages if topic == "/events"}
    assert told == {"gate passed: gate 0": 2, "contact: gate 0": 4}


def test_the_layout_shows_what_is_written():
    layout = json.loads(LAYOUT.read_text())
    topics = set(layout["configById"]["3D!flight"]["topics"])
    assert topics <= set(TOPICS)
    for panel in layout["configById"].values():
        for path in panel.get("paths", ()):
            assert path["value"].partition(".")[0] in TOPICS
    assert layout["configById"]["RosOut!events"]["topicToRender"] in TOPICS

    def leaves(node):
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])


def test_export_writes_it_beside_the_recording_and_not_of_itself(tmp_path):
    record(tmp_path, load_level("level0"))
    for _ in range(2):
        shown = CliRunner().invoke(make_app("export"), ["export", str(tmp_path), "--foxglove"])
        assert shown.exit_code == 0, shown.output
        assert sorted(file.name for file in tmp_path.iterdir()) == [
            "episode_000.foxglove.mcap", "episode_000.mcap",
        ]  # fmt: skip


def test_a_recording_without_a_flight_is_refused(tmp_path):
    Recorder(tmp_path / "a.mcap", {}, {}, VirtualClock()).close()
    with pytest.raises(InputError, match="holds no flight"):
        write_foxglove(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert not (tmp_path / "b.mcap").exists()


def test_rows_that_are_no_numbers_are_left_out(tmp_path):
    from tests.runner.fakes import rows

    recorder = Recorder(tmp_path / "a.mcap", {}, {}, VirtualClock())
    path = np.zeros((100, 3))
    path[50:] = np.nan
    recorder.step(rows(path, rate=500.0), np.zeros(_verdict_size()))
    recorder.close()
    with open(write_foxglove(tmp_path / "a.mcap", tmp_path / "b.mcap"), "rb") as stream:
        found = [c.topic for _, c, _ in make_reader(stream).iter_messages()]
    assert found.count("/tf") == 11


def _verdict_size():
    from crazyarena.runner.judging import verdict_row

    return verdict_row.SIZE


def test_every_message_is_one_of_foxgloves_own(messages):
    """Read by the classes Foxglove publishes: no field is unknown, none has another type."""
    json_format = pytest.importorskip("google.protobuf.json_format")
    seen = set()
    for schema, _, _, content in messages:
        package, _, name = schema.name.partition(".")
        if package != "foxglove":
            continue
        module = pytest.importorskip(f"foxglove_schemas_protobuf.{name}_pb2")
        json_format.ParseDict(_in_protobuf(content), getattr(module, name)())
        seen.add(schema.name)
    assert seen == {name for name in TOPICS.values() if name.startswith("foxglove.")}


def _in_protobuf(value):
    """A message of the JSON encoding as protobuf's: times and durations are written otherwise."""
    if isinstance(value, list):
        return [_in_protobuf(entry) for entry in value]
    if not isinstance(value, dict):
        return value
    plain = {}
    for name, entry in value.items():
        if isinstance(entry, dict) and set(entry) == {"sec", "nsec"}:
            moment = np.datetime64(entry["sec"] * 10**9 + entry["nsec"], "ns")
            lasting = f"{entry['sec']}.{entry['nsec']:09d}s"
            plain[name] = lasting if name == "lifetime" else f"{moment}Z"
        else:
            plain[name] = _in_protobuf(entry)
    return plain
