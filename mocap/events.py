"""What the mocap side tells the watchdog, the recorder and the operator."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class EventKind(StrEnum):
    """Kinds of :class:`MocapEvent`; the value is what logs show."""

    SOURCE_LIVE = "source_live"
    SOURCE_STALE = "source_stale"
    SOURCE_RECONNECTED = "source_reconnected"
    FOREIGN_PUBLISHER = "foreign_publisher"
    FRAMES_LOST = "frames_lost"
    BAD_FRAME = "bad_frame"
    BODY_TRACKED = "body_tracked"
    BODY_STALE = "body_stale"
    BODY_RECOVERED = "body_recovered"
    BODY_FROZEN = "body_frozen"
    JUMP_REJECTED = "jump_rejected"
    FLIP_REJECTED = "flip_rejected"
    SWAP_CORRECTED = "swap_corrected"


@dataclass(frozen=True, slots=True)
class MocapEvent:
    """One occurrence: ``time`` s on the session clock, ``body`` None for the whole source."""

    time: float
    kind: EventKind
    body: str | None
    message: str
