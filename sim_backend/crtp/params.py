"""Port 2: parameters; their table, values, defaults and persistent copies."""

from __future__ import annotations

import struct
from typing import ClassVar, Protocol

from crazyarena.sim_backend.crtp.packets import (
    EACCES,
    EINVAL,
    ENOENT,
    OK,
    Packet,
    Port,
    echo,
)
from crazyarena.sim_backend.crtp.toc import ParamEntry, Table, Toc, param_entries

_TOC, _READ, _WRITE, _MISC = range(4)
(
    _SET_BY_NAME,
    _VALUE_UPDATED,
    _EXTENDED_TYPE,
    _STORE,
    _STATE,
    _CLEAR,
    _DEFAULT,
    _EXTENDED_TYPE_V2,
    _DEFAULT_V2,
) = range(9)
_PERSISTENT = b"\x01"


class LiveParams(Protocol):
    """The parameters that the simulated firmware itself reads and writes."""

    def get_param(self, name: str) -> float | None:
        """Present value, or None if the simulation has no such parameter."""
        ...

    def set_param(self, name: str, value: float) -> None:
        """Set a parameter that the simulation has; others are ignored."""
        ...

    def boot_param(self, name: str) -> float | None:
        """What this vehicle's build boots with, where it is not what the table says."""
        ...


class ParamService:
    """Answers on port 2.

    Parameters
    ----------
    live: the simulated firmware. A parameter that it does not have only keeps its value here.
    stored: values by name kept over reboots; written by store and clear.
    table: whose parameters.
    """

    def __init__(
        self,
        live: LiveParams,
        stored: dict[str, float] | None = None,
        table: Table = Table.CF21,
    ) -> None:
        self.entries = param_entries(table)
        self._ids = {entry.name: i for i, entry in enumerate(self.entries)}
        self._live = live
        self.stored = {} if stored is None else stored
        self._toc = Toc(Port.PARAM, [entry.item for entry in self.entries])
        self._values: list[float] = []
        self.boot()

    def boot(self) -> None:
        """Take every value from the table, or from storage where there is one."""
        self._values = [self.stored.get(entry.name, self._booted(entry)) for entry in self.entries]
        for entry, value in zip(self.entries, self._values, strict=True):
            self._live.set_param(entry.name, value)

    def _booted(self, entry: ParamEntry) -> float:
        own = self._live.boot_param(entry.name)
        return entry.boot if own is None else own

    def get(self, ident: int) -> bytes:
        """Present value of a parameter as it travels."""
        entry = self.entries[ident]
        value = self._live.get_param(entry.name)
        return entry.ctype.pack(self._values[ident] if value is None else value)

    def set(self, ident: int, data: bytes) -> None:
        """Set a parameter from its value as it travels; struct.error if too short."""
        entry = self.entries[ident]
        value = entry.ctype.unpack(data)
        self._values[ident] = value
        self._live.set_param(entry.name, value)

    def notify(self, name: str) -> bytes:
        """Datagram by which the vehicle tells that it changed a parameter itself."""
        ident = self._ids[name]
        header = bytes((Port.PARAM << 4 | _MISC,))
        return header + struct.pack("<BH", _VALUE_UPDATED, ident) + self.get(ident)

    def handle(self, packet: Packet) -> list[bytes]:
        try:
            return self._HANDLERS[packet.channel](self, packet)
        except struct.error:
            # Too short for what it says to be.
            return []

    def _entry(self, packet: Packet, at: int) -> tuple[int, ParamEntry | None]:
        (ident,) = struct.unpack_from("<H", packet.data, at)
        return ident, self.entries[ident] if ident < len(self.entries) else None

    def _handle_toc(self, packet: Packet) -> list[bytes]:
        return self._toc.handle(packet)

    def _handle_read(self, packet: Packet) -> list[bytes]:
        ident, entry = self._entry(packet, 0)
        head = packet.data[:2]
        if entry is None:
            return [echo(packet, head + bytes((ENOENT,)))]
        return [echo(packet, head + bytes((OK,)) + self.get(ident))]

    def _handle_write(self, packet: Packet) -> list[bytes]:
        ident, entry = self._entry(packet, 0)
        if entry is None:
            return [echo(packet, packet.data[:2] + bytes((ENOENT,)))]
        if entry.read_only:
            return []
        self.set(ident, packet.data[2:])
        return [echo(packet, packet.data)]

    def _handle_misc(self, packet: Packet) -> list[bytes]:
        if not packet.data:
            return []
        command = packet.data[0]
        if command == _SET_BY_NAME:
            return self._set_by_name(packet)
        handler = self._MISC_HANDLERS.get(command)
        if handler is None:
            return []
        ident, entry = self._entry(packet, 1)
        answer = bytes((ENOENT,)) if entry is None else handler(self, ident, entry)
        return [echo(packet, packet.data[:3] + answer)]

    def _set_by_name(self, packet: Packet) -> list[bytes]:
        parts = packet.data[1:].split(b"\0", 2)
        if len(parts) < 3 or not parts[2]:
            return []
        group, name, value = parts
        ident = self._ids.get(f"{group.decode('latin-1')}.{name.decode('latin-1')}")
        if ident is None:
            status = ENOENT
        elif self.entries[ident].read_only:
            status = EACCES
        elif self.entries[ident].ctype.param != value[0]:
            status = EINVAL
        else:
            self.set(ident, value[1:])
            status = OK
        return [echo(packet, b"\0".join((b"\0" + group, name, bytes((status,)))))]

    def _extended_type(self, ident: int, entry: ParamEntry) -> bytes:
        return _PERSISTENT if entry.persistent else bytes((ENOENT,))

    def _extended_type_v2(self, ident: int, entry: ParamEntry) -> bytes:
        return bytes((OK,)) + _PERSISTENT if entry.persistent else bytes((ENOENT,))

    def _store(self, ident: int, entry: ParamEntry) -> bytes:
        if entry.read_only:
            return bytes((EACCES,))
        self.stored[entry.name] = entry.ctype.unpack(self.get(ident))
        return bytes((OK,))

    def _clear(self, ident: int, entry: ParamEntry) -> bytes:
        return bytes((ENOENT if self.stored.pop(entry.name, None) is None else OK,))

    def _state(self, ident: int, entry: ParamEntry) -> bytes:
        default = entry.ctype.pack(entry.default)
        stored = self.stored.get(entry.name)
        if stored is None:
            return b"\0" + default
        return b"\x01" + default + entry.ctype.pack(stored)

    def _default(self, ident: int, entry: ParamEntry) -> bytes:
        return bytes((ENOENT,)) if entry.read_only else entry.ctype.pack(entry.default)

    def _default_v2(self, ident: int, entry: ParamEntry) -> bytes:
        default = self._default(ident, entry)
        return default if entry.read_only else bytes((OK,)) + default

    _HANDLERS = (_handle_toc, _handle_read, _handle_write, _handle_misc)
    _MISC_HANDLERS: ClassVar = {
        _EXTENDED_TYPE: _extended_type,
        _EXTENDED_TYPE_V2: _extended_type_v2,
        _STORE: _store,
        _CLEAR: _clear,
        _STATE: _state,
        _DEFAULT: _default,
        _DEFAULT_V2: _default_v2,
    }
