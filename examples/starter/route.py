"""A route through gates and around poles, at a walking pace."""

import numpy as np
from scipy.interpolate import CubicSpline

SPEED = 0.7  # m/s
APPROACH = 0.3  # m before and behind a gate, where the route is straight
CLEARANCE = 0.45  # m from the middle of a pole


def way_points(start, gates, poles, goal):
    """Points to fly through: rows of x, y, z.

    start, goal: (3,) m; gates: (x, y, z of the opening, yaw) each; poles: (x, y) each.
    """
    points = [np.asarray(start, float)]
    for index, (x, y, z, yaw) in enumerate(gates):
        centre = np.array([x, y, z])
        # At yaw 0 a gate is flown through along y: this way or that, whichever leads on.
        through = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        behind = gates[index + 1][:3] if index + 1 < len(gates) else goal
        if through @ (np.asarray(behind) - points[-1]) < 0.0:
            through = -through
        before, after = centre - APPROACH * through, centre + APPROACH * through
        if np.linalg.norm(centre - points[-1]) > 1.5 * APPROACH:
            points += [*_around(points[-1], before, poles), before]
        points += [centre, after]
    points += _around(points[-1], goal, poles)
    points.append(np.asarray(goal, float))
    return np.array(points)


def _around(a, b, poles):
    """Where to pass between a and b: in the middle, or beside a pole that stands in the way."""
    leg = (b - a)[:2]
    for pole in poles:
        share = np.clip((pole - a[:2]) @ leg / (leg @ leg), 0.0, 1.0)
        closest = a + share * (b - a)
        away = closest[:2] - pole
        distance = np.linalg.norm(away)
        if 0.1 < share < 0.9 and distance < CLEARANCE:
            closest[:2] = pole + away * CLEARANCE / max(distance, 0.01)
            return [closest]
    return [(a + b) / 2.0] if leg @ leg > 1.0 else []


class Route:
    """A smooth curve through points (n, 3) m, begun at ``begin`` s with a velocity (3,) m/s."""

    def __init__(self, points, begin=0.0, velocity=(0.0, 0.0, 0.0)):
        lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
        duration = lengths / SPEED
        if np.linalg.norm(velocity) < 0.1:
            duration[0] += 0.5  # to get going
        duration[-1] += 1.0  # to come to rest
        self.begin = begin
        self.times = np.append(0.0, np.cumsum(duration))
        self.curve = CubicSpline(
            self.times, points, bc_type=((1, np.asarray(velocity)), (1, np.zeros(3)))
        )

    def at(self, time):
        """Position, velocity and acceleration (3,) at a time of the episode, s."""
        t = time - self.begin
        if t >= self.times[-1]:
            return self.curve(self.times[-1]), np.zeros(3), np.zeros(3)
        return self.curve(t), self.curve(t, 1), self.curve(t, 2)
