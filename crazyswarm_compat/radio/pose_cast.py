"""Poses for everybody on a channel, in packed packets, where that spares air.

A packet to one vehicle takes a USB exchange of its own and a change of the dongle's address; two
packed packets with four poses go out in one transfer to all vehicles of a channel, which pick
their own by id. What a packet says is in millimetres, and nobody acknowledges it: the next pose
makes up for one that was lost.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from crazyarena.crazyswarm_compat.radio import packets as pk
from crazyarena.crazyswarm_compat.radio.dongle import Dongle
from crazyarena.types import Pose

# From so many vehicles on: fewer are served sooner by exchanges of their own.
WORTH = 3


@dataclass(frozen=True, slots=True)
class Member:
    """A vehicle's id in the fleet, and the last byte of its address, by which it knows itself."""

    vehicle: int
    ident: int


@dataclass(slots=True)
class Channel:
    """Vehicles that one frame reaches. due: when the next may go out, s."""

    dongle: Dongle
    channel: int
    rate: int
    members: list[Member] = field(default_factory=list)
    due: float = 0.0


class PoseCast:
    """Sends the poses of a fleet to channels that have enough vehicles.

    Parameters
    ----------
    channels: of the fleet, each with all its vehicles.
    rate: frames per second and vehicle, at most.
    """

    def __init__(self, channels: Sequence[Channel], rate: float) -> None:
        self._channels = [c for c in channels if len({m.ident for m in c.members}) >= WORTH]
        self._period = 1.0 / rate

    def send(self, poses: Mapping[int, Pose], now: float) -> set[int]:
        """Broadcast what can be; returns the vehicles that need no packet of their own.

        A pose without attitude, or out of the packet's range, is not broadcast; nor is the
        second of two vehicles with the same last byte of address.
        """
        served: set[int] = set()
        for channel in self._channels:
            entries: dict[int, Pose] = {}
            for member in channel.members:
                pose = poses.get(member.vehicle)
                if pose is None or member.ident in entries or not packable(pose):
                    continue
                entries[member.ident] = pose
                served.add(member.vehicle)
            if not entries or now < channel.due:
                continue
            # The raster is kept, so that a source at just this rate is not halved.
            channel.due = max(channel.due + self._period, now + 0.5 * self._period)
            frames = tuple(
                bytes((packet.port << 4 | packet.channel,)) + packet.data
                for packet in pk.packed_poses(list(entries.items()))
            )
            channel.dongle.broadcast(channel.channel, channel.rate, frames)
        return served


def packable(pose: Pose) -> bool:
    """Whether a packed packet can hold a pose."""
    norm = float(np.linalg.norm(pose.quaternion))
    inside = bool(np.isfinite(pose.position).all()) and np.abs(pose.position).max() <= 32.767
    return bool(inside) and np.isfinite(norm) and norm > 1e-6
