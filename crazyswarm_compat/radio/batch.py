"""Many small requests to a vehicle, several under way at once.

The firmware answers requests for table entries and parameter values one by one and keeps no
state between them, so nothing obliges a client to wait for each answer before it asks on: at
50 ms each way that alone takes a minute.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from cflib.crazyflie.log import LogTocElement
from cflib.crazyflie.param import ParamTocElement
from cflib.crtp.crtpstack import CRTPPacket, CRTPPort

_TOC_CHANNEL = 0
_TOC_ITEM, _TOC_INFO = 2, 3
_INFO = struct.Struct("<HI")
_ELEMENTS = {CRTPPort.LOGGING: LogTocElement, CRTPPort.PARAM: ParamTocElement}


class Batch:
    """Sends requests whose answers begin with the request itself.

    Parameters
    ----------
    client: a cflib client with an open link; it repeats what is not answered.
    port, channel: of requests and answers.
    requests: payloads, all different.
    window: how many may be under way.
    answer: called with the payload of each answer, in cflib's thread.
    done: called when the last one is here.
    """

    def __init__(
        self,
        client: Any,
        port: int,
        channel: int,
        requests: Sequence[bytes],
        window: int,
        answer: Callable[[bytes], None],
        done: Callable[[], None],
    ) -> None:
        self._client = client
        self._address = port, channel
        self._waiting = deque(requests)
        self._open: set[bytes] = set()
        self._window = window
        self._answer = answer
        self._done = done
        self._finished = False

    def start(self) -> None:
        """Send the first ones."""
        self._client.add_header_callback(self._heard, *self._address)
        self._fill()

    def _fill(self) -> None:
        while self._waiting and len(self._open) < self._window:
            request = self._waiting.popleft()
            self._open.add(request)
            packet = CRTPPacket()
            packet.set_header(*self._address)
            packet.data = request
            self._client.send_packet(packet, expected_reply=tuple(request))
        if not self._open and not self._finished:
            # The callback stays: cflib would skip its neighbour if it were taken out now.
            self._finished = True
            self._done()

    def _heard(self, packet: Any) -> None:
        data = bytes(packet.data)
        found = next((request for request in self._open if data.startswith(request)), None)
        if found is None:
            return
        self._open.discard(found)
        self._answer(data)
        self._fill()


def fetch_toc(client: Any, port: int, cache: Any, window: int, done: Callable[[], None]) -> None:
    """Put the vehicle's table of contents of ``port`` into ``cache``, unless it is there."""

    def described(data: bytes) -> None:
        count, crc = _INFO.unpack_from(data, 1)
        if cache.fetch(crc):
            done()
            return
        table: dict[str, dict[str, Any]] = {}

        def item(data: bytes) -> None:
            (ident,) = struct.unpack_from("<H", data, 1)
            element = _ELEMENTS[port](ident, data[3:])
            table.setdefault(element.group, {})[element.name] = element

        def complete() -> None:
            cache.insert(crc, table)
            done()

        items = [struct.pack("<BH", _TOC_ITEM, ident) for ident in range(count)]
        Batch(client, port, _TOC_CHANNEL, items, window, item, complete).start()

    Batch(client, port, _TOC_CHANNEL, [bytes((_TOC_INFO,))], 1, described, lambda: None).start()


class TocStore:
    """Tables of contents of this connection, backed by cflib's cache on disk."""

    def __init__(self, disk: Any) -> None:
        self._disk = disk
        self._tables: dict[int, Any] = {}

    def fetch(self, crc: int) -> Any:
        """Table by its checksum, None if unknown."""
        return self._tables.get(crc) or self._disk.fetch(crc)

    def insert(self, crc: int, table: Any) -> None:
        """Keep a table, here and on disk."""
        self._tables[crc] = table
        self._disk.insert(crc, table)
