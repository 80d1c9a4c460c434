"""Scripts as their authors run them: own process, own folder, nothing but flags."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.crazyswarm_compat.conftest import TWO, TWO_2
from tests.optional import needs_pybullet

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "crazyswarm"

# The same bytes for every backend. Hover, move, stream, hand over, report, land.
SCRIPT_1 = """\
from pycrazyswarm import *
import numpy as np

swarm = Crazyswarm()
timeHelper = swarm.timeHelper
allcfs = swarm.allcfs
allcfs.takeoff(targetHeight=1.0, duration=2.0)
timeHelper.sleep(3.0)
for cf in allcfs.crazyflies:
    cf.goTo(np.array(cf.initialPosition) + np.array([0.5, 0.5, 1.0]), 0, 2.5)
timeHelper.sleep(3.5)
cf = allcfs.crazyfliesById[1]
start = timeHelper.time()
while timeHelper.time() - start < 2.0:
    cf.cmdPosition([1.5, 0.5, 1.2], yaw=0)
    timeHelper.sleepForRate(20)
cf.notifySetpointsStop()
cf.goTo([1.0, 0.0, 1.0], 0, 2.5)
timeHelper.sleep(4.0)
for cf in allcfs.crazyflies:
    print("at", *cf.position())
allcfs.land(targetHeight=0.02, duration=2.0)
timeHelper.sleep(3.0)
"""
EXPECTED_1 = np.array([[1.0, 0.0, 1.0], [0.5, -0.5, 1.0]])
SCRIPT_2 = """\
from crazyflie_py import Crazyswarm

def main():
    swarm = Crazyswarm()
    timeHelper = swarm.timeHelper
    cf = swarm.allcfs.crazyflies[0]
    cf.takeoff(targetHeight=1, duration=2.0)
    timeHelper.sleep(3.0)
    cf.goTo([1, 1, 1], 0, 2.5)
    timeHelper.sleep(4.5)
    print("at", *cf.get_position())
    cf.land(targetHeight=0.04, duration=2.0)
    timeHelper.sleep(3.0)

if __name__ == "__main__":
    main()
"""


def run(script: Path, *flags: str) -> str:
    done = subprocess.run(
        [sys.executable, script.name, *flags],
        cwd=script.parent,
        capture_output=True,
        text=True,
        timeout=240,
        stdin=subprocess.DEVNULL,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def positions(output: str) -> np.ndarray:
    lines = [line.split()[1:] for line in output.splitlines() if line.startswith("at ")]
    return np.array(lines, dtype=np.float64)


@pytest.fixture
def folder(tmp_path):
    """A checkout in miniature: scripts beside launch and config."""
    for name in ("scripts", "launch", "config"):
        (tmp_path / name).mkdir()
    (tmp_path / "launch" / "crazyflies.yaml").write_text(TWO)
    (tmp_path / "config" / "crazyflies.yaml").write_text(TWO_2)
    (tmp_path / "scripts" / "one.py").write_text(SCRIPT_1)
    (tmp_path / "scripts" / "two.py").write_text(SCRIPT_2)
    return tmp_path / "scripts"


BACKENDS = [
    (("--sim",), 1e-4),
    (("--backend", "sim"), 0.05),
    pytest.param(("--backend", "pybullet"), 0.05, marks=[pytest.mark.slow, needs_pybullet]),
]


@pytest.mark.parametrize(("flags", "tolerance"), BACKENDS)
def test_same_script_on_every_backend(folder, flags, tolerance):
    found = positions(run(folder / "one.py", *flags))
    assert np.abs(found - EXPECTED_1).max() <= tolerance


@pytest.mark.parametrize(("flags", "tolerance"), BACKENDS)
def test_same_crazyswarm2_script_on_every_backend(folder, flags, tolerance):
    found = positions(run(folder / "two.py", *flags, "--vis", "null"))
    assert np.abs(found - [[1.0, 1.0, 1.0]]).max() <= tolerance


@pytest.mark.parametrize("name", ["hover", "gates", "figure8", "circle", "swap"])
def test_example(name):
    output = run(EXAMPLES / f"{name}.py", "--sim", "--vis", "null")
    results = {
        "hover": "cf2 landed at [1.   0.   0.04]",
        "gates": "landed at",
        "figure8": "cf2 back at [1. 0. 1.]",
        "circle": "largest deviation from the circle: 0.000 m",
        "swap": "no collision",
    }
    assert results[name] in output


def test_drop_in_names():
    code = (
        "from pycrazyswarm import *\n"
        "assert Crazyswarm and cfsim\n"
        "from pycrazyswarm.util import *\n"
        "assert np and sp and scipy and grid_yaml and poisson_disk_sample\n"
        "import pycrazyswarm.crazyflie, pycrazyswarm.crazyflieSim, pycrazyswarm.crazyswarm_py\n"
        "import pycrazyswarm.genericJoystick, pycrazyswarm.keyboard, pycrazyswarm.linuxjsdev\n"
        "import pycrazyswarm.joystick, pycrazyswarm.output, pycrazyswarm.videowriter\n"
        "import pycrazyswarm.visualizer.visNull, pycrazyswarm.visualizer.visMatplotlib\n"
        "import pycrazyswarm.visualizer.visVispy\n"
        "from uav_trajectory import Trajectory\n"
        "from crazyflie_py.uav_trajectory import Trajectory as Trajectory2\n"
        "import crazyflie_py.util\n"
        "assert not hasattr(crazyflie_py.util, 'grid_yaml')\n"
        "import sys\n"
        "assert 'rospy' not in sys.modules and 'numba' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_firmware_bindings_import():
    code = "import pycrazyswarm.cfsim.cffirmware as firm; assert firm.mkvec(1, 2, 3).z == 3"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
