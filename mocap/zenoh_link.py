"""Pose frames over zenoh: one machine reads the cameras, any number of others listen.

The payload is :mod:`crazyarena.mocap.wire`; docs/mocap.md states key and quality of service.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from crazyarena.clock import Clock
from crazyarena.mocap.assembly import SAME, Assembler, take_assembled
from crazyarena.mocap.pin import PublisherPin
from crazyarena.mocap.source import FrameQueue, SourceState, SourceStatus
from crazyarena.mocap.stamps import HostStamps, StampReader, host_id, host_time, new_run
from crazyarena.mocap.wire import PayloadError, WireFrame, decode, encode
from crazyarena.mocap.zenoh_session import keep_thread_state, open_session
from crazyarena.secret import read_secret
from crazyarena.types import PoseFrame

DEFAULT_KEY = "crazyarena/mocap/frames"


class ZenohPublisher:
    """Publish pose frames.

    Frames carry the stamps of this host's monotonic clock and the ids given by the source, so
    a listener sees what was lost on the way. Sent reliably, in order, without batching, at
    real-time priority; a frame that cannot be handed over within 50 ms is dropped.

    Parameters
    ----------
    connect, listen, config: see :func:`crazyarena.mocap.zenoh_session.open_session`.
    token: file with a secret (:func:`crazyarena.secret.read_secret`) that signs every frame.
    """

    def __init__(
        self,
        clock: Clock,
        key: str = DEFAULT_KEY,
        connect: Sequence[str] = (),
        listen: Sequence[str] = (),
        session: Any = None,
        config: str | Path | None = None,
        token: str | Path | None = None,
    ) -> None:
        self._secret = None if token is None else read_secret(token)
        self._owns_session = session is None
        if session is None:
            session = open_session(connect, listen, config=config)
        self._session = session
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
                self._secret,
            )
        )

    def close(self) -> None:
        self._publisher.undeclare()
        if self._owns_session:
            self._session.close()


class _Order:
    """Signed frames come with growing numbers and times; what does not is a replay."""

    def __init__(self) -> None:
        self._run: int | None = None
        self._last_id = -1
        self._sent: dict[int, float] = {}

    def repeats(self, wire: WireFrame) -> bool:
        # A recording of an earlier run is older than anything that was heard from its host.
        if wire.sent <= self._sent.get(wire.host, -math.inf):
            return True
        if wire.run == self._run and wire.frame_id <= self._last_id:
            return True
        self._run, self._last_id = wire.run, wire.frame_id
        self._sent[wire.host] = wire.sent
        return False


class ZenohSource:
    """Listen to the frames of a :class:`ZenohPublisher` (or anything that speaks its payload).

    Malformed payloads are counted in ``status.malformed`` and dropped. zenoh restores broken
    connections by itself; a restarted publisher shows in ``status.reconnects``. Frames of another
    publisher than the first are ignored, and counted in ``status.foreign``, until that one has
    been silent for ``release_after``.

    Parameters
    ----------
    connect, listen, config: see :func:`crazyarena.mocap.zenoh_session.open_session`.
    token: file with a secret; frames that it has not signed, or that were sent before, are dropped.
    release_after: silence, s, after which a publisher counts as gone.
    """

    def __init__(
        self,
        clock: Clock,
        key: str = DEFAULT_KEY,
        connect: Sequence[str] = (),
        listen: Sequence[str] = (),
        session: Any = None,
        config: str | Path | None = None,
        token: str | Path | None = None,
        release_after: float = 0.5,
    ) -> None:
        self._secret = None if token is None else read_secret(token)
        self._owns_session = session is None
        if session is None:
            session = open_session(connect, listen, config=config)
        self._session = session
        import zenoh

        self._clock = clock
        self._pin = PublisherPin(release_after)
        self._order = _Order()
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
            wire = decode(sample.payload.to_bytes(), self._secret)
        except PayloadError as error:
            self._queue.reject(str(error))
            return
        if not self._pin.believes(wire.run, received):
            self._queue.turn_away(f"publisher {wire.run:016x} beside {self._pin.run:016x}")
            return
        if self._secret is not None and self._order.repeats(wire):
            self._queue.reject("a signed frame was sent before: somebody plays a recording")
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
