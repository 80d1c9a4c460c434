"""The example for lsy_drone_racing's attitude mode: plan through the level, use what is seen.

Worth copying for: the same planning as the state example, and an outer loop of its own: the
acceleration of the route, corrected by what is seen of place and velocity, as an attitude and a
collective thrust (D. Mellinger and V. Kumar, ICRA 2011).
"""

from __future__ import annotations

import numpy as np
from crazyflow.sim.visualize import draw_line
from drone_models.core import load_params
from lsy_drone_racing.control import Controller
from pilot import TAKE_OFF, Navigator
from scipy.spatial.transform import Rotation

GRAVITY = np.array([0.0, 0.0, 9.81])
LAG = 0.14  # s, that attitude and rotors are behind
LEAD = 0.1  # s, before which a new route is not begun
STIFFNESS = np.array([22.0, 22.0, 30.0])  # 1/s2
DAMPING = np.array([9.0, 9.0, 11.0])  # 1/s
INTEGRAL = np.array([4.0, 4.0, 10.0])  # 1/s3
TILT = 0.8  # rad, the most
WAIT = 1.5  # s, that each drone of a race starts after the one before it


class RacerAttitude(Controller):
    """Follows a route with roll, pitch, yaw and thrust."""

    def __init__(self, obs, info, config):
        super().__init__(obs, info, config)
        self.rank = info.get("rank")  # which drone of a race
        obs = self._own(obs)
        params = load_params(config.sim.get("physics", "first_principles"), config.sim.drone_model)
        self.period = 1.0 / config.env.freq
        self.mass = params["mass"]
        self.drag = -np.diag(params["drag_matrix"]) / params["mass"]
        self.least, self.most = 4.0 * params["thrust_min"], 4.0 * params["thrust_max"]
        self.navigator = Navigator(obs, self.period, LEAD)
        self.bias = np.zeros(3)
        self.step = -round(WAIT * (self.rank or 0) / self.period)

    def _own(self, obs):
        """What concerns this drone: in a race everybody sees the rows of all."""
        return obs if self.rank is None else {key: rows[self.rank] for key, rows in obs.items()}

    def compute_control(self, obs, info=None):
        obs = self._own(obs)
        if self.step < 0:
            return np.array([0.0, 0.0, 0.0, self.least], dtype=np.float32)
        t = self.step * self.period
        self.navigator.look(obs, t)
        place, velocity, _ = self.navigator.reference(t)
        _, ahead, push = self.navigator.reference(t + LAG)
        error = place - obs["pos"]
        if t >= TAKE_OFF:
            self.bias = np.clip(self.bias + INTEGRAL * self.period * error, -2.0, 2.0)
        want = push + self.drag * ahead + self.bias + GRAVITY
        want = want + STIFFNESS * error + DAMPING * (velocity - obs["vel"])
        want[2] = max(want[2], 3.0)
        flat = np.linalg.norm(want[:2])
        want[:2] *= min(1.0, np.tan(TILT) * want[2] / max(flat, 1e-9))
        body = Rotation.from_quat(obs["quat"]).as_matrix()[:, 2]
        thrust = np.clip(self.mass * (want @ body), self.least, self.most)
        yaw = self.navigator.heading(obs)
        z = Rotation.from_euler("z", -yaw).apply(want / np.linalg.norm(want))
        roll, pitch = np.arctan2(-z[1], np.hypot(z[0], z[2])), np.arctan2(z[0], z[2])
        return np.array([roll, pitch, yaw, thrust], dtype=np.float32)

    def step_callback(self, action, obs, reward, terminated, truncated, info):
        self.step += 1
        return False

    def render_callback(self, sim):
        route = self.navigator.route
        times = np.linspace(self.step * self.period, route.end, 60)
        draw_line(sim, np.array([route.at(t)[0] for t in times]), rgba=(0.0, 1.0, 0.0, 1.0))
