"""Stream full-state setpoints around a circle at 30 Hz, then hand back and land."""

from pathlib import Path

import numpy as np
from pycrazyswarm import Crazyswarm

RADIUS = 0.5  # m
PERIOD = 4.0  # s
HEIGHT = 1.0  # m
RATE = 30  # Hz
LAPS = 2


def main():
    swarm = Crazyswarm(crazyflies_yaml=Path(__file__).with_name("crazyflies.yaml"))
    cf, time_helper = swarm.allcfs.crazyflies[0], swarm.timeHelper
    cf.takeoff(targetHeight=HEIGHT, duration=2.0)
    time_helper.sleep(2.5)
    centre = cf.initialPosition + np.array([-RADIUS, 0.0, HEIGHT])
    w = 2 * np.pi / PERIOD
    start, errors = time_helper.time(), []
    while (t := time_helper.time() - start) < LAPS * PERIOD:
        radial = np.array([np.cos(w * t), np.sin(w * t), 0.0])
        tangent = np.array([-np.sin(w * t), np.cos(w * t), 0.0])
        cf.cmdFullState(
            pos=centre + RADIUS * radial,
            vel=RADIUS * w * tangent,
            acc=-RADIUS * w**2 * radial,
            yaw=0.0,
            omega=np.zeros(3),
        )
        time_helper.sleepForRate(RATE)
        errors.append(np.linalg.norm(cf.position() - centre) - RADIUS)
    cf.notifySetpointsStop()
    cf.land(targetHeight=0.04, duration=2.0)
    time_helper.sleep(2.5)
    print(f"largest deviation from the circle: {np.abs(errors).max():.3f} m")


if __name__ == "__main__":
    main()
