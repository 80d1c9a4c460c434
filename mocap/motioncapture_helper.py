"""The process in which the vendors' client code runs: ``python -m ...motioncapture_helper``.

Connecting and waiting in the ``motioncapture`` package can block for ever, the former while
holding the interpreter lock; a lost server can make its wait spin. So it lives in a process of
its own, which the session can always kill. Frames leave through the socket whose descriptor is
the first argument, one :mod:`crazyarena.mocap.wire` payload per message; text messages
(``error ...``, ``ready``) say what happens meanwhile.
"""

from __future__ import annotations

import ctypes
import json
import math
import os
import signal
import socket
import sys

import numpy as np

from crazyarena.mocap.stamps import host_id, host_time, new_run
from crazyarena.mocap.wire import encode
from crazyarena.types import Pose


def _silence() -> None:
    # Vendor libraries print to the session's terminal otherwise.
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)


def _die_with_parent() -> None:
    # A vendor client that spins would outlive a killed session and keep its ports.
    if sys.platform == "linux":
        set_death_signal = 1
        ctypes.CDLL(None).prctl(set_death_signal, signal.SIGKILL)


def main(
    descriptor: int, vendor: str, options: dict[str, str], latency: float, singly: bool
) -> None:
    """Connect, then forward every frame until the other end is gone.

    ``singly``: the protocol sends each body by itself; its client polls, and an empty frame
    says neither that nothing is seen nor that there is a server.
    """
    out = socket.socket(fileno=descriptor)
    _die_with_parent()
    _silence()
    try:
        import motioncapture
    except ImportError as error:
        out.send(f"missing {error}".encode())
        return
    try:
        client = motioncapture.connect(vendor, options)
    except Exception as error:
        out.send(f"error {error}".encode())
        return
    out.send(b"ready")
    host, run = host_id(), new_run()
    frame_id = 0
    while True:
        client.waitForNextFrame()
        now = host_time()
        bodies = {}
        for name, body in client.rigidBodies.items():
            position = np.array(body.position, dtype=float)
            turn = body.rotation
            quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
            norm = math.hypot(*quaternion.tolist())
            # Some vendors report an unseen body as NaN or as a zero quaternion.
            if np.isfinite(position).all() and 0.5 < norm < 2.0:
                bodies[name] = Pose(position, quaternion / norm)
        if singly and not bodies:
            continue
        payload = encode(frame_id, now - latency, now, host, run, bodies)
        frame_id += 1
        try:
            # Never wait for a session that does not read: the gap in the ids tells it.
            out.send(payload, socket.MSG_DONTWAIT)
        except BlockingIOError:
            continue
        except OSError:
            return


if __name__ == "__main__":
    main(
        int(sys.argv[1]),
        sys.argv[2],
        json.loads(sys.argv[3]),
        float(sys.argv[4]),
        sys.argv[5] == "singly",
    )
