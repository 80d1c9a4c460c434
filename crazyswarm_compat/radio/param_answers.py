"""Which packet of a vehicle answers which request about a parameter.

A request that is not answered in time is sent again, so one may be answered twice. cflib takes any
packet about a parameter for the answer to what it asks of it now: a second answer to an earlier
question then passes for the acknowledgement of a write that is still on its way, with the value of
before. The firmware repeats what was written, and answers on the channel it was asked on; so an
answer can be told from another, and nothing else counts.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_READ, _WRITE = 1, 2
_ERROR_SIZE = 3  # id and error number

Heard = Callable[[Any], None]


class ParamAnswers:
    """Stands between cflib's dispatcher and its parameter thread, on one connection.

    Parameters
    ----------
    answered: called with the id (little-endian, as it travels) of what has been answered, after
        cflib has taken the value.
    """

    def __init__(self, answered: Callable[[bytes], None]) -> None:
        self._answered = answered
        self._asked: tuple[int, bytes] | None = None
        self._wide = True

    def asks(self, channel: int, data: bytes, wide: bool) -> None:
        """A request goes out, first or again; ``wide``: ids have 16 bits."""
        if channel in (_READ, _WRITE):
            self._asked, self._wide = (channel, data), wide

    def through(self, heard: Heard) -> Heard:
        """cflib's callback for packets about parameters, but that strays do not reach it."""

        def sift(packet: Any) -> None:
            if packet.channel not in (_READ, _WRITE):
                heard(packet)
                return
            asked, data = self._asked, bytes(packet.data)
            if asked is None or not self._answers(asked, packet.channel, data):
                return
            self._asked = None
            heard(packet)
            self._answered(data[: 2 if self._wide else 1])

        return sift

    def _answers(self, asked: tuple[int, bytes], channel: int, data: bytes) -> bool:
        kind, sent = asked
        if channel != kind:
            return False
        size = 2 if self._wide else 1
        if kind == _READ:
            return data[:size] == sent[:size]
        refused = self._wide and len(data) == _ERROR_SIZE != len(sent)
        return data == sent or (refused and data[:size] == sent[:size])
