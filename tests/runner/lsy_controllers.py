"""Controllers written from the contract of lsy_drone_racing alone, for tests."""

import textwrap

HEAD = """
from __future__ import annotations
import numpy as np
from lsy_drone_racing.control import Controller
"""

STATE = (
    HEAD
    + """
from scipy.interpolate import CubicSpline
from crazyflow.sim.visualize import draw_line, draw_points

class Follower(Controller):
    def __init__(self, obs, info, config):
        super().__init__(obs, info, config)
        self.freq = config.env.freq
        self.k = 0
        points = [[-1.5, 0.75, 0.05], [-1.0, 0.55, 0.4], [0.3, 0.35, 0.7], [1.3, -0.15, 0.9],
                  [0.85, 0.85, 1.2], [-0.5, -0.05, 0.7], [-1.2, -0.2, 0.8], [-1.2, -0.2, 1.2],
                  [0.0, -0.7, 1.2], [0.5, -0.75, 1.2]]
        self.path = CubicSpline(np.linspace(0, 15, len(points)), points)

    def compute_control(self, obs, info=None):
        place = self.path(min(self.k / self.freq, 15))
        return np.concatenate((place, np.zeros(10)), dtype=np.float32)

    def step_callback(self, action, obs, reward, terminated, truncated, info):
        self.k += 1
        return False

    def render_callback(self, sim):
        draw_line(sim, self.path(np.linspace(0, 15, 50)), rgba=(0.0, 1.0, 0.0, 1.0))
        draw_points(sim, self.path(self.k / self.freq).reshape(1, 3), size=0.02)
"""
)

ATTITUDE = (
    HEAD
    + '''
from drone_models.core import load_params

class Hover(Controller):
    """Climbs to a metre over the start and stays there."""

    def __init__(self, obs, info, config):
        super().__init__(obs, info, config)
        params = load_params(config.sim.physics, config.sim.drone_model)
        self.mass, self.goal = params["mass"], np.array(obs["pos"]) + [0, 0, 1.0]
        self.steps = 0

    def compute_control(self, obs, info=None):
        push = 2.0 * (self.goal - obs["pos"]) - 1.5 * obs["vel"] + [0, 0, 9.81]
        roll, pitch = np.arctan2(-push[1], push[2]), np.arctan2(push[0], push[2])
        return np.array([roll, pitch, 0.0, self.mass * np.linalg.norm(push)], np.float32)

    def step_callback(self, action, obs, reward, terminated, truncated, info):
        self.steps += 1
        if self.steps == 200:
            print("at", *obs["pos"])
        return self.steps >= 200
'''
)

LOG = (
    HEAD
    + """
import json
from pathlib import Path

class Log(Controller):
    made = 0

    def __init__(self, obs, info, config):
        Log.made += 1
        self.calls = [f"made {Log.made}"]
        self.seen = {k: [list(np.shape(v)), str(np.asarray(v).dtype)] for k, v in obs.items()}
        self.config = [config.env.freq, config["env"].track.gates[0].pos, config.get("nothing"),
                       config.sim.physics, config.sim.dynamics, config.controller.file]
        self.info = info

    def compute_control(self, obs, info=None):
        self.calls.append("compute")
        return [0.0] * 13

    def step_callback(self, action, obs, reward, terminated, truncated, info):
        assert action.dtype == np.float32 and info == {}
        self.calls.append("step")
        return self.calls.count("step") == 3

    def episode_callback(self):
        self.calls.append("episode_callback")

    def episode_reset(self):
        self.calls.append("episode_reset")
        with open("log.jsonl", "a") as file:
            file.write(json.dumps([self.calls, self.seen, self.config, self.info]) + "\\n")

    def reset(self):
        self.calls.append("reset")
"""
)


def controller(body, head=HEAD, imports=""):
    """Source of a controller with the given lines in ``compute_control``."""
    return (
        head
        + imports
        + "\nclass C(Controller):\n    def compute_control(self, obs, info=None):\n"
        + textwrap.indent(textwrap.dedent(body).strip(), " " * 8)
        + "\n"
    )
