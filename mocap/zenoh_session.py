"""Sessions of zenoh: by default nothing leaves this machine, and nobody is looked for."""

from __future__ import annotations

import ctypes
import json
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from crazyarena.errors import DependencyMissing, InputError

# Where a router, or a server of poses, usually listens on its own machine.
LOCAL = "tcp/127.0.0.1:7447"
# Where programs of one machine meet that were given no endpoint: the first one listens. Not the
# usual port, which must stay free for those.
MEETING = "tcp/127.0.0.1:7448"
# Has an attribute in threads whose state is kept.
_kept = threading.local()
_ANY_PORT = "tcp/127.0.0.1:0"
_RETRY = "{period_init_ms: 100, period_max_ms: 1000, period_increase_factor: 1.5}"


def open_session(
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    *,
    config: str | Path | None = None,
    network: bool = False,
) -> Any:
    """Open a zenoh peer session.

    Parameters
    ----------
    connect, listen: zenoh endpoints such as ``tcp/10.0.0.5:7447``. With none, programs of this
        machine meet at :data:`MEETING`, and find what listens at :data:`LOCAL`; nothing is
        listened to from outside.
    config: a zenoh configuration file (JSON5) to begin with: TLS, users and passwords, or
        endpoints, which hold if none are given here.
    network: with no endpoint at all, listen on all interfaces and look for peers on the local
        network by multicast. Never otherwise, unless ``config`` asks for it.

    Raises
    ------
    InputError: the file or an endpoint is malformed, or cannot be listened on.
    """
    try:
        import zenoh
    except ImportError:
        raise DependencyMissing("eclipse-zenoh", "mocap", "motion capture over zenoh") from None
    chosen = zenoh.Config() if config is None else _from_file(zenoh, Path(config))
    connect, listen = list(connect), list(listen)
    stated = chosen.get_json("listen/endpoints") != zenoh.Config().get_json("listen/endpoints")
    stated = stated or chosen.get_json("connect/endpoints") != "[]"
    try:
        local = not (connect or listen or stated or network)
        if local:
            connect, listen = [MEETING, LOCAL], [MEETING, _ANY_PORT]
            # One of them has the port, and tells each of the others where all are; when it
            # ends, the next program that starts takes its place.
            chosen.insert_json5("listen/exit_on_failure", "false")
            chosen.insert_json5("listen/timeout_ms", "0")
            # Nobody has to be there yet.
            chosen.insert_json5("open/return_conditions/connect_scouted", "false")
        if connect:
            chosen.insert_json5("connect/endpoints", json.dumps(connect))
            # A listener that starts before its publisher keeps trying in the background.
            chosen.insert_json5("connect/exit_on_failure", "false")
            chosen.insert_json5("connect/timeout_ms", "-1")
            chosen.insert_json5("connect/retry", _RETRY)
        if listen:
            chosen.insert_json5("listen/endpoints", json.dumps(listen))
        elif connect:
            chosen.insert_json5("listen/endpoints", "[]")
        looking = network and not (connect or listen or stated)
        if not looking and chosen.get_json("scouting/multicast/enabled") == "null":
            chosen.insert_json5("scouting/multicast/enabled", "false")
        # As shipped, a frame is dropped when its two slots are taken for a millisecond, which
        # on a busy machine means lost frames. Sixteen slots hold 50 ms at 300 Hz.
        chosen.insert_json5("transport/link/tx/queue/size/real_time", "16")
        chosen.insert_json5(
            "transport/link/tx/queue/congestion_control/drop/wait_before_drop", "50000"
        )
        return zenoh.open(chosen)
    except zenoh.ZError as error:
        raise InputError(
            f"zenoh endpoints connect={connect} listen={listen}: {error}; "
            "write them like tcp/10.0.0.5:7447"
        ) from None


def _from_file(zenoh: Any, path: Path) -> Any:
    if not path.is_file():
        raise InputError(f"{path}: no such zenoh configuration file")
    try:
        return zenoh.Config.from_file(str(path))
    except zenoh.ZError as error:
        text = " ".join(str(error).split())
        raise InputError(f"{path}: not a zenoh configuration (JSON5): {text}") from None


def keep_thread_state() -> None:
    """Keep the interpreter's state of a thread that it did not start, until the thread ends.

    CPython makes one for every call that comes from such a thread and drops it afterwards, and
    both map memory: then the kernel makes all processors at work on the process forget its
    addresses, and waits for each of them, although a virtual one may not be running at all.
    """
    if not hasattr(_kept, "thread"):
        ctypes.pythonapi.PyGILState_Ensure()
        _kept.thread = True
