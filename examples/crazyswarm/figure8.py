"""Upload a figure of eight as a polynomial trajectory and fly it forwards and backwards."""

from pathlib import Path

import uav_trajectory
from pycrazyswarm import Crazyswarm

TIMESCALE = 1.0


def main():
    here = Path(__file__).parent
    swarm = Crazyswarm(crazyflies_yaml=here / "crazyflies.yaml")
    allcfs, time_helper = swarm.allcfs, swarm.timeHelper
    trajectory = uav_trajectory.Trajectory()
    trajectory.loadcsv(here / "figure8.csv")
    for cf in allcfs.crazyflies:
        cf.uploadTrajectory(0, 0, trajectory)
    allcfs.takeoff(targetHeight=1.0, duration=2.0)
    time_helper.sleep(2.5)
    for reverse in (False, True):
        allcfs.startTrajectory(0, timescale=TIMESCALE, reverse=reverse)
        time_helper.sleep(trajectory.duration * TIMESCALE + 2.0)
        for cf in allcfs.crazyflies:
            print(f"cf{cf.id} back at {cf.position().round(3)}")
    allcfs.land(targetHeight=0.04, duration=2.0)
    time_helper.sleep(2.5)


if __name__ == "__main__":
    main()
