"""My controller. It plans a route through the gates and flies along it; the rest is yours.

A new object is made for every episode. Units: m, s, rad.
"""

from __future__ import annotations

import numpy as np
from lsy_drone_racing.control import Controller
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

SPEED = 0.6  # m/s
APPROACH = 0.3  # m before and behind a gate, where the route is straight
CLEARANCE = 0.35  # m from the middle of a pole


class MyController(Controller):
    # obs:    "pos", "quat", "vel", "ang_vel" of the drone; "gates_pos", "gates_quat" and
    #         "obstacles_pos", exact once they are near; "target_gate", -1 behind the last one.
    # config: the whole level file; config.env.freq is how often compute_control is asked.
    def __init__(self, obs, info, config):
        super().__init__(obs, info, config)
        self.period = 1.0 / config.env.freq
        self.step = 0
        points = way_points(obs)
        length = np.linalg.norm(np.diff(points, axis=0), axis=1)
        duration = length / SPEED
        duration[0] += 0.5  # to get going
        self.times = np.append(0.0, np.cumsum(duration))
        self.curve = CubicSpline(self.times, points, bc_type="clamped")

    # Called at every step. Returns 13 numbers: position, velocity, acceleration, yaw, body rates.
    def compute_control(self, obs, info=None):
        t = min(self.step * self.period, self.times[-1])
        state = [self.curve(t), self.curve(t, 1), self.curve(t, 2), np.zeros(4)]
        return np.concatenate(state, dtype=np.float32)

    # Called after every step; True ends the episode.
    def step_callback(self, action, obs, reward, terminated, truncated, info):
        self.step += 1
        return False


def way_points(obs):
    """Points to fly through: rows of x, y, z."""
    points = [np.array(obs["pos"], float)]
    axes = Rotation.from_quat(obs["gates_quat"]).as_matrix()
    centres = np.array(obs["gates_pos"], float)
    # What stands about: the poles, and the two sides of every gate.
    sides = [centres + 0.28 * sign * axes[:, :, 1] for sign in (-1.0, 1.0)]
    posts = np.vstack([obs["obstacles_pos"], *sides])[:, :2]
    for centre, through in zip(centres, axes[:, :, 0], strict=True):
        # Gates are flown through along their x axis.
        before, after = centre - APPROACH * through, centre + APPROACH * through
        points += around(points[-1], before, posts)
        points += [before, centre, after]
    return np.array(points)


def around(a, b, posts, depth=2):
    """Where to pass between a and b: in the middle, or beside what stands in the way."""
    leg = b - a
    length = np.linalg.norm(leg[:2])
    flat = leg[:2] / max(length, 1e-6)
    along = (posts - a[:2]) @ flat
    offset = np.abs((posts - a[:2]) @ np.array([-flat[1], flat[0]]))
    in_the_way = (0.1 * length < along) & (along < 0.9 * length) & (offset < CLEARANCE)
    if not in_the_way.any() or depth == 0:
        return [a + leg / 2.0] if np.linalg.norm(leg) > 1.0 else []
    index = int(np.argmin(np.where(in_the_way, offset, np.inf)))
    post, others = posts[index], np.delete(posts, index, axis=0)
    beside = CLEARANCE * np.array([-flat[1], flat[0]])

    def merit(spot):  # the side that is shorter, and has room
        room = min(np.linalg.norm(others - spot, axis=1).min(), CLEARANCE)
        return 6.0 * room - np.linalg.norm(spot - a[:2]) - np.linalg.norm(b[:2] - spot)

    point = a + along[index] / length * leg
    point[:2] = max((post + beside, post - beside), key=merit)
    return [*around(a, point, posts, depth - 1), point, *around(point, b, posts, depth - 1)]
