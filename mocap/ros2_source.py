"""Poses that ``motion_capture_tracking`` publishes in ROS 2, without ROS here.

Needs rmw_zenoh on the other side (``RMW_IMPLEMENTATION=rmw_zenoh_cpp``), whose router listens on
port 7447. :mod:`crazyarena.mocap.ros2_wire` has keys and layouts.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from crazyarena.clock import Clock
from crazyarena.errors import InputError
from crazyarena.mocap import ros2_wire
from crazyarena.mocap.assembly import SAME, Assembler, take_assembled
from crazyarena.mocap.frames import Convention, chosen_convention
from crazyarena.mocap.pin import PublisherPin
from crazyarena.mocap.source import FrameQueue, SourceState, SourceStatus
from crazyarena.mocap.stamps import StampReader
from crazyarena.mocap.wire import PayloadError
from crazyarena.mocap.zenoh_session import LOCAL, keep_thread_state, open_session
from crazyarena.types import PoseFrame

# Never the identity of a host of ours: ROS stamps by the wall clock, also on this machine.
_STRANGER = 0
# Messages over which the fastest is sought: ROS' clock is disciplined, so a long look back is good.
_WINDOW = 4096
# A header stamped further from the sending has the cameras' clock, not ROS', s.
_ONE_CLOCK = 1.0


class Ros2Source:
    """Bodies of a ``NamedPoseArray`` topic.

    The capture time is the header's stamp. The offset of its clock is that of the fastest
    recent message, so ages are counted from that one's. Frames of another publisher than the
    first are ignored until that one has been silent for ``release_after``.

    Parameters
    ----------
    clock: the session clock.
    topic: its name with namespace. domain: ``ROS_DOMAIN_ID``; by default the environment's, or 0.
    connect, listen, config: see :func:`crazyarena.mocap.zenoh_session.open_session`; by default
        the router of this machine.
    latency: known time from exposure to the fastest arrival here, s.
    convention: axes, units and offsets; None to take poses as they come. axes: ``z-up`` or
        ``y-up``, short for a convention with these axes only.
    release_after: silence, s, after which a publisher counts as gone.

    Raises
    ------
    InputError: an option is wrong, or an endpoint.
    """

    def __init__(
        self,
        clock: Clock,
        topic: str = "poses",
        domain: int | str | None = None,
        connect: Sequence[str] = (),
        listen: Sequence[str] = (),
        config: str | Path | None = None,
        latency: float = 0.0,
        convention: Convention | None = None,
        axes: str | None = None,
        release_after: float = 0.5,
        session: Any = None,
    ) -> None:
        number = _domain(domain)
        if not topic.strip("/") or set(topic) & set("*$?# "):
            raise InputError(f"mocap topic: found {topic!r}; need a ROS topic such as /poses")
        self._clock = clock
        self._latency = latency
        self._convention = chosen_convention(convention, axes)
        self._pin = PublisherPin(release_after)
        self._queue = FrameQueue()
        self._assembler = Assembler(same=SAME, learn=True)
        self._reader = StampReader(clock, _WINDOW, assumed_transit=0.0)
        self._count = 0
        self._owns_session = session is None
        if session is None:
            if not (connect or listen or config):
                connect = [LOCAL]
            session = open_session(connect, listen, config=config)
        self._session = session
        import zenoh

        self._subscribers = [
            session.declare_subscriber(
                ros2_wire.key(topic, number, kind),
                zenoh.handlers.Callback(partial(self._receive, kind), indirect=False),
            )
            for kind in ros2_wire.TYPES
        ]

    def _receive(self, kind: str, sample: Any) -> None:
        received = self._clock.now()
        keep_thread_state()
        try:
            message = ros2_wire.decode(sample.payload.to_bytes(), kind)
        except PayloadError as error:
            self._queue.reject(f"{sample.key_expr}: {error}")
            return
        attached = None if sample.attachment is None else sample.attachment.to_bytes()
        sending = ros2_wire.sending(attached)
        # Without attachment nobody can be told from another, nor a loss be seen.
        run = 0 if sending is None else sending.publisher
        if not self._pin.believes(run, received):
            self._queue.turn_away(f"publisher {run:016x} beside {self._pin.run:016x}")
            return
        sent = message.stamp
        if sending is not None and abs(sending.sent - message.stamp) < _ONE_CLOCK:
            sent = sending.sent
        captured = self._reader.capture_time(_STRANGER, message.stamp, sent, received)
        frame = PoseFrame(
            captured - self._latency,
            received,
            self._count if sending is None else sending.number,
            message.bodies,
        )
        self._count += 1
        self._queue.put(self._convention.frame(frame), run)

    def frames(self, timeout: float = 0.0) -> list[PoseFrame]:
        return take_assembled(self._queue, self._assembler, self._clock, timeout)

    @property
    def status(self) -> SourceStatus:
        return self._queue.status

    def close(self) -> None:
        if self._queue.status.state is SourceState.CLOSED:
            return
        self._queue.close()
        for subscriber in self._subscribers:
            subscriber.undeclare()
        if self._owns_session:
            self._session.close()


def _domain(domain: int | str | None) -> int:
    text = os.environ.get("ROS_DOMAIN_ID", "0") if domain is None else str(domain)
    if not text.isdecimal() or not 0 <= (number := int(text)) <= 232:
        raise InputError(f"mocap domain: found {text!r}; need ROS_DOMAIN_ID, 0 to 232")
    return number
