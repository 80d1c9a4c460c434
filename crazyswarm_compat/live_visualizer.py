"""A fleet in the browser: publishes what flies for the viewer, which is another process."""

from __future__ import annotations

import atexit
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from crazyarena.clock import Clock, WallClock
from crazyarena.errors import CrazyarenaError
from crazyarena.live import COLOUR, ID, POSITION, QUATERNION, VELOCITY
from crazyarena.viewer_process import View, ViewOptions

_PERIOD = 1.0 / 30.0  # s of wall time, between pictures
_EVENTS = 12


class LiveVisualizer:
    """Publishes a fleet, simulated or not.

    Parameters
    ----------
    options: of the viewer.
    pace: times real time that simulated time passes with; 0 where it passes by itself.
    """

    def __init__(self, options: ViewOptions, pace: float = 1.0, wall: Clock | None = None) -> None:
        self._options = options
        self._pace = pace
        self._wall = wall if wall is not None else WallClock()
        self._view: View | None = None
        self._paced: tuple[float, float] | None = None
        self._published = -math.inf
        self._link: Any = None
        self._guard: Any = None
        self._edges: list[list[int]] = []
        self._radii: list[float] = []

    def follow(self, link: Any, guard: Any) -> None:
        """What the fleet flies on, and what guards it, if anything."""
        self._link, self._guard = link, guard

    def setGraph(self, edges: Sequence[tuple[int, int]]) -> None:
        """Draw lines between the vehicles ``(i, j)``, by index."""
        self._edges = [[int(a), int(b)] for a, b in edges]

    def showEllipsoids(self, radii: ArrayLike) -> None:
        """Draw an ellipsoid of ``radii`` (3,) m around every vehicle."""
        self._radii = np.asarray(radii, float).reshape(3).tolist()

    def render(self) -> None:
        """Films are made with another viewer."""

    def update(self, t: float, crazyflies: Sequence[Any]) -> None:
        """Show the present positions, at time ``t`` s."""
        if not crazyflies:
            return
        if self._view is None:
            self._open(crazyflies)
        self._keep_pace(t)
        now = self._wall.now()
        if now - self._published >= _PERIOD:
            self._published = now
            self._publish(t, crazyflies)

    def _open(self, crazyflies: Sequence[Any]) -> None:
        self._view = View(
            self._options, lambda text: print(text, flush=True), vehicles=len(crazyflies)
        )
        atexit.register(self.close)
        live = self._view.live
        scene = getattr(self._guard, "scene", None) or {"title": "script"}
        live.scene({**scene, "vehicles": [f"cf{cf.id}" for cf in crazyflies]})
        live.rows[:, ID] = [cf.id for cf in crazyflies]
        live.begin()
        self._place(crazyflies)
        self._view.await_browser()

    def _place(self, crazyflies: Sequence[Any]) -> None:
        assert self._view is not None
        for row, cf in zip(self._view.live.rows, crazyflies, strict=True):
            row[COLOUR : COLOUR + 3] = cf.ledRGB
            state = None if self._link is None else self._link.telemetry(cf.id).state
            if state is None:
                row[POSITION : POSITION + 3] = cf.position()
            else:
                row[POSITION : POSITION + 3] = state.position
                row[QUATERNION : QUATERNION + 4] = state.quaternion
                row[VELOCITY : VELOCITY + 3] = state.velocity

    def _publish(self, t: float, crazyflies: Sequence[Any]) -> None:
        assert self._view is not None
        live = self._view.live
        try:
            self._place(crazyflies)
        except CrazyarenaError:
            return  # the link is gone, which others tell
        live.extend()
        facts: dict[str, Any] = {
            "phase": "script",
            "time": t,
            "edges": self._edges,
            "ellipsoid": self._radii,
            "contacts": len(getattr(self._link, "contacts", ())),
            "control": self._guard is not None,
        }
        if self._guard is not None:
            events = list(self._guard.events)[-_EVENTS:]
            facts["events"] = [[e.time, e.rule, e.detail] for e in events]
            facts["ladder"] = max((e.action for e in self._guard.events), default=0)
            facts["ladder"] = getattr(facts["ladder"], "name", "NONE")
        live.publish(facts)

    def _keep_pace(self, t: float) -> None:
        if self._pace <= 0.0:
            return
        if self._paced is None:
            self._paced = (t, self._wall.now())
        began, since = self._paced
        self._wall.sleep_until(since + (t - began) / self._pace)

    def close(self) -> None:
        """The script is over; its page stays as long as somebody has it open. Idempotent."""
        if self._view is not None:
            atexit.unregister(self.close)
            view, self._view = self._view, None
            view.finish()
