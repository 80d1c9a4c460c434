"""The parameters of one vehicle: checked before they are written, read back afterwards."""

from __future__ import annotations

import math
import struct
import threading
from collections.abc import Callable
from typing import Any

from crazyarena.crazyswarm_compat.radio.client import Client
from crazyarena.errors import BackendError, CommandError


class Parameters:
    """Reads and writes parameters over whatever connection there is.

    Parameters
    ----------
    who: name of the vehicle, for messages.
    timeout: for the vehicle's answer, s.
    client: the present connection, None for none.
    later: ``later(verb, action)`` lets the sender thread run ``action`` when its turn comes.
    lost: ``lost(verb, reason)`` tells of a write that could not be sent.
    """

    def __init__(
        self,
        who: str,
        timeout: float,
        client: Callable[[], Client | None],
        later: Callable[[str, Callable[[], None]], None],
        lost: Callable[[str, str], None],
    ) -> None:
        self._who = who
        self._timeout = timeout
        self._client = client
        self._later = later
        self._lost = lost
        self._answered = threading.Condition()
        self._writes: dict[str, int] = {}

    def attach(self, client: Client) -> None:
        """Hear the answers on a new connection."""
        client.param.add_update_callback(cb=self._answer)

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
        kind = element.pytype
        try:
            if kind not in ("<f", "<d", "<e"):
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

    def _answer(self, name: str, _: str) -> None:
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
        if value is None:
            raise BackendError(f"{self._who}: the value of {name} has not arrived yet")
        return value

    def wait_written(self, name: str) -> None:
        """Block until the writes of a parameter are answered; BackendError if one is not."""
        timeout = self._timeout
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
