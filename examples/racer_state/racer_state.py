"""The example for lsy_drone_racing's state mode: plan through the level, use what is seen.

Worth copying for: planning in the constructor and anew only when something has moved, commanding
position, velocity *and* an acceleration that makes up for what the controller on board gets wrong
(its mass, the scale of its thrust), and looking ahead by what attitude and rotors lag behind.
"""

from __future__ import annotations

import numpy as np
from crazyflow.sim.visualize import draw_line
from drone_models.core import load_params
from lsy_drone_racing.control import Controller
from pilot import TAKE_OFF, Navigator

GRAVITY = np.array([0.0, 0.0, 9.81])
MASS_THRUST = 132000.0  # motor units per N, on board
MASS_ON_BOARD = {"cf21B_500": 0.0393, "cf2x_T350": 0.0325}  # kg; 0.029 elsewhere
LAG = 0.14  # s
LEAD = 0.1  # s, before which a new route is not begun
LEARN = 4.0  # 1/m2
INTEGRAL = 4.0  # 1/s3
STIFFEN = np.array([0.6, 0.3])  # shares of the errors of place and velocity, added to them
WAIT = 1.5  # s, that each drone of a race starts after the one before it
IDLE = np.array([0.0, 0.0, -5.0])  # m/s2, too little to leave the floor


class RacerState(Controller):
    """Follows a route with full-state setpoints."""

    def __init__(self, obs, info, config):
        super().__init__(obs, info, config)
        self.rank = info.get("rank")  # which drone of a race
        obs = self._own(obs)
        model = config.sim.drone_model
        params = load_params(config.sim.get("physics", "first_principles"), model)
        self.period = 1.0 / config.env.freq
        self.drag = -np.diag(params["drag_matrix"]) / params["mass"]
        self.mass, self.mass_on_board = params["mass"], MASS_ON_BOARD.get(model, 0.029)
        self.scale = MASS_THRUST / params["pwm_max"] * 4.0 * params["thrust_max"]
        self.navigator = Navigator(obs, self.period, LEAD)
        self.bias = np.zeros(3)
        self.behind = 0.0  # 1/s
        self.step = -round(WAIT * (self.rank or 0) / self.period)

    def _own(self, obs):
        """What concerns this drone: in a race everybody sees the rows of all."""
        return obs if self.rank is None else {key: rows[self.rank] for key, rows in obs.items()}

    def compute_control(self, obs, info=None):
        obs = self._own(obs)
        if self.step < 0:
            return np.concatenate([obs["pos"], [0, 0, 0], IDLE, [0, 0, 0, 0]], dtype=np.float32)
        t = self.step * self.period
        self.navigator.look(obs, t)
        place, velocity, _ = self.navigator.reference(t)
        _, ahead, push = self.navigator.reference(t + LAG)
        push = push + (self.drag + self.behind) * ahead
        error = place - obs["pos"]
        if t >= TAKE_OFF:
            velocity = velocity + STIFFEN[1] * (velocity - obs["vel"])
            place = place + STIFFEN[0] * error
            # What it is behind on its way it will be behind all the way.
            self.behind += LEARN * self.period * (error @ velocity)
            self.behind = np.clip(self.behind, 0.0, 1.2)
            self.bias += INTEGRAL * self.period * error
            self.bias = np.clip(self.bias, -1.5, 1.5)
        force = self.mass * (push + self.bias + GRAVITY) / self.scale
        acceleration = force / self.mass_on_board - GRAVITY
        rest = [self.navigator.heading(obs), 0.0, 0.0, 0.0]  # yaw and rates
        return np.concatenate([place, velocity, acceleration, rest], dtype=np.float32)

    def step_callback(self, action, obs, reward, terminated, truncated, info):
        self.step += 1
        return False

    def render_callback(self, sim):
        route = self.navigator.route
        times = np.linspace(self.step * self.period, route.end, 60)
        draw_line(sim, np.array([route.at(t)[0] for t in times]), rgba=(0.0, 1.0, 0.0, 1.0))
