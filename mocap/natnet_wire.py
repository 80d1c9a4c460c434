"""Packets of NatNet, OptiTrack's streaming protocol (bit streams 3.1, 4.0, 4.1 and 4.2).

Layout as the open clients read it. Little endian, UDP. Every packet: u16 message, u16 size of
what follows.

* Commands go to the command port (1510). 0 connect is answered by 1 server info: name (256 bytes),
  4 u8 application version, 4 u8 bit stream version, u64 ticks per second, u16 data port, u8 1 for
  multicast, 4 u8 group. 4 is answered by 5, the models. 10 keeps a unicast client subscribed. 2 is
  a command in words, answered by 3 (i32 0).
* 5 models: i32 count, each i32 kind (0 marker set, 1 rigid body), from 4.1 on u32 size of the
  rest. Marker set: name, i32 count, names. Rigid body: name, i32 id, i32 parent, 3 f32 offset, from
  4.2 on 4 f32 turn, i32 marker count, 3 f32 each, i32 label each, from 4.0 on name each.
* 7 frame: i32 number; then lists, each i32 count, from 4.1 on u32 size of the rest: marker sets
  (name, i32 count, 3 f32 each), unlabelled markers (3 f32), rigid bodies (i32 id, 3 f32 position
  in m, 4 f32 quaternion x, y, z, w, f32 mean error, i16 with bit 0 for tracked), skeletons, from
  4.1 on assets, labelled markers (u16 member, u16 model, 3 f32, f32 size, i16 flags, f32 residual),
  force plates, devices; u32 and u32 timecode, f64 s, 3 u64 ticks (exposure, received, sent), from
  4.1 on 2 u32 of PTP time or 0, i16 with bit 1 when the models have changed, i32 0.

Texts end in NUL.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

import numpy as np

from crazyarena.types import Pose, Vector

CONNECT, SERVER_INFO, REQUEST, RESPONSE, REQUEST_MODELS, MODELS = 0, 1, 2, 3, 4, 5
REQUEST_FRAME, FRAME, KEEP_ALIVE, UNRECOGNISED = 6, 7, 10, 100
VERSIONS = ((3, 1), (4, 0), (4, 1), (4, 2))
TICKS = 10_000_000
# Flags of labelled markers.
_SOLVED_BY_CLOUD, _HAS_MODEL, _UNLABELLED = 0x02, 0x08, 0x10
_HEADER = struct.Struct("<HH")
_BODY = struct.Struct("<i3f4ffh")
_MARKER = struct.Struct("<HH3ffhf")
# Largest UDP payload.
LARGEST = 65507

Version = tuple[int, int]


def packet(message: int, payload: bytes = b"") -> bytes:
    """Return one packet; raises ValueError if it does not fit into a datagram."""
    if len(payload) + _HEADER.size > LARGEST:
        raise ValueError(f"{len(payload)} bytes do not fit into a NatNet packet")
    return _HEADER.pack(message, len(payload)) + payload


def message_of(data: bytes) -> int | None:
    """Return the message number of a packet, None if it is too short for one."""
    return _HEADER.unpack_from(data)[0] if len(data) >= _HEADER.size else None


def _text(text: str) -> bytes:
    return text.encode() + b"\0"


def _listed(version: Version, items: Sequence[bytes]) -> bytes:
    body = b"".join(items)
    size = struct.pack("<I", len(body)) if version >= (4, 1) else b""
    return struct.pack("<i", len(items)) + size + body


def server_info(version: Version, data_port: int, group: str | None, name: str = "Motive") -> bytes:
    """Return the answer to connect; ``group`` None for unicast."""
    address = bytes(int(part) for part in (group or "0.0.0.0").split("."))
    return packet(
        SERVER_INFO,
        name.encode().ljust(256, b"\0")
        + bytes((3, 1, 0, 0))
        + bytes((*version, 0, 0))
        + struct.pack("<QHB", TICKS, data_port, group is not None)
        + address,
    )


def models(version: Version, markers: Mapping[str, Vector]) -> bytes:
    """Return the models: per body its name and the places of its markers, (k, 3), m.

    Ids are 1, 2, ... in the order of ``markers``.
    """
    datasets = []

    def add(kind: int, body: bytes) -> None:
        size = struct.pack("<I", len(body)) if version >= (4, 1) else b""
        datasets.append(struct.pack("<i", kind) + size + body)

    for number, (name, places) in enumerate(markers.items(), 1):
        labels = [f"Marker{i + 1}" for i in range(len(places))]
        add(0, _text(name) + struct.pack("<i", len(labels)) + b"".join(map(_text, labels)))
        body = _text(name) + struct.pack("<ii3f", number, -1, 0.0, 0.0, 0.0)
        if version >= (4, 2):
            body += struct.pack("<4f", 0.0, 0.0, 0.0, 1.0)
        body += struct.pack("<i", len(places)) + np.asarray(places, dtype="<f4").tobytes()
        body += bytes(4 * len(places))
        if version >= (4, 0):
            body += b"".join(map(_text, labels))
        add(1, body)
    return packet(MODELS, struct.pack("<i", len(datasets)) + b"".join(datasets))


def frame(
    version: Version,
    number: int,
    time: float,
    bodies: Mapping[str, Pose],
    labelled: Mapping[str, Vector],
    unlabelled: Vector,
    sent: float | None = None,
    changed: bool = False,
) -> bytes:
    """Return one frame in the axes of the stream.

    Parameters
    ----------
    time, sent: capture and transmission on the server's clock, s.
    bodies: poses of the bodies that are tracked.
    labelled: places of the markers (k, 3), m, of *every* body, in the order of :func:`models`.
    unlabelled: (m, 3), m.
    """
    sets, rows, points = [], [], []
    for index, (name, places) in enumerate(labelled.items(), 1):
        pose = bodies.get(name)
        known = np.asarray(places if pose is not None else np.zeros_like(places), dtype="<f4")
        sets.append(_text(name) + struct.pack("<i", len(known)) + known.tobytes())
        if pose is None:
            rows.append(_BODY.pack(index, 0, 0, 0, 0, 0, 0, 0, 0, 0))
            continue
        numbers = (*pose.position.tolist(), *pose.quaternion.tolist())
        rows.append(_BODY.pack(index, *numbers, 2e-4, 1))
        points += [
            _MARKER.pack(k, index, *place, 0.0095, _SOLVED_BY_CLOUD | _HAS_MODEL, 1e-4)
            for k, place in enumerate(np.asarray(places, dtype=float).tolist(), 1)
        ]
    loose = np.asarray(unlabelled, dtype=float).reshape(-1, 3)
    points += [
        _MARKER.pack(k, 0, *place, 0.0095, _SOLVED_BY_CLOUD | _UNLABELLED, 1e-4)
        for k, place in enumerate(loose.tolist(), 1)
    ]
    ticks = max(0, round(time * TICKS))
    away = max(ticks, round((time if sent is None else sent) * TICKS))
    parts = [
        struct.pack("<i", number & 0x7FFFFFFF),
        _listed(version, sets),
        _listed(version, [row.astype("<f4").tobytes() for row in loose]),
        _listed(version, rows),
        _listed(version, []),
        *([_listed(version, [])] if version >= (4, 1) else []),
        _listed(version, points),
        _listed(version, []),
        _listed(version, []),
        struct.pack("<IIdQQQ", 0, 0, max(0.0, time), ticks, ticks, away),
        # Precision time is that of PTP hardware: 0 for none.
        *([bytes(8)] if version >= (4, 1) else []),
        struct.pack("<hi", 2 if changed else 0, 0),
    ]
    return packet(FRAME, b"".join(parts))
