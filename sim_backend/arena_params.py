"""The parameters of an ``arena`` vehicle: their names, types and values."""

from __future__ import annotations

from crazyarena.errors import BackendError, CommandError
from crazyarena.sim_backend.firmware import stack_2026
from crazyarena.sim_backend.firmware.parameters import Param

YAW_MODE = "flightmode.stabModeYaw"
# Parameters of decks that scripts like to set; they have no effect on the flight.
_DECK_PARAMS = (
    Param("ring.effect", 6, 6, "uint8"),
    Param("ring.headlightEnable", 0, 0, "uint8"),
    Param("ring.solidRed", 20, 20, "uint8"),
    Param("ring.solidGreen", 20, 20, "uint8"),
    Param("ring.solidBlue", 20, 20, "uint8"),
    Param("led.bitmask", 0, 0, "uint8"),
)
# What the angles of the legacy attitude setpoint mean: 1 an angle, 0 a rate.
_COMMANDER_PARAMS = (Param(YAW_MODE, 0, 0, "uint8"),)
PARAMS = (*stack_2026.PARAMS, *_DECK_PARAMS, *_COMMANDER_PARAMS)
PARAM_INDEX = {param.name: i for i, param in enumerate(PARAMS)}
_INTEGER = {
    "uint8": (0, 2**8 - 1),
    "int8": (-(2**7), 2**7 - 1),
    "uint16": (0, 2**16 - 1),
    "int16": (-(2**15), 2**15 - 1),
    "uint32": (0, 2**32 - 1),
    "int32": (-(2**31), 2**31 - 1),
}


def param_index(name: str, vehicle: int) -> int:
    """Place of ``group.name`` in the parameter row; BackendError if there is none."""
    try:
        return PARAM_INDEX[name]
    except KeyError:
        raise BackendError(f"vehicle {vehicle}: no parameter {name!r}; see param_names()") from None


def param_value(index: int, value: float) -> float:
    """A stored value as a client reads it: an integer unless the type is float."""
    return value if PARAMS[index].ctype == "float" else int(value)


def param_to_store(index: int, value: float, vehicle: int) -> float:
    """The number that a vehicle stores; CommandError for a value beyond the type."""
    ctype = PARAMS[index].ctype
    if ctype == "float":
        return value
    low, high = _INTEGER[ctype]
    if not low <= value <= high:
        raise CommandError(
            f"vehicle {vehicle}: {PARAMS[index].name} is {value!r}; its type {ctype} holds "
            f"{low}..{high}"
        )
    return int(value)
