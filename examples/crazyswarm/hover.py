"""Take off, hover for two seconds and land, all vehicles together.

python hover.py --sim                 # perfect tracking
python hover.py --backend sim         # with the firmware and dynamics
python hover.py                       # over the radio
"""

from pathlib import Path

from pycrazyswarm import Crazyswarm

HEIGHT = 1.0  # m
DURATION = 2.5  # s


def main():
    swarm = Crazyswarm(crazyflies_yaml=Path(__file__).with_name("crazyflies.yaml"))
    allcfs, time_helper = swarm.allcfs, swarm.timeHelper
    allcfs.takeoff(targetHeight=HEIGHT, duration=DURATION)
    time_helper.sleep(DURATION + 2.0)
    allcfs.land(targetHeight=0.04, duration=DURATION)
    time_helper.sleep(DURATION + 0.5)
    for cf in allcfs.crazyflies:
        print(f"cf{cf.id} landed at {cf.position().round(3)}")


if __name__ == "__main__":
    main()
