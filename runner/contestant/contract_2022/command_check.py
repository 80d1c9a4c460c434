"""What a controller asked for: ``(Command, args)`` checked and turned into a typed command.

Verbs are told by name, then by value: the enumeration may be ours, the submission's own, or
loaded twice under two module names.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.errors import CommandError

VERBS = {
    "FINISHED": -1,
    "NONE": 0,
    "FULLSTATE": 1,
    "TAKEOFF": 2,
    "LAND": 3,
    "STOP": 4,
    "GOTO": 5,
    "NOTIFYSETPOINTSTOP": 6,
}
FINISHED = VERBS["FINISHED"]
NONE = VERBS["NONE"]
_VALUES = frozenset(VERBS.values())
_NAMES = {value: name for name, value in VERBS.items()}


class Asked:
    """One checked request.

    Attributes
    ----------
    verb: number of the competition's ``Command``.
    command: what goes to the backend, or None (NONE and FINISHED send nothing).
    """

    __slots__ = ("command", "verb")

    def __init__(self, verb: int, command: cs.Command | None) -> None:
        self.verb = verb
        self.command = command

    @property
    def name(self) -> str:
        return _NAMES[self.verb]


def verb_of(command: Any, step: int) -> int:
    """Return the number of a competition command; raises CommandError if it is none."""
    name = getattr(command, "name", None)
    verb = VERBS.get(name) if isinstance(name, str) else None
    if verb is None:
        value = getattr(command, "value", None)
        if isinstance(value, int) and value in _VALUES:
            return value
        raise CommandError(
            f"step {step}: cmdFirmware returned {_shown(command)} as its command; "
            f"expected a member of competition_utils.Command ({', '.join(VERBS)})"
        )
    return verb


def _shown(value: Any) -> str:
    text = repr(value)
    return f"{text if len(text) <= 80 else text[:77] + '...'} ({type(value).__name__})"


_NUMBERS = frozenset((float, int, np.float64, np.float32))
_FLOATS = np.dtype(np.float64)
_TEXTS = (str, bytes, bytearray)
_ROWS = (list, tuple)


def _is_text(value: Any) -> bool:
    """Whether NumPy or float() would read numbers out of text, which no vehicle of 2022 did."""
    if isinstance(value, np.ndarray):
        # Objects may be anything; of numbers the kind says it.
        return value.dtype.kind in "USO" and any(map(_is_text, value.ravel().tolist()))
    if isinstance(value, _ROWS):
        return any(type(each) not in _NUMBERS and _is_text(each) for each in value)
    return isinstance(value, _TEXTS)


def _number(value: Any, verb: str, argument: str, step: int, positive: bool = False) -> float:
    if type(value) not in _NUMBERS and _is_text(value):
        raise CommandError(
            f"step {step}: {verb} argument '{argument}' is text, {_shown(value)}; expected one "
            "number. Convert it with float()"
        )
    try:
        number = float(value) if not isinstance(value, np.ndarray) else float(value.item())
    except (TypeError, ValueError, OverflowError) as error:
        raise CommandError(
            f"step {step}: {verb} argument '{argument}' is {_shown(value)}; expected one number"
        ) from error
    if not math.isfinite(number):
        raise CommandError(
            f"step {step}: {verb} argument '{argument}' is {number}; expected a finite number"
        )
    if positive and number <= 0.0:
        raise CommandError(
            f"step {step}: {verb} argument '{argument}' is {number}; expected more than 0 s"
        )
    return number


def _vector(value: Any, verb: str, argument: str, step: int) -> NDArray[np.float64]:
    if not (type(value) is np.ndarray and value.dtype is _FLOATS) and _is_text(value):
        raise CommandError(
            f"step {step}: {verb} argument '{argument}' holds text, {_shown(value)}; expected "
            "three numbers. Convert them with float()"
        )
    try:
        # A copy: the controller may go on writing to its own array.
        vector = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise CommandError(
            f"step {step}: {verb} argument '{argument}' is {_shown(value)}; expected three numbers"
        ) from error
    if vector.shape != (3,):
        if vector.shape != (3, 1):
            raise CommandError(
                f"step {step}: {verb} argument '{argument}' has shape {vector.shape}; "
                "expected three numbers"
            )
        vector = vector.reshape(3)
    x, y, z = vector.tolist()
    if not math.isfinite(x + y + z) and not (
        math.isfinite(x) and math.isfinite(y) and math.isfinite(z)
    ):
        raise CommandError(
            f"step {step}: {verb} argument '{argument}' is [{x}, {y}, {z}]; expected finite numbers"
        )
    return vector


def _full_state(args: Any, step: int) -> cs.Command:
    verb = "FULLSTATE"
    return cs.FullState(
        position=_vector(args[0], verb, "position", step),
        velocity=_vector(args[1], verb, "velocity", step),
        acceleration=_vector(args[2], verb, "acceleration", step),
        yaw=_number(args[3], verb, "yaw", step),
        omega=_vector(args[4], verb, "rpy_rates", step),
    )


def _takeoff(args: Any, step: int) -> cs.Command:
    return cs.Takeoff(
        _number(args[0], "TAKEOFF", "height", step),
        _number(args[1], "TAKEOFF", "duration", step, positive=True),
    )


def _land(args: Any, step: int) -> cs.Command:
    return cs.Land(
        _number(args[0], "LAND", "height", step),
        _number(args[1], "LAND", "duration", step, positive=True),
    )


def _go_to(args: Any, step: int) -> cs.Command:
    relative = args[3]
    if not isinstance(relative, bool | np.bool_ | int):
        raise CommandError(
            f"step {step}: GOTO argument 'relative' is {_shown(relative)}; expected True or False"
        )
    return cs.GoTo(
        position=_vector(args[0], "GOTO", "position", step),
        yaw=_number(args[1], "GOTO", "yaw", step),
        duration=_number(args[2], "GOTO", "duration", step, positive=True),
        relative=bool(relative),
    )


_NO_ARGUMENTS = "no arguments: []"
_BUILDERS: dict[int, tuple[int, str, Callable[[Any, int], cs.Command | None]]] = {
    -1: (0, _NO_ARGUMENTS, lambda args, step: None),
    0: (0, _NO_ARGUMENTS, lambda args, step: None),
    1: (5, "5 arguments: [pos 3, vel 3, acc 3, yaw, rpy_rates 3]", _full_state),
    2: (2, "2 arguments: [height, duration]", _takeoff),
    3: (2, "2 arguments: [height, duration]", _land),
    4: (0, _NO_ARGUMENTS, lambda args, step: cs.Stop()),
    5: (4, "4 arguments: [[x, y, z], yaw, duration, relative]", _go_to),
    6: (0, _NO_ARGUMENTS, lambda args, step: cs.NotifySetpointsStop()),
}


def checked(returned: Any, step: int) -> Asked:
    """Check what ``cmdFirmware`` returned at control step ``step``.

    Raises
    ------
    CommandError: names the step, the command, the argument, what was found and what is right.
    """
    if not isinstance(returned, tuple | list) or len(returned) != 2:
        raise CommandError(
            f"step {step}: cmdFirmware returned {_shown(returned)}; expected (Command, args)"
        )
    command, args = returned
    verb = verb_of(command, step)
    count, expected, build = _BUILDERS[verb]
    if args is None:
        args = ()
    try:
        given = len(args)
    except TypeError:
        raise CommandError(
            f"step {step}: arguments of {_NAMES[verb]} are {_shown(args)}; expected {expected}"
        ) from None
    if verb > NONE and given != count:
        raise CommandError(
            f"step {step}: {_NAMES[verb]} got {given} arguments; expected {expected}"
        )
    return Asked(verb, build(args, step))
