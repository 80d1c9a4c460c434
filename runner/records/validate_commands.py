"""Commands of the high-level commander in logs, as words: what a script asked for and when.

    takeoff HEIGHT DURATION | land HEIGHT DURATION | stop
    goto X Y Z YAW DURATION [relative]
    trajectory FILE [timescale=FACTOR] [relative] [reversed]

m, s, rad; FILE is a trajectory of Crazyswarm (a row of duration and 4 x 8 coefficients a piece),
beside the log.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.uav_trajectory import Trajectory
from crazyarena.errors import InputError
from crazyarena.runner.records.recorder import SENT_KINDS

FORMS = {
    "takeoff": "takeoff HEIGHT DURATION",
    "land": "land HEIGHT DURATION",
    "goto": "goto X Y Z YAW DURATION [relative]",
    "trajectory": "trajectory FILE [timescale=FACTOR] [relative] [reversed]",
    "stop": "stop",
}
_NUMBERS = {"takeoff": 2, "land": 2, "goto": 5, "stop": 0}
_NAMES = {"go_to": "goto", "start_trajectory": "trajectory"}


def read_commands(
    file: Path, told: Iterable[tuple[float, str, str]]
) -> tuple[tuple[float, c.Command], ...]:
    """Commands by time, s.

    ``told`` has time, words and the place in ``file`` for errors.

    Raises
    ------
    InputError: naming file, place, what was found and what is expected.
    """
    reader = _Reader(file)
    commands: list[tuple[float, c.Command]] = []
    for time, words, place in told:
        if not math.isfinite(time):
            raise InputError(f"{file}: {place}: expected a time in s, found {time:g}")
        commands += [(time, command) for command in reader.read(words, place)]
    return tuple(sorted(commands, key=lambda pair: pair[0]))


def end_of(commands: Sequence[tuple[float, c.Command]]) -> float:
    """When the last plan is flown out, or the last setpoint is sent, s."""
    lengths: dict[int, float] = {}
    end = -math.inf
    for time, command in commands:
        lasts = 0.0
        match command:
            case c.Takeoff() | c.Land() | c.GoTo():
                lasts = command.duration
            case c.UploadTrajectory():
                lengths[command.trajectory_id] = float(command.pieces[:, 0].sum())
            case c.StartTrajectory():
                lasts = command.timescale * lengths.get(command.trajectory_id, 0.0)
        end = max(end, time + lasts)
    return end


def sent_command(kind: int, args: NDArray[np.float64]) -> c.Command | None:
    """A command as our recordings have it (``runner/records/recorder.py``); None for others."""
    if not 1 <= kind <= len(SENT_KINDS):
        return None
    position = tuple(float(value) for value in args[:3])
    match SENT_KINDS[kind - 1]:
        case c.FullState:
            velocity, acceleration, omega = (
                tuple(float(value) for value in args[at : at + 3]) for at in (3, 6, 10)
            )
            return c.FullState(position, velocity, acceleration, float(args[9]), omega)
        case c.Position:
            return c.Position(position, float(args[3]))
        case c.VelocityWorld:
            return c.VelocityWorld(position, float(args[3]))
        case c.Takeoff | c.Land as verb:
            yaw = None if np.isnan(args[2]) else float(args[2])
            return verb(float(args[0]), float(args[1]), yaw=yaw)
        case c.GoTo:
            return c.GoTo(position, float(args[3]), float(args[4]), relative=bool(args[5]))
        case c.NotifySetpointsStop:
            return c.NotifySetpointsStop()
        case c.Stop:
            return c.Stop()
        case _:
            return None


class _Reader:
    def __init__(self, file: Path) -> None:
        self._file = file
        self._stored: dict[Path, int] = {}
        self._pieces = 0

    def read(self, words: str, place: str) -> list[c.Command]:
        first, *rest = words.split()
        verb = _NAMES.get(first.lower(), first.lower())
        if verb not in FORMS:
            raise self._wrong(place, words, "one of " + "; ".join(FORMS.values()))
        if verb == "trajectory":
            return self._trajectory(words, rest, place)
        relative = verb == "goto" and rest[-1:] == ["relative"]
        values = self._numbers(words, verb, rest[:-1] if relative else rest, place)
        match verb:
            case "takeoff":
                return [c.Takeoff(values[0], values[1])]
            case "land":
                return [c.Land(values[0], values[1])]
            case "goto":
                x, y, z, yaw, duration = values
                return [c.GoTo((x, y, z), yaw, duration, relative=relative)]
            case _:
                return [c.Stop()]

    def _numbers(self, words: str, verb: str, texts: Sequence[str], place: str) -> list[float]:
        try:
            values = [float(text) for text in texts]
        except ValueError:
            raise self._wrong(place, words, FORMS[verb]) from None
        lasting = verb == "stop" or (values and values[-1] > 0.0)
        if len(values) != _NUMBERS[verb] or not all(map(math.isfinite, values)) or not lasting:
            raise self._wrong(place, words, f"{FORMS[verb]}, a duration > 0")
        return values

    def _trajectory(self, words: str, rest: Sequence[str], place: str) -> list[c.Command]:
        names, timescale, switches = [], 1.0, set[str]()
        for word in rest:
            key, equals, value = word.partition("=")
            if key == "timescale" and equals:
                try:
                    timescale = float(value)
                except ValueError:
                    timescale = math.nan
            elif word in ("relative", "reversed"):
                switches.add(word)
            else:
                names.append(word)
        if len(names) != 1 or not (math.isfinite(timescale) and timescale > 0.0):
            raise self._wrong(place, words, FORMS["trajectory"])
        path = self._file.parent / names[0]
        store = self._store(path)
        flown = c.StartTrajectory(
            self._stored[path],
            timescale,
            reverse="reversed" in switches,
            relative="relative" in switches,
        )
        return [*store, flown]

    def _store(self, path: Path) -> list[c.Command]:
        """What uploads a trajectory, the first time it is named."""
        if path in self._stored:
            return []
        trajectory = Trajectory()
        trajectory.loadcsv(path)
        pieces = np.array(
            [
                np.concatenate(([p.duration], p.px.p, p.py.p, p.pz.p, p.pyaw.p))
                for p in trajectory.polynomials
            ]
        )
        self._stored[path] = number = len(self._stored)
        offset, self._pieces = self._pieces, self._pieces + len(pieces)
        return [c.UploadTrajectory(number, offset, pieces)]

    def _wrong(self, place: str, words: str, expected: str) -> InputError:
        return InputError(f"{self._file}: {place}: expected {expected}; found {words[:60]!r}")
