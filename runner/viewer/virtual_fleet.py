"""Shows the vehicles of ``virtual-cf``, where they truly are."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from crazyarena.levels import load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.live import ID, POSITION, QUATERNION, VELOCITY
from crazyarena.runner.records.shown_scene import level_scene
from crazyarena.sim_backend.firmware import supervisor as sv
from crazyarena.types import Telemetry, VehicleState
from crazyarena.viewer_process import View, ViewOptions

_PERIOD = 1.0 / 30.0  # s
_MOVED = 1e-4  # m


class Fleet(Protocol):
    """Vehicles that are simulated here."""

    ids: Any

    def true_state(self, vehicle: int) -> VehicleState: ...

    def telemetry(self, vehicle: int) -> Telemetry: ...


class ShownFleet:
    """Publishes a fleet from a thread of its own until it is closed.

    The thread only looks at numbers that the simulation writes: a picture may have a vehicle half a
    step further than another, and nobody waits.
    """

    def __init__(
        self, fleet: Fleet, level: str | None, options: ViewOptions, say: Callable[[str], None]
    ) -> None:
        self._fleet = fleet
        self._view = View(options, say, vehicles=len(fleet.ids))
        names = [f"cf{number}" for number in fleet.ids]
        scene: dict[str, Any] = {"title": "virtual-cf", "vehicles": names}
        if level is not None:
            loaded = load_level(level)
            draw = LevelRandom(loaded).reset()
            scene = level_scene(loaded, draw.gates, draw.obstacles, names)
        live = self._view.live
        live.rows[:, ID] = list(fleet.ids)
        live.scene(scene)
        live.begin()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        last: NDArray[np.float64] | None = None
        while not self._ended.wait(_PERIOD):
            live, fleet = self._view.live, self._fleet
            for k, row in enumerate(live.rows):
                state = fleet.true_state(k)
                row[POSITION : POSITION + 3] = state.position
                row[QUATERNION : QUATERNION + 4] = state.quaternion
                row[VELOCITY : VELOCITY + 3] = state.velocity
            places = live.rows[:, POSITION : POSITION + 3]
            if last is None or float(np.abs(places - last).max()) > _MOVED:
                last = places.copy()
                live.extend()
            told = [fleet.telemetry(k) for k in range(len(live.rows))]
            flying = sum(bool((t.supervisor or 0) & sv.INFO_FLYING) for t in told)
            live.publish(
                {
                    "phase": f"{flying} of {len(told)} fly",
                    "time": told[0].timestamp,
                    "battery": min(
                        (t.battery for t in told if t.battery is not None), default=None
                    ),
                }
            )

    def close(self) -> None:
        """Idempotent."""
        self._ended.set()
        self._thread.join()
        self._view.close()
