"""Latency from publication of a pose frame to the estimator's callback, over loopback.

Chains, each with the publisher in a process of its own:

* zenoh: ZenohPublisher, zenoh session, ZenohSource, estimator, callback;
* qualisys, natnet: QualisysServer or NatNetServer, the real ``motioncapture`` client in its helper
  process, MotionCaptureSource, estimator, callback;
* vrpn: VrpnServer, which sends each body by itself, VrpnSource, which makes frames of them,
  estimator, callback; vrpn-package: the same through the ``motioncapture`` client, which polls.

Run ``python benchmarks/mocap_latency.py [--seconds 20] [--rate 300] [--bodies 10]``.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import socket
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from crazyarena.clock import WallClock
from crazyarena.mocap.estimator import PoseEstimator
from crazyarena.mocap.motioncapture_source import MotionCaptureSource
from crazyarena.mocap.natnet_server import NatNetServer
from crazyarena.mocap.pipeline import PosePipeline
from crazyarena.mocap.serve import circling
from crazyarena.mocap.source import PoseSource
from crazyarena.mocap.stamps import HostStamps, host_time
from crazyarena.mocap.vendor_server import QualisysServer
from crazyarena.mocap.vrpn_server import VrpnServer
from crazyarena.mocap.vrpn_source import VrpnSource
from crazyarena.mocap.zenoh_link import ZenohPublisher, ZenohSource
from crazyarena.types import Pose, PoseFrame

# A body that nobody flies carries the frame's number in millimetres through protocols whose
# clients do not show it.
COUNTER = "counter"
CHAINS = ("zenoh", "qualisys", "natnet", "vrpn", "vrpn-package")


@dataclass(frozen=True)
class Measurement:
    """One run; latencies in ms, without the first second."""

    chain: str
    published: int
    received: int
    in_order: bool
    malformed: int
    p50: float
    p99: float
    maximum: float
    hand_over_p50: float
    load_average: float


def free_port() -> int:
    """Return a TCP port nobody listens on, with a free one above it."""
    with socket.socket() as first:
        first.bind(("127.0.0.1", 0))
        return int(first.getsockname()[1])


def publish(chain: str, port: int, rate: float, seconds: float, bodies: int, link: Connection):
    """Child process: say ready, wait for go, publish, report host times of publication."""
    clock = WallClock()
    names = [f"cf{i + 1}" for i in range(bodies)]
    truth = circling(names)
    outlet: Any
    if chain == "zenoh":
        outlet = ZenohPublisher(clock, listen=[f"tcp/127.0.0.1:{port}"])
    elif chain == "natnet":
        outlet = NatNetServer([*names, COUNTER], port, multicast=True, data_port=port + 1)
    elif chain.startswith("vrpn"):
        outlet = VrpnServer([*names, COUNTER], port)
    else:
        outlet = QualisysServer([*names, COUNTER], port)
    link.send("ready")
    link.recv()
    times = np.zeros(round(rate * seconds))
    start = clock.now() + 0.05
    for k in range(len(times)):
        due = start + k / rate
        poses = dict(truth(due - start))
        poses[COUNTER] = Pose(np.array([k * 1e-3, 0.0, 0.0]))
        clock.sleep_until(due)
        times[k] = host_time()
        outlet.publish(PoseFrame(clock.now(), clock.now(), k, poses))
    link.send(times)
    link.recv()
    outlet.close()


def measure(chain: str, rate: float, seconds: float, bodies: int) -> Measurement:
    """Run one chain and compare times of publication with those of the callback."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    port = free_port()
    child = context.Process(
        target=publish, args=(chain, port, rate, seconds, bodies, there), daemon=True
    )
    child.start()
    assert here.recv() == "ready"
    clock = WallClock()
    stamps = HostStamps(clock)
    source: PoseSource
    if chain == "zenoh":
        source = ZenohSource(clock, connect=[f"tcp/127.0.0.1:{port}"])
    elif chain == "vrpn":
        source = VrpnSource(clock, port=port, stall_after=20.0)
    elif chain == "vrpn-package":
        source = MotionCaptureSource(
            clock, "vrpn", hostname=f"tcp://localhost:{port}", stall_after=20.0
        )
    elif chain == "natnet":
        source = MotionCaptureSource(
            clock, "optitrack", hostname="127.0.0.1", port_command=port,
            interface_ip="127.0.0.1", stall_after=20.0,
        )  # fmt: skip
    else:
        source = MotionCaptureSource(
            clock, "qualisys", hostname="127.0.0.1", port=port, stall_after=20.0
        )
    count = round(rate * seconds)
    arrivals = np.full(count, np.nan)
    order: list[int] = []
    work: list[float] = []

    def arrived(frame: PoseFrame, _: object) -> None:
        now = host_time()
        pose = frame.bodies.get(COUNTER)
        if pose is not None:
            k = round(float(pose.position[0]) * 1e3)
            arrivals[k] = now
            order.append(k)
            work.append(now - stamps.to_host(frame.received))

    estimator = PoseEstimator([f"cf{i + 1}" for i in range(bodies)])
    pipeline = PosePipeline(source, estimator, clock, on_frame=[arrived])
    pipeline.start()
    # Both need a moment to find each other; frames published before that are not counted
    # as lost by anybody, so none may be.
    clock.sleep_until(clock.now() + 3.0)
    here.send("go")
    times = here.recv()
    clock.sleep_until(clock.now() + 0.5)
    status = source.status
    pipeline.close()
    here.send("end")
    child.join(5.0)
    settled = np.arange(count) >= min(rate, count // 4)
    latency = (arrivals - times)[settled] * 1e3
    latency = latency[np.isfinite(latency)]
    p50, p99 = np.percentile(latency, (50, 99)).tolist()
    return Measurement(
        chain,
        count,
        len(order),
        order == sorted(order),
        status.malformed,
        p50,
        p99,
        float(latency.max()),
        float(np.percentile(work, 50)) * 1e3,
        os.getloadavg()[0],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rate", type=float, default=300.0)
    parser.add_argument("--bodies", type=int, default=10)
    parser.add_argument("--chain", choices=CHAINS, action="append")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    print(f"{arguments.bodies} bodies, {arguments.rate:g} Hz, {arguments.seconds:g} s, loopback")
    for chain in arguments.chain or CHAINS:
        m = measure(chain, arguments.rate, arguments.seconds, arguments.bodies)
        if arguments.json:
            print(json.dumps(asdict(m)))
        else:
            print(
                f"{chain:12s} published {m.published}, received {m.received}, "
                f"in order {m.in_order}, latency ms p50 {m.p50:.2f} p99 {m.p99:.2f} "
                f"max {m.maximum:.2f} (load average {m.load_average:.1f})"
            )


if __name__ == "__main__":
    main()
