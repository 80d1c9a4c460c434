"""Firmware functions by the names of the original bindings: planner, polynomials, vectors."""

from crazyarena.crazyswarm_compat.registry import firmware_bindings

_bindings = firmware_bindings()


def __getattr__(name: str) -> object:
    return getattr(_bindings, name)


def __dir__() -> list[str]:
    return sorted(name for name in vars(_bindings) if not name.startswith("_"))
