"""What a controller draws with PyBullet: lines, and the spheres of waypoints.

PyBullet itself draws them nowhere here (its client has no window); they are remembered, for viewers
and recordings. Its functions go on returning what they always did.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

MOST = 300
"""Items that are remembered; of more the newest."""
_EVERY = 15  # steps, between news: some controllers draw at every step
_SELDOM = 60  # steps, of more than _FEW items
_FEW = 60
_RADIUS = 0.03  # m, of a waypoint
_RED = (1.0, 0.0, 0.0)
_TO_REMEMBER = "addUserDebugLine", "loadURDF"
_TO_FORGET = "removeUserDebugItem", "removeAllUserDebugItems", "removeBody"

Item = tuple[str, tuple[tuple[float, float, float], ...], tuple[float, float, float], float]
"""``line`` or ``points``, points m, colour 0..1, width (lines: pixels) or radius m."""


class Drawn:
    """Items by their kind and number, oldest first."""

    def __init__(self) -> None:
        self._items: dict[tuple[str, int], Item] = {}
        self._count = 0
        self._new = False
        self._told = -_EVERY

    def clear(self) -> None:
        """A controller is made anew, whose episode begins with an empty scene."""
        self._items.clear()
        self._new, self._told = False, -_EVERY

    def news(self, step: int) -> list[Item] | None:
        """All that is drawn now, if that has changed and was not told of just before; at the
        first step of an episode all that is left of the ones before."""
        if step <= self._told:
            self._new, self._told = bool(self._items), -_EVERY
        wait = _EVERY if len(self._items) <= _FEW else _SELDOM
        if not self._new or (self._told >= 0 and step - self._told < wait):
            return None
        self._new, self._told = False, step
        return _joined(self._items.values())

    def _remember(self, kind: str, number: Any, item: Item) -> None:
        self._count += 1
        # Without a window PyBullet numbers nothing.
        own = number if isinstance(number, int) and number >= 0 else -self._count
        self._items.pop((kind, own), None)
        self._items[kind, own] = item
        while len(self._items) > MOST:
            del self._items[next(iter(self._items))]
        self._new = True

    # What is called beside PyBullet's functions, with their arguments and what they returned.

    def addUserDebugLine(
        self, returned: Any, lineFromXYZ: Any, lineToXYZ: Any, lineColorRGB: Any = _RED,
        lineWidth: Any = 1.0, *_: Any, **__: Any,
    ) -> None:  # fmt: skip
        """A line in the world."""
        points = _point(lineFromXYZ), _point(lineToXYZ)
        red, green, blue = _point(lineColorRGB)
        self._remember("line", returned, ("line", points, (red, green, blue), float(lineWidth)))

    def loadURDF(
        self, returned: Any, fileName: Any, basePosition: Any = (0, 0, 0), *_: Any, **__: Any
    ) -> None:
        """A waypoint, if it is a sphere."""
        if "sphere" in str(fileName):
            item: Item = ("points", (_point(basePosition),), _RED, _RADIUS)
            self._remember("body", returned, item)

    def removeUserDebugItem(self, returned: Any, itemUniqueId: Any, **_: Any) -> None:
        """A line goes."""
        self._new = self._items.pop(("line", int(itemUniqueId)), None) is not None or self._new

    def removeAllUserDebugItems(self, returned: Any, **_: Any) -> None:
        """All lines go."""
        for key in [key for key in self._items if key[0] == "line"]:
            del self._items[key]
            self._new = True

    def removeBody(self, returned: Any, bodyUniqueId: Any, **_: Any) -> None:
        """A waypoint goes."""
        self._new = self._items.pop(("body", int(bodyUniqueId)), None) is not None or self._new


def _joined(items: Iterable[Item]) -> list[Item]:
    """Lines that go on where the one before ended are one."""
    found: list[Item] = []
    for item in items:
        kind, points, colour, size = item
        if kind == "line" and found:
            last = found[-1]
            if last[0] == kind and last[1][-1] == points[0] and last[2:] == (colour, size):
                found[-1] = (kind, (*last[1], *points[1:]), colour, size)
                continue
        found.append(item)
    return found


def _point(values: Sequence[Any]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        raise ValueError("no place")
    return x, y, z


DRAWN = Drawn()
"""Of the controller that lives in this process."""


def patch(pybullet: Any) -> None:
    """Let PyBullet's drawing be remembered."""
    for name in (*_TO_REMEMBER, *_TO_FORGET):
        function = getattr(pybullet, name, None)
        if function is not None and not hasattr(function, "__crazyarena_original__"):
            setattr(pybullet, name, _beside(function, getattr(DRAWN, name)))


def unpatch(pybullet: Any) -> None:
    """PyBullet as it was."""
    for name in (*_TO_REMEMBER, *_TO_FORGET):
        function: Any = getattr(pybullet, name, None)
        if hasattr(function, "__crazyarena_original__"):
            setattr(pybullet, name, function.__crazyarena_original__)


def _beside(function: Callable[..., Any], remember: Callable[..., None]) -> Callable[..., Any]:
    @functools.wraps(function)
    def wrapper(*args: Any, **options: Any) -> Any:
        returned = function(*args, **options)
        # What PyBullet takes and we do not understand is not shown.
        with contextlib.suppress(TypeError, ValueError, OverflowError):
            remember(returned, *args, **options)
        return returned

    wrapper.__crazyarena_original__ = function  # type: ignore[attr-defined]
    return wrapper
