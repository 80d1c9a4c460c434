"""Every command line of docs/hardware.md, run against the virtual vehicle."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from crazyarena.crazyswarm_compat.config import load_crazyflies_1
from crazyarena.sim_backend.crazyradio.environment import with_dongles

ROOT = Path(__file__).resolve().parents[3]
DOCUMENT = ROOT / "docs" / "hardware.md"


def blocks(language):
    """Contents of the fenced blocks of one language."""
    text = DOCUMENT.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def free_port(kind):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_the_vehicle_list_is_valid():
    (text,) = blocks("yaml")
    fleet = load_crazyflies_1(text)
    assert fleet.vehicles[0].uri == "radio://0/80/2M/E7E7E7E701"
    assert fleet.vehicles[0].firmware_params["stabilizer.estimator"] == 2


def test_the_python_example_uses_what_exists():
    (code,) = blocks("python")
    imports = "\n".join(line for line in code.splitlines() if line.startswith("from"))
    exec(compile(imports, str(DOCUMENT), "exec"), {})
    compile(code, str(DOCUMENT), "exec")


def free_ports():
    """A UDP port that is free, as the one after it."""
    while True:
        port = free_port(socket.SOCK_DGRAM)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("127.0.0.1", port + 1))
            except OSError:
                continue
            return port


# Brings up loopback in a network of its own, and holds that until its input ends.
_HOLD = """
import fcntl, socket, struct, sys
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
    fcntl.ioctl(any_socket, 0x8914, struct.pack("16sh", b"lo", 1))
print("up", flush=True)
sys.stdin.read()
"""


class OwnNetwork:
    """A network in which nobody else has the ports that the document names."""

    def __init__(self):
        self._holder = None
        self.enter = []
        if shutil.which("unshare") is None or shutil.which("nsenter") is None:
            return
        self._holder = subprocess.Popen(
            ["unshare", "--user", "--map-root-user", "--net", sys.executable, "-c", _HOLD],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        if self._holder.stdout.readline() == "up\n":
            target = ["--target", str(self._holder.pid), "--user", "--net"]
            self.enter = ["nsenter", *target, "--preserve-credentials"]

    def close(self):
        if self._holder is not None:
            self._holder.communicate(timeout=10)


class Bench:
    """Runs command lines; the virtual vehicle that one starts stays until the next.

    Each is run as it is written, in a network of its own, by the shell. Only the cameras of a
    real arena are replaced by those of the virtual vehicles; and, where a system gives no such
    network, ports by free ones.
    """

    def __init__(self, folder):
        self.folder = folder
        self.network = OwnNetwork()
        self.on_air = False
        self.vehicle = None
        self.ports = {}
        self.zenoh, self.air = "tcp/127.0.0.1:7447", "127.0.0.1:19840"
        if not self.network.enter:
            port = free_ports()
            self.zenoh = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
            self.air = f"127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
            self.ports = {
                "tcp/127.0.0.1:7447": self.zenoh,
                "127.0.0.1:19840": self.air,
                ":19850": f":{port}",
                ":19851": f":{port + 1}",
            }
            self.options = {
                False: f"--port {port} --mocap-endpoint {self.zenoh}",
                True: f"--radio-port {self.air.partition(':')[2]} --mocap-endpoint {self.zenoh}",
            }

    def local(self, line):
        """The command line for the virtual vehicle."""
        line = line.replace("vicon --host 192.168.1.10", "zenoh --host tcp/127.0.0.1:7447")
        line = line.replace("vicon:192.168.1.10", "zenoh:tcp/127.0.0.1:7447")
        for written, own in self.ports.items():
            line = line.replace(written, own)
        if self.ports and " virtual-cf" in line:
            line += f" {self.options[self.on_air]}"
        return [*self.network.enter, "bash", "-c", f"exec {line}"]

    @property
    def environment(self):
        # What is written for a real radio flies over the virtual one.
        own = with_dongles(self.air) if self.on_air else dict(os.environ)
        return {**own, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}

    def run(self, line):
        if " virtual-cf" in line:
            self.stop()
            self.on_air = " --radio" in line
            self.vehicle = subprocess.Popen(
                self.local(line),
                cwd=self.folder,
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                text=True,
            )
            for _ in range(2):
                assert self.vehicle.stdout.readline().startswith(("udp://", "radio://0/80/2M/"))
            if self.on_air:
                assert self.vehicle.stdout.readline().startswith("air ")
            return None
        return subprocess.run(
            self.local(line),
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=180,
            check=False,
        )

    def stop(self):
        if self.vehicle is not None:
            self.vehicle.send_signal(signal.SIGTERM)
            self.vehicle.wait(timeout=20)
            self.vehicle.stdout.close()
            self.vehicle = None

    def close(self):
        self.stop()
        self.network.close()


@pytest.fixture
def bench(tmp_path):
    """The example's folder as it is shipped."""
    folder = tmp_path / "examples"
    shutil.copytree(ROOT / "examples" / "crazyswarm", folder)
    bench = Bench(folder)
    yield bench
    bench.close()


@pytest.mark.slow
def test_every_command_line_works(bench):
    lines = [line for block in blocks("sh") for line in block.splitlines() if line.strip()]
    assert sum(" virtual-cf" in line for line in lines) == 3
    assert sum("hover.py" in line for line in lines) == 5
    flights = 0
    for line in lines:
        done = bench.run(line)
        if done is None:
            continue
        report = f"{line}\n{done.stdout}\n{done.stderr}"
        if "crazyswarm_compat.radio" in line:
            # Of the second vehicle it must say that the link is bad.
            assert done.returncode in (0, 1), report
            assert "protocol 12" in done.stdout, report
        elif "mocap-check" in line:
            # The frozen pose of a vehicle at rest is its only complaint.
            assert "frozen" in done.stdout, report
            assert "never seen" not in done.stdout, report
        else:
            assert done.returncode == 0, report
            said = "no collision" if "swap.py" in line else "cf2 landed"
            assert said in done.stdout, report
            assert "Warning: cf" not in done.stderr, report
            flights += 1
        time.sleep(0.2)
    assert flights == 6


@pytest.mark.slow
def test_a_script_that_fails_in_flight_lands_its_vehicle(bench):
    bench.run("crazyarena virtual-cf --fleet crazyflies.yaml")
    (bench.folder / "broken.py").write_text(
        "from pathlib import Path\n"
        "from pycrazyswarm import Crazyswarm\n"
        "swarm = Crazyswarm(crazyflies_yaml=Path(__file__).with_name('crazyflies.yaml'))\n"
        "swarm.allcfs.takeoff(0.8, 1.5)\n"
        "swarm.timeHelper.sleep(2.0)\n"
        "raise ValueError('a bug')\n",
        encoding="utf-8",
    )
    links = "udp://127.0.0.1:19850,udp://127.0.0.1:19851"
    line = f"python broken.py --uri {links} --mocap zenoh:tcp/127.0.0.1:7447"
    done = bench.run(line)
    assert done.returncode == 1
    assert "a bug" in done.stderr
    assert "landing them" in done.stderr, done.stderr
    (bench.folder / "after.py").write_text(
        "import sys, time\n"
        "from crazyarena.clock import WallClock\n"
        "from crazyarena.crazyswarm_compat.config import FleetConfig, VehicleConfig\n"
        "from crazyarena.crazyswarm_compat.radio import RadioBackend\n"
        "vehicle = VehicleConfig(1, 'cf1', (0, 0, 0), uri=sys.argv[1])\n"
        "backend = RadioBackend(FleetConfig((vehicle,), 'test'), WallClock())\n"
        "time.sleep(1.0)\n"
        "print('height', backend.telemetry(1).state.position[2])\n"
        "print('locked', backend.supervisor(1).locked)\n"
        "backend.close()\n",
        encoding="utf-8",
    )
    after = bench.run("python after.py udp://127.0.0.1:19850")
    assert after.returncode == 0, after.stderr
    height = float(re.search(r"height (\S+)", after.stdout)[1])
    assert abs(height) < 0.1
    assert "locked False" in after.stdout
