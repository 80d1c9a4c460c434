"""What virtual Crazyflies cost: share of one core, and whether they keep up with wall time.

Each vehicle is fed its pose at 100 Hz, flies on full-state setpoints at 100 Hz, hears of a peer
and answers an echo at 100 Hz, and sends two log blocks at 100 Hz; cameras publish at 120 Hz.

Run: python benchmarks/virtual_cf_load.py [--counts 1 10] [--seconds 10]
"""

from __future__ import annotations

import argparse
import contextlib
import os
import socket
import struct
import subprocess
import sys
import time

_SPACING_MM = 500
_LIMITS = {1: 15.0, 10: 100.0}  # % of one core
_LOG_SETUP = (
    "5d0601774700774800774900771c00",
    "5d0602775300775400775500775600",
    "5d030101",
    "5d030201",
)


def _cpu(pid: int) -> float:
    """CPU time of a process so far, s."""
    with open(f"/proc/{pid}/stat") as stat:
        fields = stat.read().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _full_state(y_mm: int) -> bytes:
    return b"\x7c\x06" + struct.pack("<hhhhhhhhhIhhh", 0, y_mm, 600, *[0] * 6, 3 << 30, 0, 0, 0)


def _exchange(sockets: list[socket.socket], seconds: float, talk: bool) -> int:
    """Talk to every vehicle at 100 Hz; returns the datagrams that came back."""
    begin, heard, k = time.monotonic(), 0, 0
    while time.monotonic() - begin < seconds:
        for index, link in enumerate(sockets):
            if talk:
                # Vehicles stand in a row along y.
                link.send(_full_state(_SPACING_MM * index))
                link.send(b"\x6e" + struct.pack("<Bhhh", 200, 9000, 9000, 1000))
                link.send(b"\xfc\x01\x02")
            with contextlib.suppress(BlockingIOError):
                while link.recv(64):
                    heard += 1
        k += 1
        time.sleep(max(0.0, begin + 0.01 * k - time.monotonic()))
    return heard


def measure(count: int, seconds: float) -> None:
    """Run ``count`` vehicles, idle and then flying, and print what they cost."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    process = subprocess.Popen(
        [sys.executable, "-m", "crazyarena", "virtual-cf", "--port", "0", "--count", str(count)]
        + ["--feed-poses", "100", "--mocap-endpoint", endpoint],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    sockets = []
    try:
        for _ in range(count):
            host, _, port = process.stdout.readline().strip()[6:].partition(":")
            link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            link.connect((host, int(port)))
            link.setblocking(False)
            sockets.append(link)
        shares = []
        heard = 0
        for talk in (False, True):
            if talk:
                for link in sockets:
                    for request in _LOG_SETUP:
                        link.send(bytes.fromhex(request))
            spent, begin = _cpu(process.pid), time.monotonic()
            heard = _exchange(sockets, seconds, talk)
            shares.append(100.0 * (_cpu(process.pid) - spent) / (time.monotonic() - begin))
        process.stdin.write("status\n")
        process.stdin.flush()
        pace = [process.stdout.readline().strip() for _ in range(count + 1)][-1]
    finally:
        process.terminate()
        process.wait()
        for link in sockets:
            link.close()
    limit = f" (asked: < {_LIMITS[count]:.0f} %)" if count in _LIMITS else ""
    print(f"{count} on the ground: {shares[0]:.1f} % of one core")
    print(f"{count} flying, with traffic: {shares[1]:.1f} % of one core{limit}, ", end="")
    print(f"{heard / seconds / count:.0f} datagrams/s from each; {pace}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=[1, 10])
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()
    for count in options.counts:
        measure(count, options.seconds)
    print(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


if __name__ == "__main__":
    main()
