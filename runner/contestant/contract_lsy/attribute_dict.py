"""A dictionary whose keys are attributes as well, as controllers read their level."""

from __future__ import annotations

import copy
from typing import Any


class AttributeDict(dict):
    """``config.env.freq`` and ``config["env"]["freq"]`` alike."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(
                f"the level has no '{name}' here; it has {', '.join(self)}"
            ) from None

    def __setattr__(self, name: str, value: Any) -> None:
        self[name] = value

    def __delattr__(self, name: str) -> None:
        try:
            del self[name]
        except KeyError:
            raise AttributeError(name) from None

    def __deepcopy__(self, memo: dict[int, Any]) -> AttributeDict:
        return AttributeDict((k, copy.deepcopy(v, memo)) for k, v in self.items())

    def __reduce__(self) -> Any:
        return attribute_dict, (self.to_dict(),)

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionaries all the way down."""
        return _plain(self)

    def copy_and_resolve_references(self) -> AttributeDict:
        return copy.deepcopy(self)

    def lock(self) -> AttributeDict:
        return self

    def unlock(self) -> AttributeDict:
        return self

    unlocked = unlock


def attribute_dict(value: Any) -> Any:
    """Dictionaries in ``value`` turned into :class:`AttributeDict`, also those in lists."""
    if isinstance(value, dict):
        return AttributeDict((k, attribute_dict(v)) for k, v in value.items())
    if isinstance(value, list | tuple):
        return [attribute_dict(v) for v in value]
    return value


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_plain(v) for v in value]
    return value


def level_config(config: dict[str, Any]) -> AttributeDict:
    """A level's file as controllers get it: with the names of both of its generations."""
    full = attribute_dict(config)
    sim = full.setdefault("sim", AttributeDict())
    sim.setdefault("physics", sim.get("dynamics", "first_principles"))
    sim.setdefault("dynamics", sim["physics"])
    sim.setdefault("drone_model", "cf21B_500")
    sim.setdefault("freq", 500)
    sim.setdefault("attitude_freq", 500)
    sim.setdefault("render", False)
    env = full.setdefault("env", AttributeDict())
    env.setdefault("freq", 50)
    env.setdefault("sensor_range", 0.5)
    env.setdefault("control_mode", "state")
    track = env.setdefault("track", AttributeDict())
    track.setdefault("gate_order", list(range(1, len(track.get("gates", [])) + 1)))
    return full
