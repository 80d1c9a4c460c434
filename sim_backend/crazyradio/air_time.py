"""How long a Crazyradio takes: packets on the air, waits for acknowledgements, USB transfers.

Frames are those of Nordic's Enhanced ShockBurst as the product specification of the nRF24LU1+
gives them: a preamble byte, five of address, nine bits of control, the payload, two bytes of
CRC; 130 µs pass between any two frames while the chip turns round.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

SETTLE = 130e-6  # s, until the chip sends or receives
MAX_PAYLOAD = 32
_ARD_STEP = 250e-6  # s
_OVERHEAD_BITS = 8 * (1 + 5 + 2) + 9


class Rate(IntEnum):
    """Data rates by their number on the wire."""

    K250 = 0
    M1 = 1
    M2 = 2

    @property
    def bits_per_second(self) -> float:
        return (250e3, 1e6, 2e6)[self]

    @property
    def label(self) -> str:
        """As in a link: 250K, 1M, 2M."""
        return ("250K", "1M", "2M")[self]


def parse_rate(text: str) -> Rate | None:
    """Rate of a label, None for another text."""
    return {rate.label: rate for rate in Rate}.get(text.strip().upper())


def on_air(payload: int, rate: Rate) -> float:
    """Time in s that a frame with ``payload`` bytes occupies the channel."""
    return (_OVERHEAD_BITS + 8 * payload) / rate.bits_per_second


def ack_wait(setting: int, rate: Rate) -> float:
    """Wait in s for an acknowledgement by the byte of the ARD request: steps of 250 µs, or with
    bit 7 the length of the payload that it may carry."""
    if not setting & 0x80:
        return _ARD_STEP * ((setting & 0x0F) + 1)
    needed = SETTLE + on_air(min(setting & 0x7F, MAX_PAYLOAD), rate)
    steps = 1
    while steps * _ARD_STEP < needed:
        steps += 1
    return _ARD_STEP * min(steps, 16)


def sent(payload: int, rate: Rate) -> float:
    """From the order to send until the frame is out, s."""
    return SETTLE + on_air(payload, rate)


def acknowledged(payload: int, rate: Rate) -> float:
    """From the end of a frame until its acknowledgement with ``payload`` bytes is in, s."""
    return SETTLE + on_air(payload, rate)


@dataclass(frozen=True, slots=True)
class UsbTiming:
    """Duration of USB transfers of a full-speed dongle, s: estimates for a Crazyradio PA. A
    bulk write and a bulk read make an exchange; channel, rate and address are control transfers."""

    control: float = 0.7e-3
    write: float = 0.4e-3
    read: float = 0.4e-3
