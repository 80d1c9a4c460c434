"""Two vehicles swap places head on; collision avoidance makes each step to its right."""

from pathlib import Path

import numpy as np
from pycrazyswarm import Crazyswarm
from pycrazyswarm.util import check_ellipsoid_collisions

RADII = np.array([0.15, 0.15, 0.45])  # m, room that each vehicle keeps for itself
HEIGHT = 1.0  # m
DURATION = 6.0  # s


def main():
    swarm = Crazyswarm(crazyflies_yaml=Path(__file__).with_name("crazyflies.yaml"))
    allcfs, time_helper = swarm.allcfs, swarm.timeHelper
    a, b = allcfs.crazyflies
    allcfs.takeoff(targetHeight=HEIGHT, duration=2.0)
    time_helper.sleep(2.5)
    for cf in (a, b):
        cf.enableCollisionAvoidance([a, b], RADII)
    for cf, other in ((a, b), (b, a)):
        cf.goTo(other.initialPosition + np.array([0, 0, HEIGHT]), yaw=0.0, duration=DURATION)
    collided, nearest = False, np.inf
    for _ in range(int(10 * (DURATION + 2.0))):
        time_helper.sleep(0.1)
        positions = np.array([a.position(), b.position()])
        collided |= bool(check_ellipsoid_collisions(positions, RADII).any())
        nearest = min(nearest, np.linalg.norm(positions[0] - positions[1]))
    for cf in (a, b):
        cf.disableCollisionAvoidance()
    allcfs.land(targetHeight=0.04, duration=2.0)
    time_helper.sleep(2.5)
    print(f"nearest {nearest:.2f} m, {'collided' if collided else 'no collision'}")


if __name__ == "__main__":
    main()
