"""What can stop a flight, as chosen on the command line, opened in whichever process it belongs.

:class:`StopOptions` are plain data, so that they can be handed to another process; the keyboard
may stay in the one that has the terminal: ``options.without_keyboard()`` there and
``options.only_keyboard()`` here.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

from crazyarena.clock import Clock
from crazyarena.errors import DependencyMissing, InputError
from crazyarena.safety.estop import DeadMan, StopButton, say_loudly

if TYPE_CHECKING:
    from crazyarena.safety.rehearsal import Rehearsals


class DeadManBy(StrEnum):
    """What the operator holds."""

    KEY = "key"
    GAMEPAD = "gamepad"

    @property
    def hold(self) -> str:
        """What to tell the operator to hold."""
        return "h" if self is DeadManBy.KEY else "the gamepad's left shoulder button"


@dataclass(frozen=True, slots=True)
class StopOptions:
    """Sources of the emergency stop.

    Attributes
    ----------
    shell: ``crazyarena estop`` of the same user on this machine.
    keyboard: keys of the terminal.
    gamepad: device file, or ``auto`` for the first gamepad; None for none.
    dead_man: what the operator has to hold; None for nothing.
    network: over zenoh, with whoever is found on this network.
    connect, listen: over zenoh at these endpoints, with nobody else.
    token: file with the secret that stops over zenoh must prove to know; None lets anybody stop.
    session: what ``crazyarena estop`` calls this session.
    """

    shell: bool = True
    keyboard: bool = False
    gamepad: str | None = None
    dead_man: DeadManBy | None = None
    network: bool = False
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    token: Path | None = None
    session: str = ""

    @property
    def over_zenoh(self) -> bool:
        """Whether a zenoh session is opened."""
        return bool(self.network or self.connect or self.listen)

    def without_keyboard(self) -> StopOptions:
        """For a process that has no terminal; a dead-man's key is told to it by another."""
        return replace(self, keyboard=False)

    def only_local(self) -> StopOptions:
        """For simulated time, which runs faster than anybody can hold on."""
        return StopOptions(keyboard=self.keyboard, session=self.session)

    def only_keyboard(self) -> StopOptions:
        """For the process that has the terminal."""
        return StopOptions(
            shell=False,
            keyboard=self.keyboard,
            dead_man=self.dead_man if self.dead_man is DeadManBy.KEY else None,
        )

    def check(self, stream: int | None = None) -> None:
        """Find out now what could not be opened later; nothing stays open.

        Parameters
        ----------
        stream: the terminal; standard input by default.

        Raises
        ------
        InputError, DependencyMissing: with what to do about it.
        """
        from crazyarena.safety.estop_sources import keyboard_trouble, open_gamepad
        from crazyarena.safety.estop_token import read_secret

        if self.dead_man is DeadManBy.GAMEPAD and self.gamepad is None:
            raise InputError("--dead-man gamepad: no gamepad is asked for; add --gamepad auto")
        if self.keyboard or self.dead_man is DeadManBy.KEY:
            trouble = keyboard_trouble(_stdin() if stream is None else stream)
            if trouble is not None:
                hint = "" if self.dead_man is None else " Or hold a gamepad: --dead-man gamepad"
                raise InputError(f"stop by keyboard: {trouble}. Start it in a terminal.{hint}")
        if self.token is not None:
            if not self.over_zenoh:
                raise InputError(
                    "--stop-token: only stops over zenoh carry a token; add --stop-network, "
                    "--stop-connect or --stop-listen"
                )
            read_secret(self.token)
        if self.over_zenoh and importlib.util.find_spec("zenoh") is None:
            raise DependencyMissing("eclipse-zenoh", "mocap", "emergency stop over zenoh")
        if self.gamepad is not None:
            open_gamepad(self.gamepad).close()


@dataclass
class Stops:
    """Open sources.

    Attributes
    ----------
    dead_man: told by a source here or, for a key elsewhere, by whoever passes it on; None if
        nothing has to be held.
    notes: what is in force, a line each.
    refused: counts the messages that were refused so far.
    """

    dead_man: DeadMan | None = None
    notes: list[str] = field(default_factory=list)
    refused: Callable[[], int] = lambda: 0
    _closers: list[Callable[[], None]] = field(default_factory=list)

    def close(self) -> None:
        """Idempotent; last opened first."""
        while self._closers:
            self._closers.pop()()


def open_stops(
    options: StopOptions,
    stop: StopButton,
    clock: Clock,
    *,
    dead_man: DeadMan | None = None,
    stream: int | None = None,
    folder: Path | None = None,
    say: Callable[[str], None] = say_loudly,
    land: Callable[[str], None] | None = None,
) -> Stops:
    """Open every source asked for; all of them pull ``stop``, each in a thread of its own.

    Parameters
    ----------
    dead_man: the one to tell, if it exists already.
    stream: the terminal; standard input by default.
    folder: of the socket ``crazyarena estop`` looks for.
    say: told of a source that was tampered with or is gone, from its thread.
    land: brings down what flies, given the reason; None where nothing can.

    Raises
    ------
    InputError, DependencyMissing: a source cannot be opened; then none is.
    """
    from crazyarena.safety import estop_sources as sources
    from crazyarena.safety.estop_socket import SocketSource
    from crazyarena.safety.estop_token import TokenCheck, read_secret
    from crazyarena.safety.rehearsal import Rehearsals

    if options.dead_man is not None and dead_man is None:
        dead_man = DeadMan(clock)
    stop = _Remembered(stop, Rehearsals(folder))
    stops = Stops(dead_man)
    by_key = dead_man if options.dead_man is DeadManBy.KEY else None
    by_gamepad = dead_man if options.dead_man is DeadManBy.GAMEPAD else None
    with contextlib.ExitStack() as undo:
        undo.callback(stops.close)
        if options.shell:
            stops._closers.append(SocketSource(stop, folder, say, land).close)
            stops.notes.append("crazyarena estop in another shell stops the motors")
        if options.gamepad is not None:
            device = sources.open_gamepad(options.gamepad)
            stops._closers.append(sources.GamepadSource(stop, by_gamepad, device, say=say).close)
            stops.notes.append(f"button B of {device.name} stops the motors")
        if options.over_zenoh:
            secret = None if options.token is None else read_secret(options.token)
            check = TokenCheck(secret, label=options.session)
            source = sources.ZenohSource(stop, check, options.connect, options.listen)
            stops._closers.append(source.close)
            stops.refused = lambda: check.refused
            where = " ".join((*options.connect, *options.listen)) or "this network"
            proof = "with the token" if secret is not None else "from anybody (no token)"
            stops.notes.append(f"crazyarena estop over zenoh ({where}) {proof} stops the motors")
        if options.keyboard:
            terminal = _stdin() if stream is None else stream
            stops._closers.append(sources.KeyboardSource(stop, by_key, terminal, say).close)
            stops.notes.append("space, Enter, Escape or q stops the motors; Ctrl-C lands")
        undo.pop_all()
    return stops


class _Remembered:
    """A stop button that keeps in mind, beyond this process, that it was tried."""

    def __init__(self, stop: StopButton, rehearsals: Rehearsals) -> None:
        self.trigger = stop.trigger
        self.outcome = stop.outcome
        self._stop = stop
        self._rehearsals = rehearsals

    def tested(self) -> None:
        self._stop.tested()
        self._rehearsals.note_stop()


def _stdin() -> int:
    """File descriptor of standard input; -1, which is no terminal, if it has none."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        return sys.stdin.fileno()
    return -1


def has_keyboard() -> bool:
    """Whether somebody sits at a terminal in front of this process."""
    from crazyarena.safety.estop_sources import keyboard_trouble

    stream = _stdin()
    return stream >= 0 and os.isatty(stream) and keyboard_trouble(stream) is None
