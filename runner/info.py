"""``initial_info``: what a contestant is told before the first episode."""

from __future__ import annotations

from collections.abc import Callable, ItemsView, ValuesView
from typing import Any

import numpy as np

from crazyarena.levels.contract import level_info
from crazyarena.levels.schema import Level
from crazyarena.runner.shims import CONTRACT


class _Lazy:
    """Stands in a dictionary for a value that is made when somebody asks for it."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self.make = make

    def __repr__(self) -> str:
        return "<made on access>"


class InitialInfo(dict[str, Any]):
    """A dictionary some of whose values cost something, and are made on first access."""

    def _made(self, key: str, value: Any) -> Any:
        if isinstance(value, _Lazy):
            value = value.make()
            super().__setitem__(key, value)
        return value

    def __getitem__(self, key: str) -> Any:
        return self._made(key, super().__getitem__(key))

    def get(self, key: str, default: Any = None) -> Any:
        return self._made(key, super().get(key, default))

    def pop(self, key: str, *default: Any) -> Any:
        if key in self:
            self[key]
        return super().pop(key, *default)

    def values(self) -> ValuesView[Any]:
        return {key: self[key] for key in self}.values()

    def items(self) -> ItemsView[str, Any]:
        return {key: self[key] for key in self}.items()

    def copy(self) -> InitialInfo:
        other = InitialInfo()
        for key, value in super().items():
            other[key] = value
        return other

    __copy__ = copy

    def __deepcopy__(self, memo: dict[int, Any]) -> InitialInfo:
        import copy

        other = InitialInfo()
        for key, value in super().items():
            other[key] = value if isinstance(value, _Lazy) else copy.deepcopy(value, memo)
        return other


class Canvas:
    """A private PyBullet client for controllers that draw; connected on first use only."""

    def __init__(self) -> None:
        self._client: int | None = None

    def client(self) -> int:
        """Client id; 0 where PyBullet is not installed (drawing then does nothing)."""
        if self._client is None:
            try:
                import pybullet
            except ImportError:
                return 0
            if hasattr(pybullet, "IS_STAND_IN"):
                return 0
            self._client = pybullet.connect(pybullet.DIRECT)
        return self._client

    def close(self) -> None:
        if self._client is not None:
            import pybullet

            pybullet.disconnect(self._client)
            self._client = None


def initial_info(level: Level, canvas: Canvas, start: np.ndarray) -> InitialInfo:
    """Build the dictionary.

    Parameters
    ----------
    level: what is flown; only nominal values are told.
    canvas: PyBullet client for ``pyb_client``, connected when the key is first read.
    start: (12,) true state at the start, for ``constraint_values``.

    ``symbolic_model`` and ``symbolic_constraints`` are made on first access, which raises
    DependencyMissing without CasADi.
    """
    info = InitialInfo(level_info(level))
    info["symbolic_model"] = _Lazy(lambda: _symbolic().model(level))
    info["symbolic_constraints"] = (
        _Lazy(lambda: _symbolic().constraints(level))
        if level.constraints.input or level.constraints.state
        else {}
    )
    if level.constraints.state:
        position = np.array([start[0], start[2], start[4]])
        low, high = np.array(level.arena.low), np.array(level.arena.high)
        info["constraint_values"] = np.round(np.concatenate([low - position, position - high]), 8)
    info["urdf_dir"] = str(CONTRACT)
    info["pyb_client"] = _Lazy(canvas.client)
    return info


def _symbolic() -> Any:
    from crazyarena.runner import symbolic

    return symbolic
