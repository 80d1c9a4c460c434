"""What goes over the channel between the runner and the flight process.

Pose frames are packed (there are hundreds a second); everything else is pickled. Both ends are
this program, and nobody else can get at a socket pair.
"""

from __future__ import annotations

import importlib
import pickle
import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from crazyarena.errors import CrazyarenaError
from crazyarena.mocap.source import SourceStatus
from crazyarena.types import Pose, PoseFrame, Telemetry

_FRAME, _OBJECT = b"F", b"O"
POSTED = -1
# Kind, bodies, markers, bytes of the pickled names, frame id, timestamp, received; the numbers
# behind it are aligned.
_HEAD = struct.Struct("<cxxxIIIqdd")


@dataclass(frozen=True, slots=True)
class Call:
    """Call ``name`` of the other side. ``number`` 0 wants no answer, :data:`POSTED` only to hear
    of a failure."""

    number: int
    name: str
    arguments: tuple[Any, ...] = ()


@dataclass(frozen=True, slots=True)
class Failure:
    """An exception on its way: where its class is defined, and its text."""

    module: str
    name: str
    text: str


@dataclass(frozen=True, slots=True)
class Reply:
    """Answer to the call of that number: a value, or what was raised."""

    number: int
    value: Any = None
    failure: Failure | None = None


@dataclass(frozen=True, slots=True)
class Status:
    """What the runner may want to know at any time, pushed so that it need not ask.

    verdict: why the run must end; over: the watchdog has brought the vehicle to a safe end;
    stopped: source of the emergency stop; held: when the operator last held the dead-man's
    key, s on the session clock; ladder: where the watchdog's stands, by name.
    """

    telemetry: Telemetry
    source: SourceStatus
    verdict: str | None = None
    over: bool = False
    stopped: str | None = None
    held: float = -np.inf
    ladder: str = "NONE"


Message = PoseFrame | Call | Reply | Status


def encode(message: Message) -> bytes:
    """Return a message as bytes."""
    if isinstance(message, PoseFrame):
        return _encode_frame(message)
    return _OBJECT + pickle.dumps(message, protocol=5)


def decode(data: bytes) -> Message:
    """Read what :func:`encode` has made."""
    if data[:1] == _FRAME:
        return _decode_frame(data)
    message: Message = pickle.loads(memoryview(data)[1:])
    return message


def _encode_frame(frame: PoseFrame) -> bytes:
    bodies = frame.bodies
    poses = np.empty((len(bodies), 7))
    for row, pose in zip(poses, bodies.values(), strict=True):
        row[:3] = pose.position
        row[3:] = pose.quaternion
    markers = np.ascontiguousarray(frame.markers, dtype=np.float64)
    names = _pack_names(tuple(bodies))
    head = _HEAD.pack(
        _FRAME,
        len(poses),
        len(markers),
        len(names),
        frame.frame_id,
        frame.timestamp,
        frame.received,
    )
    return b"".join((head, poses.tobytes(), markers.tobytes(), names))


def _decode_frame(data: bytes) -> PoseFrame:
    _, bodies, markers, names, frame_id, timestamp, received = _HEAD.unpack_from(data)
    numbers = np.frombuffer(data, np.float64, 7 * bodies + 3 * markers, _HEAD.size)
    poses = numbers[: 7 * bodies].reshape(bodies, 7)
    known = _unpack_names(data[len(data) - names :])
    return PoseFrame(
        timestamp,
        received,
        frame_id,
        {name: Pose(row[:3], row[3:]) for name, row in zip(known, poses, strict=True)},
        numbers[7 * bodies :].reshape(markers, 3),
    )


# Names stay the same from frame to frame.
@lru_cache(maxsize=64)
def _pack_names(names: tuple[str, ...]) -> bytes:
    return pickle.dumps(names)


@lru_cache(maxsize=64)
def _unpack_names(data: bytes) -> tuple[str, ...]:
    names: tuple[str, ...] = pickle.loads(data)
    return names


def failure(error: BaseException) -> Failure:
    """Describe an exception."""
    kind = type(error)
    return Failure(kind.__module__, kind.__qualname__, str(error))


def revive(failed: Failure) -> Exception:
    """Make an exception of the same type and text; one that is not ours becomes RuntimeError."""
    kind: Any = importlib.import_module(failed.module)
    for part in failed.name.split("."):
        kind = getattr(kind, part, None)
    if not (isinstance(kind, type) and issubclass(kind, CrazyarenaError)):
        return RuntimeError(f"in the flight process: {failed.name}: {failed.text}")
    # Some are made of other arguments than their text.
    error: Exception = kind.__new__(kind)
    error.args = (failed.text,)
    return error
