"""Fly through the four gates of a race track with go-to commands, heading along the path."""

from math import atan2, dist
from pathlib import Path

import numpy as np
from pycrazyswarm import Crazyswarm

# Centre x, y, z (m) and heading (rad) of each gate, in the order of the track.
GATES = [
    (0.45, -1.0, 0.525, 2.35),
    (1.0, -1.55, 1.0, -0.78),
    (0.0, 0.5, 0.525, 0.0),
    (-0.5, -0.5, 1.0, 3.14),
]
APPROACH = 0.4  # m before and behind each gate
SPEED = 0.7  # m/s


def waypoints(start):
    """Points before and behind each gate, entering on the side that is nearer."""
    points, here = [], np.array(start)
    for x, y, z, heading in GATES:
        centre = np.array([x, y, z])
        # A gate's opening looks along its y axis.
        along = APPROACH * np.array([-np.sin(heading), np.cos(heading), 0.0])
        if dist(here, centre - along) > dist(here, centre + along):
            along = -along
        points += [centre - along, centre + along]
        here = centre + along
    return points


def main():
    swarm = Crazyswarm(crazyflies_yaml=Path(__file__).with_name("crazyflies.yaml"))
    cf, time_helper = swarm.allcfs.crazyflies[0], swarm.timeHelper
    cf.takeoff(targetHeight=0.7, duration=2.0)
    time_helper.sleep(2.5)
    here = np.array([*cf.initialPosition[:2], 0.7])
    for goal in waypoints(here):
        duration = max(1.0, dist(here, goal) / SPEED)
        cf.goTo(goal, yaw=atan2(goal[1] - here[1], goal[0] - here[0]), duration=duration)
        time_helper.sleep(duration)
        here = goal
    time_helper.sleep(0.5)
    cf.land(targetHeight=0.04, duration=2.0)
    time_helper.sleep(2.5)
    print(f"landed at {cf.position().round(3)}, last gate left at {here.round(3)}")


if __name__ == "__main__":
    main()
