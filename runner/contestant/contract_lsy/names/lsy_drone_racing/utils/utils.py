"""Reading levels and controllers, drawing."""

import importlib.util
import inspect
import tomllib
from pathlib import Path

from crazyarena.runner.contestant.contract_lsy.attribute_dict import attribute_dict

from ..control import Controller


def load_config(path):
    """Read a level file into a dictionary with attributes."""
    with open(Path(path), "rb") as stream:
        return attribute_dict(tomllib.load(stream))


def load_controller(path):
    """Return the one class of a file that derives from Controller."""
    spec = importlib.util.spec_from_file_location("controller", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found = [
        c
        for c in vars(module).values()
        if inspect.isclass(c) and issubclass(c, Controller) and c.__module__ == module.__name__
    ]
    assert len(found) == 1, f"{path}: {len(found)} controllers; expected one"
    return found[0]


def draw_line(env, points, rgba=None, min_size=3.0, max_size=3.0):
    """Draw a line through points (n, 3); ``env`` is an environment or a simulation."""
    sim = getattr(getattr(env, "unwrapped", env), "sim", env)
    sim.crazyarena_draw("line", points, rgba, min_size)
