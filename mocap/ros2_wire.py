"""Poses as ROS 2 carries them over rmw_zenoh: keys, CDR payload, attachment. No ROS is needed.

* Key: ``<domain>/<topic>/<type>/<hash>``, e.g. ``0/poses/motion_capture_tracking_interfaces::msg::
  dds_::NamedPoseArray_/RIHS01_d4c8...`` (rmw_zenoh, docs/design.md).
* Payload: plain CDR (OMG DDS-XTypes 1.3, 7.4.1; 10.2 for the header): u8 0, u8 1 for little
  endian, 2 bytes of options; then members, each aligned to its own size counted from behind the
  header; texts as u32 length with the NUL; sequences as u32 count. ``NamedPoseArray``:
  ``std_msgs/Header`` (i32 s, u32 ns, text frame), sequence of ``NamedPose`` (text name, 3 f64
  position in m, 4 f64 quaternion x, y, z, w). ``NamedPoseArrayV2`` has u64 vendor time in us and
  a sequence of latencies (text, u32 us) before the poses.
* Attachment, little endian: i64 sequence number, i64 ns of sending, 16 bytes that name the
  publisher, the last with or without a length before them; early releases write each field's name
  before it.
"""

from __future__ import annotations

import hashlib
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from crazyarena.mocap.wire import MAX_BODIES, MAX_NAME, PayloadError
from crazyarena.types import Pose

PACKAGE = "motion_capture_tracking_interfaces"
TYPES = ("NamedPoseArray", "NamedPoseArrayV2")
_MAX_LATENCIES = 64
_GID = 16


@dataclass(frozen=True, slots=True)
class NamedPoses:
    """A message: ``stamp`` in s of the publisher's clock, and what it sees.

    A pose that is not finite, or has no attitude, is of a body that is not seen, and left out.
    """

    stamp: float
    bodies: Mapping[str, Pose]


@dataclass(frozen=True, slots=True)
class Sending:
    """An attachment: number and time (s) of sending, and 64 bits that name the publisher."""

    number: int
    sent: float
    publisher: int


def key(topic: str, domain: int, kind: str = "*") -> str:
    """Key expression of a topic for any hash of its type; ``kind`` one of :data:`TYPES`."""
    return f"{domain}/{topic.strip('/')}/{PACKAGE}::msg::dds_::{kind}_/*"


class _Reader:
    def __init__(self, payload: bytes) -> None:
        if len(payload) < 4 or payload[0] != 0 or payload[1] not in (0, 1):
            raise PayloadError(f"header {payload[:4].hex()} is not that of plain CDR")
        self._data = memoryview(payload)[4:]
        self._order = "<" if payload[1] == 1 else ">"
        self._at = 0

    def take(self, code: str, size: int, count: int = 1) -> tuple:
        self._at += -self._at % size
        end = self._at + size * count
        if end > len(self._data):
            raise PayloadError(f"message ends at byte {len(self._data) + 4}, within a field")
        numbers = struct.unpack_from(f"{self._order}{count}{code}", self._data, self._at)
        self._at = end
        return numbers

    def text(self, longest: int) -> str:
        (length,) = self.take("I", 4)
        if not 0 < length <= longest + 1 or self._at + length > len(self._data):
            raise PayloadError(f"a text of {length} bytes; at most {longest}")
        raw = bytes(self._data[self._at : self._at + length])
        self._at += length
        if raw[-1] != 0:
            raise PayloadError("a text does not end in NUL")
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError as error:
            raise PayloadError(f"a text is not UTF-8: {error.reason}") from None

    def count(self, most: int, what: str) -> int:
        (count,) = self.take("I", 4)
        if count > most:
            raise PayloadError(f"{count} {what}; at most {most}")
        return int(count)


def decode(payload: bytes, kind: str = "NamedPoseArray") -> NamedPoses:
    """Read a message of one of :data:`TYPES`.

    Raises
    ------
    PayloadError: it is none, is cut short, or names a body twice.
    """
    reader = _Reader(payload)
    seconds, nano = *reader.take("i", 4), *reader.take("I", 4)
    reader.text(MAX_NAME)
    if kind == "NamedPoseArrayV2":
        reader.take("Q", 8)
        for _ in range(reader.count(_MAX_LATENCIES, "latencies")):
            reader.text(MAX_NAME)
            reader.take("I", 4)
    bodies: dict[str, Pose] = {}
    names = set()
    for _ in range(reader.count(MAX_BODIES, "poses")):
        name = reader.text(MAX_NAME)
        numbers = np.array(reader.take("d", 8, 7))
        if not name or name in names:
            raise PayloadError(f"body name {name!r} is empty or occurs twice")
        names.add(name)
        norm = math.hypot(*numbers[3:].tolist()) if np.isfinite(numbers).all() else 0.0
        if 0.5 < norm < 2.0:
            bodies[name] = Pose(numbers[:3], numbers[3:] / norm)
    return NamedPoses(seconds + 1e-9 * nano, bodies)


def sending(attachment: bytes | None) -> Sending | None:
    """Read an attachment; None if there is none, or none that is known."""
    if attachment is None:
        return None
    fields = ("sequence_number", "source_timestamp", "source_gid")
    for name in fields:
        text = bytes((len(name),)) + name.encode()
        if text not in attachment:
            break
        attachment = attachment.replace(text, b"", 1)
    if len(attachment) == 16 + 1 + _GID and attachment[16] == _GID:
        attachment = attachment[:16] + attachment[17:]
    if len(attachment) != 16 + _GID:
        return None
    number, nano = struct.unpack_from("<qq", attachment)
    if number < 0:
        return None
    publisher = hashlib.sha256(attachment[16:]).digest()[:8]
    return Sending(number, 1e-9 * nano, int.from_bytes(publisher, "little"))
