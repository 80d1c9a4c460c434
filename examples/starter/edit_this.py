"""My controller. It plans a route through the gates and flies along it; the rest is yours.

The runner makes one Controller and flies all episodes with it: cmdFirmware is asked 30 times a
second what the drone does next. Units: m, s, rad. x forward, y left, z up.
"""

import numpy as np
from competition_utils import Command
from route import Route, way_points


class Controller:
    # Called once. What takes long belongs in here: nothing flies yet.
    #
    # initial_obs:  [x, 0, y, 0, z, 0, roll, pitch, yaw, 0, 0, 0]
    # initial_info: what is known beforehand: where gates and obstacles should stand, sizes, the
    #               goal, the rate. print(initial_info.keys()) shows it all.
    def __init__(self, initial_obs, initial_info, use_firmware=True, verbose=False):
        self.start = np.array(initial_obs[0:5:2])  # x, y, z
        self.goal = np.array(initial_info["x_reference"])[0:5:2]
        self.poles = [pole[:2] for pole in initial_info["nominal_obstacles_pos"]]

        # A gate is x, y, 0, roll, pitch, yaw, type (0 tall, 1 low); the type has the height.
        sizes = initial_info["gate_dimensions"]
        heights = [sizes["tall"]["height"], sizes["low"]["height"]]
        self.gates = [
            (gate[0], gate[1], heights[gate[6]], gate[5])
            for gate in initial_info["nominal_gates_pos_and_type"]
        ]

        points = way_points(self.start, self.gates, self.poles, self.goal)
        self.route = Route(points)

    # Called at every step; must answer within 1/30 s.
    #
    # time: s since the episode began. obs: as initial_obs, now. info: which gate is next, where it
    # really is once it is close, and whether something was hit; empty at time 0.
    def cmdFirmware(self, time, obs, reward=None, done=None, info=None):
        position, velocity, acceleration = self.route.at(time)
        yaw, body_rates = 0.0, np.zeros(3)
        return Command.FULLSTATE, [position, velocity, acceleration, yaw, body_rates]
