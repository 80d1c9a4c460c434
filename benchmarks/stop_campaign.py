"""From ``crazyarena estop`` in a shell to motors that are off, while much goes wrong.

    python benchmarks/stop_campaign.py --rounds 3

In each round 20 flights, each a process with cflib, an emergency stop and its listener, hover a
virtual Crazyflie over UDP. Ten of them hang (SIGSTOP). The listeners of the others have been sent
10 000 hostile messages, the folder of the stop sockets is open to everybody, every third socket was
removed, and two busy processes run on every core. Then ``crazyarena estop`` is started. Taken are,
for each vehicle whose flight lives, the time from there until its motors are off, and the part of
it after the stop was sent (the rest is Python starting up). Stops nothing but its own flights.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from crazyarena.clock import WallClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.safety.estop_local import ONLY_PLACE, runtime_folder
from crazyarena.safety.estop_socket import SocketSource

CAN_FLY = 1 << 3
HOSTILE = (
    b'{"test": true, "reason": "\\ud800\\u001b[2J"}',
    b'{"test": true, "a": ' + b"[" * 300 + b"]" * 300 + b"}",
    b'{"test": true, "time": ' + b"9" * 300 + b"}",
)


def fly(uri: str) -> None:
    """A flight: goes up, says so, and does nothing more but listen."""
    from crazyarena.crazyswarm_compat.config import FleetConfig, VehicleConfig
    from crazyarena.crazyswarm_compat.radio import RadioBackend
    from crazyarena.safety.estop import EmergencyStop

    fleet = FleetConfig((VehicleConfig(1, "cf1", (0.0, 0.0, 0.0), uri=uri),), "benchmark")
    backend = RadioBackend(fleet, WallClock())
    stop = EmergencyStop([backend], WallClock())
    sent = threading.Event()
    stop.on_stop(lambda _: sent.set())
    source = SocketSource(stop, say=lambda text: None)
    while not (backend.telemetry(1).supervisor or 0) & CAN_FLY:
        time.sleep(0.05)
    backend.send(c.Takeoff(0.5, 1.0), 1)
    print(json.dumps({"name": source.name}), flush=True)
    sent.wait()
    print(json.dumps({"sent": time.monotonic()}), flush=True)
    threading.Event().wait()


def _burn() -> None:
    while True:
        sum(range(1000))


def annoy(folder: Path, names: list[str], messages: int) -> None:
    """Send hostile messages, open the folder, remove every third socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        for index in range(messages):
            with contextlib.suppress(OSError):
                path = folder / names[index % len(names)]
                sender.sendto(HOSTILE[index % len(HOSTILE)], str(path))
    folder.chmod(0o777)
    for name in names[::3]:
        (folder / name).unlink(missing_ok=True)
    # A listener looks four times a second; a stop within that time goes by its other ways, which
    # are shut off here so that nobody else's flights are stopped.
    time.sleep(1.0)


def one_round(flights: int, hung: int, messages: int, loaded: bool) -> tuple[list[float], ...]:
    """Seconds until motors are off, and of these after the stop was sent; of estop itself."""
    from crazyarena.sim_backend.arena import ArenaFleet
    from crazyarena.sim_backend.crtp.server import VirtualServer
    from crazyarena.sim_backend.crtp.swarm import VirtualSwarm

    fleet = ArenaFleet([[0.7 * (k % 5), 0.7 * (k // 5), 0.0] for k in range(flights)])
    fleet.advance(10)
    server = VirtualServer(VirtualSwarm(fleet, feed_rate=100.0), port=0)
    server.start()
    programs: list[subprocess.Popen[str]] = []
    burners: list[multiprocessing.Process] = []
    folder = runtime_folder()
    try:
        for uri in server.uris:
            programs.append(
                subprocess.Popen(
                    [sys.executable, __file__, "--fly", uri], stdout=subprocess.PIPE, text=True
                )
            )
        names = [json.loads(p.stdout.readline())["name"] for p in programs if p.stdout]
        deadline = time.monotonic() + 120.0
        while any(fleet.true_pose(k).position[2] < 0.3 for k in range(flights)):
            if time.monotonic() > deadline:
                raise SystemExit("not all vehicles came up")
            time.sleep(0.1)
        for program in programs[:hung]:
            program.send_signal(signal.SIGSTOP)
        if loaded:
            burners = [multiprocessing.Process(target=_burn, daemon=True) for _ in range(4)]
            for burner in burners:
                burner.start()
        annoy(folder, names[hung:], messages)
        off: dict[int, float] = {}
        began = time.monotonic()
        caller = subprocess.Popen(
            [sys.executable, "-m", "crazyarena", "estop"], stdout=subprocess.DEVNULL
        )
        live = range(hung, flights)
        while len(off) < len(live) and time.monotonic() < began + 20.0:
            for k in live:
                if k not in off and not fleet.rows(k).motors.any():
                    off[k] = time.monotonic()
            time.sleep(0.001)
        code = caller.wait()
        if len(off) < len(live) or code != 0:
            raise SystemExit(f"{len(live) - len(off)} vehicles were not stopped; exit code {code}")
        sent = [json.loads(p.stdout.readline())["sent"] for p in programs[hung:] if p.stdout]
        return (
            [off[k] - began for k in live],
            [off[k] - min(sent) for k in live],
            [time.monotonic() - began],
        )
    finally:
        for program in programs:
            program.kill()
            program.wait()
        for burner in burners:
            burner.kill()
            burner.join()
        server.close()


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--hung", type=int, default=10)
    parser.add_argument("--messages", type=int, default=10_000)
    parser.add_argument("--load", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--fly", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.fly:
        fly(options.fly)
        return
    with tempfile.TemporaryDirectory(prefix="stop-") as name:
        os.environ[ONLY_PLACE] = name
        rounds = [
            one_round(options.flights, options.hung, options.messages, options.load)
            for _ in range(options.rounds)
        ]
    print("| s | p50 | p99 | max |\n|---|---|---|---|")
    titles = ("estop started to motors off", "first stop sent to motors off", "estop itself")
    for title, *parts in zip(titles, *rounds, strict=True):
        values = np.concatenate(parts)
        p50, p99 = np.percentile(values, [50, 99])
        print(f"| {title} ({len(values)}) | {p50:.3f} | {p99:.3f} | {values.max():.3f} |")


if __name__ == "__main__":
    main()
