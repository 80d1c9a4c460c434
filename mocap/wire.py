"""The binary payload of one pose frame (zenoh, log files, our own helper process).

Version 1, little endian, no padding; docs/mocap.md repeats this table.

====================  =======  ==========================================================
field                 type     meaning
====================  =======  ==========================================================
magic                 4 bytes  ``CAPF``
version               u8       1
flags                 u8       bit 0: signed (readers refuse other bits)
bodies                u16      B, rigid bodies seen in this frame
markers               u32      M, unlabelled markers
names                 u32      N, bytes of the name table
frame_id              u64      counts up by one per frame
host                  u64      identity of the host whose monotonic clock stamped the frame
run                   u64      drawn at random by each publisher: a new one starts new ids
captured              f64      s, host clock: when the cameras exposed
sent                  f64      s, host clock: when the frame was published
poses                 7f64 B   x, y, z in m; qx, qy, qz, qw (body to world)
marker positions      3f64 M   x, y, z in m
name table            N bytes  per body: u8 length, UTF-8 text
checksum              u32      CRC-32 (zlib) of everything before it
mac                   32 bytes only if signed: HMAC-SHA256 (RFC 2104) of everything before
====================  =======  ==========================================================
"""

from __future__ import annotations

import hashlib
import hmac
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from crazyarena.types import Pose, Vector

MAGIC = b"CAPF"
VERSION = 1
MAX_BODIES = 1024
MAX_MARKERS = 16384
MAX_NAME = 255
_HEADER = struct.Struct("<4sBBHIIQQQdd")
_CHECKSUM = struct.Struct("<I")
_SIGNED = 1
_MAC = hashlib.sha256().digest_size
# A unit quaternion sent as float32 by a vendor is off by 1e-7; anything beyond this is
# a decoding mistake on the sender's side.
_NORM_TOLERANCE = 1e-3


class PayloadError(ValueError):
    """A payload is not a pose frame; the message says which field is wrong."""


@dataclass(frozen=True, slots=True)
class WireFrame:
    """A decoded payload; times in s on the clock of ``host``."""

    frame_id: int
    host: int
    run: int
    captured: float
    sent: float
    bodies: Mapping[str, Pose]
    markers: Vector


@lru_cache(maxsize=64)
def encode_names(names: tuple[str, ...]) -> bytes:
    """Return the name table; raises PayloadError for a name that is empty or too long."""
    table = bytearray()
    for name in names:
        text = name.encode()
        if not 0 < len(text) <= MAX_NAME:
            raise PayloadError(f"body name {name!r}: need 1 to {MAX_NAME} bytes of UTF-8")
        table.append(len(text))
        table += text
    return bytes(table)


def encode(
    frame_id: int,
    captured: float,
    sent: float,
    host: int,
    run: int,
    bodies: Mapping[str, Pose],
    markers: Vector | None = None,
    secret: bytes | None = None,
) -> bytes:
    """Return the payload of one frame (layout in the module's docstring), signed by ``secret``."""
    count = len(bodies)
    points = np.empty((0, 3)) if markers is None else np.ascontiguousarray(markers, dtype="<f8")
    if count > MAX_BODIES or len(points) > MAX_MARKERS:
        raise PayloadError(
            f"{count} bodies and {len(points)} markers: at most {MAX_BODIES} and {MAX_MARKERS}"
        )
    block = np.empty((count, 7), dtype="<f8")
    for row, pose in enumerate(bodies.values()):
        block[row, :3] = pose.position
        block[row, 3:] = pose.quaternion
    names = encode_names(tuple(bodies))
    payload = b"".join(
        (
            _HEADER.pack(
                MAGIC,
                VERSION,
                0 if secret is None else _SIGNED,
                count,
                len(points),
                len(names),
                frame_id,
                host,
                run,
                captured,
                sent,
            ),
            block.tobytes(),
            points.tobytes(),
            names,
        )
    )
    payload += _CHECKSUM.pack(zlib.crc32(payload))
    return payload if secret is None else payload + _mac(secret, payload)


def _mac(secret: bytes, payload: bytes | memoryview) -> bytes:
    return hmac.digest(secret, payload, "sha256")


# Names stay the same from frame to frame.
@lru_cache(maxsize=64)
def _decode_names(table: bytes, count: int) -> tuple[str, ...]:
    names = []
    at = 0
    for _ in range(count):
        if at >= len(table):
            raise PayloadError("name table ends early")
        length = table[at]
        text = table[at + 1 : at + 1 + length]
        if length == 0 or len(text) != length:
            raise PayloadError("name table holds an empty or cut name")
        try:
            names.append(text.decode())
        except UnicodeDecodeError as error:
            raise PayloadError(f"name is not UTF-8: {error}") from None
        at += 1 + length
    if at != len(table):
        raise PayloadError(f"{len(table) - at} bytes after the last name")
    if len(set(names)) != count:
        raise PayloadError("a body name occurs twice")
    return tuple(names)


def decode(payload: bytes, secret: bytes | None = None) -> WireFrame:
    """Read one payload; with a ``secret`` only what was signed by it.

    Raises
    ------
    PayloadError: wrong magic, version, length, checksum, name, or a number that is not
        finite, or a quaternion whose norm is not 1; or it is not signed by ``secret``.
    """
    if len(payload) < _HEADER.size + _CHECKSUM.size:
        raise PayloadError(f"{len(payload)} bytes are too short for a frame")
    magic, version, flags, count, markers, names, frame_id, host, run, captured, sent = (
        _HEADER.unpack_from(payload)
    )
    if magic != MAGIC:
        raise PayloadError(f"magic {magic!r} is not {MAGIC!r}")
    if version != VERSION or flags & ~_SIGNED:
        raise PayloadError(f"version {version} flags {flags}: this reader knows {VERSION} and 0, 1")
    if secret is not None and not flags & _SIGNED:
        raise PayloadError("not signed; the publisher needs the same token")
    if flags & _SIGNED:
        if secret is not None and not hmac.compare_digest(
            _mac(secret, memoryview(payload)[:-_MAC]), payload[-_MAC:]
        ):
            raise PayloadError("not signed by the token that is asked for")
        payload = payload[:-_MAC]
    if count > MAX_BODIES or markers > MAX_MARKERS:
        raise PayloadError(f"{count} bodies and {markers} markers are more than allowed")
    expected = _HEADER.size + 56 * count + 24 * markers + names + _CHECKSUM.size
    if len(payload) != expected:
        raise PayloadError(f"{len(payload)} bytes where the header announces {expected}")
    (checksum,) = _CHECKSUM.unpack_from(payload, expected - _CHECKSUM.size)
    if zlib.crc32(memoryview(payload)[: -_CHECKSUM.size]) != checksum:
        raise PayloadError("checksum does not match")
    numbers = np.frombuffer(payload, "<f8", 7 * count + 3 * markers, _HEADER.size)
    if not (np.isfinite(numbers).all() and abs(captured) < 1e15 and abs(sent) < 1e15):
        raise PayloadError("a number is not finite")
    numbers = numbers.astype(np.float64)
    block = numbers[: 7 * count].reshape(count, 7)
    quaternions = block[:, 3:]
    squared = np.einsum("ij,ij->i", quaternions, quaternions)
    if count and np.abs(squared - 1.0).max() > 2.0 * _NORM_TOLERANCE:
        raise PayloadError(f"a quaternion has norm {np.sqrt(squared).tolist()}, not 1")
    at = _HEADER.size + 56 * count + 24 * markers
    table = _decode_names(payload[at : at + names], count)
    bodies = {name: Pose(row[:3], row[3:]) for name, row in zip(table, block, strict=True)}
    return WireFrame(
        frame_id, host, run, captured, sent, bodies, numbers[7 * count :].reshape(markers, 3)
    )
