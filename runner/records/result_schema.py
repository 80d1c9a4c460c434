"""JSON Schema (2020-12) of ``result.json``, made of the types it is written from."""

from __future__ import annotations

from typing import Any

from crazyarena.runner.judging.result import FORMAT, EpisodeResult

_DIALECT = "https://json-schema.org/draft/2020-12/schema"
_EVENT = {
    "type": "object",
    "properties": {
        "event": {"type": "string"},
        "tick": {"type": "integer"},
        "time": {"type": "number", "description": "s since the episode began"},
        "detail": {"type": "string"},
    },
    "required": ["event", "tick", "time", "detail"],
    "additionalProperties": False,
}
_SECONDS = {"type": ["number", "null"], "minimum": 0}
_SCORE = {
    "type": "object",
    "description": "The competition's two measures, s; null where the trial does not qualify.",
    "properties": {
        "qualified": {"type": "boolean"},
        "A_flight_time": _SECONDS,
        "B_total_time": _SECONDS,
    },
    "required": ["qualified", "A_flight_time", "B_total_time"],
    "additionalProperties": False,
}


def result_schema() -> dict[str, Any]:
    """The schema as plain data; of results of levels of 2022 and of the arena."""
    from pydantic import TypeAdapter

    episode = TypeAdapter(EpisodeResult).json_schema()
    definitions = episode.pop("$defs", {})
    definitions.pop("Event", None)
    properties = episode["properties"]
    properties["events"] = {"type": "array", "items": {"$ref": "#/$defs/Event"}}
    properties["clean"] = {
        "type": "boolean",
        "description": "completed, without collision and violation",
    }
    # Every field is written, also those that have a default in the code.
    episode |= {"required": list(properties), "additionalProperties": False}
    fields: dict[str, Any] = {
        "format": {"const": FORMAT},
        "finished": {"type": "boolean", "description": "no further episode is to come"},
        "clean": {
            "type": "boolean",
            "description": "every requested episode was flown, and cleanly",
        },
        "isolated": {
            "type": "boolean",
            "description": "the contestant was behind walls; only such results compare",
        },
        "requested_episodes": {"type": "integer", "minimum": 1},
        "score": {"$ref": "#/$defs/Score"},
        "episodes": {"type": "array", "items": {"$ref": "#/$defs/EpisodeResult"}},
        "provenance": {
            "type": "object",
            "description": "what it takes to fly the same again: versions, machine, level file, "
            "seed, submission and its SHA-256, rig, checklist",
        },
    }
    return {
        "$schema": _DIALECT,
        "title": "result.json of crazyarena",
        "type": "object",
        "properties": fields,
        "required": list(fields),
        "additionalProperties": False,
        "$defs": {**definitions, "Event": _EVENT, "Score": _SCORE, "EpisodeResult": episode},
    }
