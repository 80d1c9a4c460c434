"""The parameters of one vehicle: checked before they are written, read back afterwards."""

from __future__ import annotations

import math
import struct
import threading
from collections.abc import Callable
from typing import Any

from crazyarena.crazyswarm_compat.radio.client import Client
from crazyarena.errors import BackendError, CommandError

_FLOATS = ("<f", "<d", "<e")


class Parameters:
    """Reads and writes parameters over whatever connection there is.

    Parameters
    ----------
    who: name of the vehicle, for messages.
    timeout: for the vehicle's answer, s; longer where ``patience`` says that one takes longer.
    client: the present connection, None for none.
    later: ``later(verb, action)`` lets the sender thread run ``action`` when its turn comes.
    lost: ``lost(verb, reason)`` tells of a write that could not be sent.
    """

    def __init__(
        self,
        who: str,
        timeout: float,
        patience: Callable[[float], float],
        client: Callable[[], Client | None],
        later: Callable[[str, Callable[[], None]], None],
        lost: Callable[[str, str], None],
    ) -> None:
        self._who = who
        self._patience = lambda: max(timeout, 4.0 * patience(0.0))
        self._client = client
        self._later = later
        self._lost = lost
        self._answered = threading.Condition()
        self._writes: dict[str, int] = {}

    def attach(self, client: Client) -> None:
        """Hear the answers on a new connection; those of the old one come no more."""
        with self._answered:
            self._writes.clear()
        client.param_answered = self._answer

    def _element(self, name: str) -> Any:
        client = self._client()
        toc = None if client is None else client.param.toc
        group, _, variable = name.partition(".")
        element = None if toc is None else toc.get_element(group, variable)
        if element is None:
            raise BackendError(
                f"{self._who}: not connected, so parameter {name!r} is unknown"
                if client is None
                else f"{self._who}: no parameter {name!r} in this firmware"
            )
        return element

    def checked(self, name: str, value: float) -> float:
        """The value as the vehicle will store it.

        Raises
        ------
        CommandError
            if it is read-only or the value does not fit its type.
        BackendError
            if there is none of this name.
        """
        element = self._element(name)
        if element.access == element.RO_ACCESS:
            raise CommandError(f"{self._who}: parameter {name} is read-only")
        number = float(value)
        if not math.isfinite(number):
            raise CommandError(f"{self._who}: {name} is {value!r}; it must be a finite number")
        kind = element.pytype
        try:
            if kind not in _FLOATS:
                number = int(number)
            stored = struct.unpack(kind, struct.pack(kind, number))[0]
        except (struct.error, OverflowError):
            raise CommandError(
                f"{self._who}: {name} is {value!r}; that does not fit into its type {element.ctype}"
            ) from None
        return float(stored)

    def write_later(self, name: str, value: float) -> float:
        """Put a write on its way; returns the value as it will be stored."""
        stored = self.checked(name, value)
        with self._answered:
            self._writes[name] = self._writes.get(name, 0) + 1
        self._later(f"setParam {name}", lambda: self._write(name, stored))
        return stored

    def _write(self, name: str, value: float) -> None:
        client = self._client()
        if client is None or client.link is None:
            with self._answered:
                self._writes.pop(name, None)
            self._lost(f"setParam {name}", "not connected")
            return
        client.param.set_value(name, value)

    def _answer(self, name: str) -> None:
        with self._answered:
            left = self._writes.get(name, 0) - 1
            if left > 0:
                self._writes[name] = left
            else:
                self._writes.pop(name, None)
            self._answered.notify_all()

    def cached(self, name: str) -> float | None:
        """Last value that the vehicle told, None if it has no such parameter."""
        client = self._client()
        group, _, variable = name.partition(".")
        text = None if client is None else client.param.values.get(group, {}).get(variable)
        return None if text is None else float(text)

    def get(self, name: str) -> float:
        """Value of a parameter, after writes under way are answered (blocks for those).

        Raises
        ------
        BackendError
            if the vehicle has none of this name, or does not answer in time.
        """
        self._element(name)
        self.wait_written(name)
        value = self.cached(name)
        return self._read(name) if value is None else value

    def _read(self, name: str) -> float:
        client = self._client()
        if client is None or client.link is None:
            raise BackendError(f"{self._who}: not connected, so {name} cannot be read")
        # cflib takes it in its turn, so that its answer is not taken for that of a write.
        with self._answered:
            self._writes[name] = self._writes.get(name, 0) + 1
        client.param.request_param_update(name)
        with self._answered:
            self._answered.wait_for(lambda: name not in self._writes, self._patience())
        value = self.cached(name)
        if value is None:
            raise BackendError(f"{self._who}: {name} did not arrive within {self._patience():g} s")
        return value

    def names(self) -> tuple[str, ...]:
        """All parameters of the vehicle, as ``group.name``; none while not connected."""
        client = self._client()
        return () if client is None else client.param_names()

    def has(self, name: str) -> bool:
        """Whether the vehicle has this parameter, as far as is known."""
        return name in self.names()

    def whole(self, name: str) -> bool:
        """Whether a parameter holds whole numbers; BackendError if there is none."""
        return self._element(name).pytype not in _FLOATS

    def wait_written(self, name: str) -> None:
        """Block until the writes of a parameter are answered; BackendError if one is not."""
        timeout = self._patience()
        with self._answered:
            if not self._answered.wait_for(lambda: name not in self._writes, timeout):
                raise BackendError(
                    f"{self._who}: writing {name} was not acknowledged within {timeout:g} s"
                )

    def compare(self, name: str, stored: float) -> None:
        """Raise BackendError unless the vehicle tells the value that was written."""
        read = self.cached(name)
        if read is None or not math.isclose(read, stored, rel_tol=1e-6, abs_tol=1e-9):
            raise BackendError(f"{self._who}: wrote {stored} to {name}, but it reads {read}")
