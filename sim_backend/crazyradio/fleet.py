"""Radio links for a fleet: which vehicle is on which channel, and the air between them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from crazyarena.clock import Clock
from crazyarena.errors import InputError
from crazyarena.sim_backend.crazyradio.air import Air
from crazyarena.sim_backend.crazyradio.air_time import Rate, parse_rate
from crazyarena.sim_backend.crazyradio.dongle import CHANNELS
from crazyarena.sim_backend.crazyradio.link import RadioLink
from crazyarena.sim_backend.crtp.faults import Faults

BASE_ADDRESS = 0xE7E7E7E700
MAX_DONGLES = 8
_LINK = re.compile(r"radio://(\d{1,2})/(\d{1,3})/(250K|1M|2M)/([0-9A-Fa-f]{1,10})")


@dataclass(frozen=True, slots=True)
class RadioPlan:
    """Vehicles take the channels in turn, and each channel has a dongle, as far as there are."""

    channels: tuple[int, ...] = (80,)
    rate: Rate = Rate.M2
    dongles: int = 1

    def serials(self) -> tuple[str, ...]:
        """Serial numbers of the dongles."""
        return tuple(f"E7E70000{number:02d}" for number in range(1, self.dongles + 1))


def parse_plan(channels: str, rate: str, dongles: int) -> RadioPlan:
    """``80`` or ``80,90``, ``2M``, and the number of dongles.

    Raises
    ------
    InputError: naming the option, what was found and what would be right.
    """
    parts = [part.strip() for part in channels.split(",")]
    if not all(re.fullmatch(r"\d{1,3}", part) and int(part) < CHANNELS for part in parts):
        raise InputError(f"--channel: found {channels!r}; write channels 0 to 125, as 80 or 80,90")
    parsed = parse_rate(rate)
    if parsed is None:
        raise InputError(f"--rate: found {rate!r}; choose 250K, 1M or 2M")
    if not 1 <= dongles <= MAX_DONGLES:
        raise InputError(f"--dongles: found {dongles}; need 1 to {MAX_DONGLES}")
    return RadioPlan(tuple(map(int, parts)), parsed, dongles)


@dataclass(frozen=True, slots=True)
class Place:
    """Where a vehicle is to be found: dongle, channel, data rate and address."""

    dongle: int
    channel: int
    rate: Rate
    address: bytes


def parse_link(uri: str) -> Place | None:
    """Place of ``radio://0/80/2M/E7E7E7E701``; None for a link of another kind, or one that leaves
    anything to be guessed."""
    match = _LINK.fullmatch(uri.strip())
    if match is None or int(match[2]) >= CHANNELS or int(match[1]) >= MAX_DONGLES:
        return None
    rate = parse_rate(match[3])
    assert rate is not None
    return Place(int(match[1]), int(match[2]), rate, bytes.fromhex(match[4].rjust(10, "0")))


def put_on_air(
    ids: Sequence[int],
    clock: Clock,
    plan: RadioPlan | None = None,
    faults: Faults | None = None,
    seed: int = 0,
    uris: Sequence[str | None] | None = None,
) -> tuple[list[RadioLink], Air]:
    """Links of vehicles with these ids, and the air that they share.

    uris: where the vehicles are by a list of them, before what the plan says.
    """
    plan = plan or RadioPlan()
    links = []
    dongles = plan.dongles
    for index, ident in enumerate(ids):
        turn = index % len(plan.channels)
        address = (BASE_ADDRESS + ident).to_bytes(5, "big")
        place = Place(turn % plan.dongles, plan.channels[turn], plan.rate, address)
        if uris is not None:
            place = parse_link(uris[index] or "") or place
        dongles = max(dongles, place.dongle + 1)
        links.append(
            RadioLink(
                place.channel,
                place.rate,
                place.address,
                clock,
                replace(faults or Faults()),
                dongle=place.dongle,
                seed=seed + index,
            )
        )
    serials = replace(plan, dongles=dongles).serials()
    return links, Air([link.station for link in links], serials, seed)
