"""What goes over the channel between runner and contestant.

The runner's messages are pickled: the contestant may trust the runner. Not the other way
round: a contestant's message is a fixed record of numbers, or text, and is checked as such.
One message is one packet of a SOCK_SEQPACKET socket.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.errors import CommandError
from crazyarena.runner.contestant.contract_2022.command_check import NONE, Asked, checked
from crazyarena.runner.contestant.contract_lsy.command_check import checked_command
from crazyarena.runner.contestant.contract_lsy.dialogue import Drawing, LsyAnswer
from crazyarena.runner.contestant.dialogue import Answer

MAX_TEXT = 48 * 1024
MAX_PACKET = MAX_TEXT + 64

READY, PID, MADE, ANSWER, FAILED, HOOKED, LEARNED = b"R", b"P", b"M", b"A", b"E", b"H", b"T"
LSY = b"L"
_ARGS = 13
_ANSWER = struct.Struct(f"<cqbdd{_ARGS}d")
_TEXT = struct.Struct("<cqdd")
_NO_COMMAND = -128
# Step, how many numbers the command has, finished, s of both calls, the command; then drawings,
# each with a head (kind, number of points, colour, size) and its points.
_LSY = struct.Struct(f"<cqbbdd{_ARGS}d")
_DRAWN = struct.Struct("<cH5d")
_DRAWINGS = b"D"  # after an answer of 2022, where what is drawn has changed
_DRAWN_KINDS = {"line": b"l", "points": b"p"}


class ChannelError(Exception):
    """The contestant's side sent something that is no message."""


@dataclass(frozen=True, slots=True)
class Text:
    """A message with words in it: ready (what is in force), made, failed, hooked or learned."""

    kind: bytes
    number: int
    seconds: float
    text: str


Message = Answer | LsyAnswer | Text | int


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


def encode_answer(answer: Answer, ticket: int | None = None) -> bytes:
    """``ticket``: what the question is known by on the channel; the number of its step if none."""
    number = answer.step if ticket is None else ticket
    if answer.error is not None:
        return encode_text(FAILED, answer.error, number, answer.seconds)
    verb, args = _NO_COMMAND, [0.0] * _ARGS
    if answer.asked is not None:
        verb = answer.asked.verb
        values = _arguments(answer.asked.command)
        args[: len(values)] = values
    times = answer.command_seconds, answer.learn_seconds
    packet = _ANSWER.pack(ANSWER, number, verb, *times, *args)
    if answer.drawings is not None:
        packet = _with_drawings(packet + _DRAWINGS, answer.drawings)
    return packet


def encode_lsy(answer: LsyAnswer, ticket: int | None = None) -> bytes:
    """An answer of a controller of lsy_drone_racing; drawings that have no room are left out.

    ``ticket``: as for :func:`encode_answer`.
    """
    number = answer.step if ticket is None else ticket
    if answer.error is not None:
        return encode_text(FAILED, answer.error, number, answer.seconds)
    command = [] if answer.command is None else answer.command.tolist()
    args = command + [0.0] * (_ARGS - len(command))
    times = answer.command_seconds, answer.callback_seconds
    packet = _LSY.pack(LSY, number, len(command), answer.finished, *times, *args)
    return _with_drawings(packet, answer.drawings)


def _with_drawings(packet: bytes, drawings: Sequence[Drawing]) -> bytes:
    """A packet with as many drawings as have room."""
    parts, length = [packet], len(packet)
    for drawing in drawings:
        kind = _DRAWN_KINDS.get(drawing.kind, b"p")
        head = _DRAWN.pack(kind, len(drawing.points), *drawing.rgba, drawing.size)
        points = np.ascontiguousarray(drawing.points, np.float64).tobytes()
        if length + len(head) + len(points) <= MAX_PACKET:
            parts += [head, points]
            length += len(head) + len(points)
    return b"".join(parts)


def _decode_lsy(packet: bytes) -> LsyAnswer:
    _, step, size, finished, command_seconds, callback_seconds, *args = _LSY.unpack_from(packet)
    if not (math.isfinite(command_seconds) and math.isfinite(callback_seconds)):
        raise ChannelError("an answer with times that are not finite")
    answer = LsyAnswer(step, finished=finished != 0)
    answer.command_seconds = max(0.0, command_seconds)
    answer.callback_seconds = max(0.0, callback_seconds)
    if size not in (0, 4, _ARGS):
        raise ChannelError(f"a command of {size} numbers")
    if size:
        try:
            answer.command = checked_command(args[:size], size, step)
        except CommandError as error:
            raise ChannelError(str(error)) from None
    answer.drawings = _drawings(packet, _LSY.size)
    return answer


def _drawings(packet: bytes, at: int) -> list[Drawing]:
    """Those that a packet ends with."""
    found = []
    while at < len(packet):
        if at + _DRAWN.size > len(packet):
            raise ChannelError("a drawing that is cut off")
        kind, count, red, green, blue, alpha, width = _DRAWN.unpack_from(packet, at)
        at += _DRAWN.size
        if at + 24 * count > len(packet):
            raise ChannelError("a drawing that is cut off")
        points = np.frombuffer(packet[at : at + 24 * count], np.float64)
        numbers = (red, green, blue, alpha, width)
        if not np.isfinite([*points, *numbers]).all():
            raise ChannelError("a drawing that is none")
        at += 24 * count
        name = "line" if kind == b"l" else "points"
        found.append(Drawing(name, points.reshape(-1, 3), (red, green, blue, alpha), width))
    return found


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


def decode(packet: bytes) -> Message:
    """Read a contestant's message; an int is the pid of its process.

    Raises
    ------
    ChannelError: it is none.
    """
    kind = packet[:1]
    drawn = packet[_ANSWER.size : _ANSWER.size + 1] == _DRAWINGS
    if kind == ANSWER and (len(packet) == _ANSWER.size or drawn):
        _, step, verb, command_seconds, learn_seconds, *args = _ANSWER.unpack_from(packet)
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
        answer = Answer(step, asked, None, 0.0, max(0.0, command_seconds), max(0.0, learn_seconds))
        if drawn:
            answer.drawings = _drawings(packet, _ANSWER.size + 1)
        return answer
    if kind == LSY and len(packet) >= _LSY.size:
        return _decode_lsy(packet)
    if kind in (READY, MADE, FAILED, HOOKED, LEARNED, PID) and len(packet) >= _TEXT.size:
        _, number, seconds, _ = _TEXT.unpack_from(packet)
        if not math.isfinite(seconds):
            raise ChannelError("a message with a time that is not finite")
        if kind == PID:
            return number
        return Text(kind, number, max(0.0, seconds), packet[_TEXT.size :].decode(errors="replace"))
    raise ChannelError(f"{len(packet)} bytes that are no message, starting {packet[:16]!r}")
