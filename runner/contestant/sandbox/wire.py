"""What goes over the channel between runner and contestant.

The runner's messages are pickled: the contestant may trust the runner. Not the other way
round: a contestant's message is a fixed record of numbers, or text, and is checked as such.
One message is one packet of a SOCK_SEQPACKET socket.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.errors import CommandError
from crazyarena.runner.contestant.contract_2022.command_check import NONE, Asked, checked
from crazyarena.runner.contestant.dialogue import Answer

MAX_TEXT = 48 * 1024
MAX_PACKET = MAX_TEXT + 64

READY, PID, MADE, ANSWER, FAILED, HOOKED = b"R", b"P", b"M", b"A", b"E", b"H"
_ARGS = 13
_ANSWER = struct.Struct(f"<cqbdd{_ARGS}d")
_TEXT = struct.Struct("<cqdd")
_NO_COMMAND = -128


class ChannelError(Exception):
    """The contestant's side sent something that is no message."""


@dataclass(frozen=True, slots=True)
class Text:
    """A message with words in it: ready (what is in force), made, failed or hooked."""

    kind: bytes
    number: int
    seconds: float
    text: str


class _Verb:
    """Stands for a member of the contestant's ``Command``."""

    def __init__(self, value: int) -> None:
        self.value = value


def encode_text(kind: bytes, text: str, number: int = 0, seconds: float = 0.0) -> bytes:
    data = text.encode("utf-8", "replace")
    if len(data) > MAX_TEXT:
        # The end of a traceback says most.
        data = data[-MAX_TEXT:]
    return _TEXT.pack(kind, number, seconds, 0.0) + data


def encode_answer(answer: Answer) -> bytes:
    if answer.error is not None:
        return encode_text(FAILED, answer.error, answer.step, answer.seconds)
    verb, args = _NO_COMMAND, [0.0] * _ARGS
    if answer.asked is not None:
        verb = answer.asked.verb
        values = _arguments(answer.asked.command)
        args[: len(values)] = values
    return _ANSWER.pack(
        ANSWER, answer.step, verb, answer.command_seconds, answer.learn_seconds, *args
    )


def _arguments(command: cs.Command | None) -> list[float]:
    match command:
        case cs.FullState():
            return [
                *map(float, np.asarray(command.position)),
                *map(float, np.asarray(command.velocity)),
                *map(float, np.asarray(command.acceleration)),
                float(command.yaw),
                *map(float, np.asarray(command.omega)),
            ]
        case cs.Takeoff() | cs.Land():
            return [float(command.height), float(command.duration)]
        case cs.GoTo():
            place = map(float, np.asarray(command.position))
            return [*place, float(command.yaw), float(command.duration), float(command.relative)]
        case _:
            return []


def _contract_args(verb: int, a: tuple[float, ...]) -> list[Any]:
    if verb == 1:
        return [a[0:3], a[3:6], a[6:9], a[9], a[10:13]]
    if verb in (2, 3):
        return [a[0], a[1]]
    if verb == 5:
        return [a[0:3], a[3], a[4], a[5] != 0.0]
    return []


def decode(packet: bytes) -> Answer | Text | int:
    """Read a contestant's message; an int is the pid of its process.

    Raises
    ------
    ChannelError: it is none.
    """
    kind = packet[:1]
    if kind == ANSWER and len(packet) == _ANSWER.size:
        _, step, verb, command_seconds, learn_seconds, *args = _ANSWER.unpack(packet)
        if not (math.isfinite(command_seconds) and math.isfinite(learn_seconds)):
            raise ChannelError("an answer with times that are not finite")
        asked: Asked | None = None
        if verb != _NO_COMMAND:
            if verb <= NONE:
                args = []
            try:
                # Checked again: what the other side checked may have been changed since.
                asked = checked((_Verb(verb), _contract_args(verb, tuple(args))), step)
            except CommandError as error:
                raise ChannelError(str(error)) from None
        return Answer(step, asked, None, 0.0, max(0.0, command_seconds), max(0.0, learn_seconds))
    if kind in (READY, MADE, FAILED, HOOKED, PID) and len(packet) >= _TEXT.size:
        _, number, seconds, _ = _TEXT.unpack_from(packet)
        if not math.isfinite(seconds):
            raise ChannelError("a message with a time that is not finite")
        if kind == PID:
            return number
        return Text(kind, number, max(0.0, seconds), packet[_TEXT.size :].decode(errors="replace"))
    raise ChannelError(f"{len(packet)} bytes that are no message, starting {packet[:16]!r}")
