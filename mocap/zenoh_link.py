"""Pose frames over zenoh: one machine reads the cameras, any number of others listen.

The payload is :mod:`crazyarena.mocap.wire`; docs/mocap.md states key and quality of service.
"""

from __future__ import annotations

import ctypes
import json
import threading
from collections.abc import Sequence
from typing import Any

from crazyarena.clock import Clock
from crazyarena.errors import DependencyMissing, InputError
from crazyarena.mocap.assembly import SAME, Assembler, take_assembled
from crazyarena.mocap.source import FrameQueue, SourceState, SourceStatus
from crazyarena.mocap.stamps import HostStamps, StampReader, host_id, host_time, new_run
from crazyarena.mocap.wire import PayloadError, decode, encode
from crazyarena.types import PoseFrame

DEFAULT_KEY = "crazyarena/mocap/frames"
# Has an attribute in threads whose state is kept.
_kept = threading.local()


def open_session(connect: Sequence[str] = (), listen: Sequence[str] = ()) -> Any:
    """Open a zenoh peer session.

    Parameters
    ----------
    connect, listen: zenoh endpoints such as ``tcp/10.0.0.5:7447``. With any endpoint given,
        multicast discovery is off, so that a session never joins a stranger's network; with
        none, peers on the local network find each other.

    Raises
    ------
    InputError: an endpoint is malformed or cannot be listened on.
    """
    try:
        import zenoh
    except ImportError:
        raise DependencyMissing("eclipse-zenoh", "mocap", "motion capture over zenoh") from None
    config = zenoh.Config()
    try:
        if connect:
            config.insert_json5("connect/endpoints", json.dumps(list(connect)))
            # A listener that starts before its publisher keeps trying in the background.
            config.insert_json5("connect/exit_on_failure", "false")
            config.insert_json5("connect/timeout_ms", "-1")
            config.insert_json5(
                "connect/retry",
                "{period_init_ms: 100, period_max_ms: 1000, period_increase_factor: 1.5}",
            )
        if listen:
            config.insert_json5("listen/endpoints", json.dumps(list(listen)))
        elif connect:
            config.insert_json5("listen/endpoints", "[]")
        if connect or listen:
            config.insert_json5("scouting/multicast/enabled", "false")
        # As shipped, a frame is dropped when its two slots are taken for a millisecond, which
        # on a busy machine means lost frames. Sixteen slots hold 50 ms at 300 Hz.
        config.insert_json5("transport/link/tx/queue/size/real_time", "16")
        config.insert_json5(
            "transport/link/tx/queue/congestion_control/drop/wait_before_drop", "50000"
        )
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise InputError(
            f"zenoh endpoints connect={list(connect)} listen={list(listen)}: {error}; "
            "write them like tcp/10.0.0.5:7447"
        ) from None


def keep_thread_state() -> None:
    """Keep the interpreter's state of a thread that it did not start, until the thread ends.

    CPython makes one for every call that comes from such a thread and drops it afterwards, and
    both map memory: then the kernel makes all processors at work on the process forget its
    addresses, and waits for each of them, although a virtual one may not be running at all.
    """
    if not hasattr(_kept, "thread"):
        ctypes.pythonapi.PyGILState_Ensure()
        _kept.thread = True


class ZenohPublisher:
    """Publish pose frames.

    Frames carry the stamps of this host's monotonic clock and the ids given by the source, so
    a listener sees what was lost on the way. Sent reliably, in order, without batching, at
    real-time priority; a frame that cannot be handed over within 50 ms is dropped.
    """

    def __init__(
        self,
        clock: Clock,
        key: str = DEFAULT_KEY,
        connect: Sequence[str] = (),
        listen: Sequence[str] = (),
        session: Any = None,
    ) -> None:
        self._owns_session = session is None
        self._session = open_session(connect, listen) if session is None else session
        import zenoh

        self._stamps = HostStamps(clock)
        self._host = host_id()
        self._run = new_run()
        self._publisher = self._session.declare_publisher(
            key,
            encoding=zenoh.Encoding("application/x-crazyarena-poses;v=1"),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
            reliability=zenoh.Reliability.RELIABLE,
        )

    def publish(self, frame: PoseFrame) -> None:
        """Send one frame; returns at once."""
        captured = self._stamps.to_host(frame.timestamp)
        self._publisher.put(
            encode(
                frame.frame_id,
                captured,
                host_time(),
                self._host,
                self._run,
                frame.bodies,
                frame.markers,
            )
        )

    def close(self) -> None:
        self._publisher.undeclare()
        if self._owns_session:
            self._session.close()


class ZenohSource:
    """Listen to the frames of a :class:`ZenohPublisher` (or anything that speaks its payload).

    Malformed payloads are counted in ``status.malformed`` and dropped. zenoh restores broken
    connections by itself; a restarted publisher shows in ``status.reconnects``.
    """

    def __init__(
        self,
        clock: Clock,
        key: str = DEFAULT_KEY,
        connect: Sequence[str] = (),
        listen: Sequence[str] = (),
        session: Any = None,
    ) -> None:
        self._owns_session = session is None
        self._session = open_session(connect, listen) if session is None else session
        import zenoh

        self._clock = clock
        self._queue = FrameQueue()
        # Publishers may send each body by itself; equal stamps tell.
        self._assembler = Assembler(same=SAME, learn=True)
        self._reader = StampReader(clock)
        # Called in zenoh's own thread: handing over through one more thread costs latency.
        handler = zenoh.handlers.Callback(self._receive, indirect=False)
        self._subscriber = self._session.declare_subscriber(key, handler)

    def _receive(self, sample: Any) -> None:
        received = self._clock.now()
        keep_thread_state()
        try:
            wire = decode(sample.payload.to_bytes())
        except PayloadError as error:
            self._queue.reject(str(error))
            return
        captured = self._reader.capture_time(wire.host, wire.captured, wire.sent, received)
        self._queue.put(
            PoseFrame(captured, received, wire.frame_id, wire.bodies, wire.markers), wire.run
        )

    def frames(self, timeout: float = 0.0) -> list[PoseFrame]:
        return take_assembled(self._queue, self._assembler, self._clock, timeout)

    @property
    def status(self) -> SourceStatus:
        return self._queue.status

    def close(self) -> None:
        if self._queue.status.state is SourceState.CLOSED:
            return
        self._queue.close()
        self._subscriber.undeclare()
        if self._owns_session:
            self._session.close()
