"""The flight of a Crazyswarm script: a recording a vehicle, and one picture of all of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from crazyarena import __version__
from crazyarena.clock import Clock, WallClock
from crazyarena.errors import CrazyarenaError, InputError, StorageError
from crazyarena.runner.judging import verdict_row
from crazyarena.runner.records.recorder import Recorder
from crazyarena.runner.records.run_folder import refuse_older_run
from crazyarena.sim_backend.trace import (
    TR_CONTACT,
    TR_POS,
    TR_QUAT,
    TR_RPY,
    TR_TIME,
    TR_VEL,
    TRACE_SIZE,
    UNKNOWN_CONTACT,
)

FIGURE = "flight.png"
_PERIOD = 0.01  # s, between rows
_NOTHING: dict[str, Any] = {"deletions": [], "entities": []}


class ScriptRecorder:
    """Records vehicles by their telemetry.

    Parameters
    ----------
    folder: takes ``cf<id>.mcap`` and ``flight.png``.
    link: what the vehicles fly on; ``telemetry(id).state`` is their pose. guard: what guards them,
        or None; what it did becomes events.

    Raises
    ------
    InputError: the folder holds an older run, or cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        vehicles: Sequence[int],
        link: Any,
        guard: Any = None,
        wall: Clock | None = None,
    ) -> None:
        self.folder = folder.resolve()
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--record {folder}: cannot make it: {error.strerror}") from error
        refuse_older_run(self.folder)
        self._link, self._guard = link, guard
        clock = wall if wall is not None else WallClock()
        metadata = {"crazyarena": __version__, "level": "script"}
        self._recorders = {
            vehicle: Recorder(
                self.folder / f"cf{vehicle}.mcap",
                {**metadata, "vehicle_id": str(vehicle)},
                _NOTHING,
                clock,
            )
            for vehicle in vehicles
        }
        self._last = -np.inf
        self._closed = False

    def take(self, time: float) -> None:
        """Record the present poses, at ``time`` s, unless they have just been recorded."""
        if self._closed or time < self._last + _PERIOD - 1e-9:
            return
        self._last = time
        verdict = np.zeros(verdict_row.SIZE)
        verdict[verdict_row.VD_TIME] = time
        for vehicle, recorder in self._recorders.items():
            try:
                state = self._link.telemetry(vehicle).state
            except CrazyarenaError:
                continue  # the link is gone, which others tell
            if state is not None:
                recorder.step(_row(time, state), verdict)

    def close(self) -> None:
        """Write everything. Idempotent; never raises what would hide a script's own error."""
        if self._closed:
            return
        self._closed = True
        for recorder in self._recorders.values():
            for event in () if self._guard is None else list(self._guard.events):
                recorder.event(event.time, 0, str(event.rule), str(event.detail))
            recorder.close()
            if recorder.trouble is not None:
                print(f"--record: {recorder.trouble}")
        try:
            self._draw()
        except StorageError as error:
            print(f"--record: {error}")
            return
        print(f"Recorded: {self.folder}")

    def _draw(self) -> None:
        """Ways from above, and heights over time, of all vehicles."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        from crazyarena import whole_file

        figure = Figure(figsize=(13, 6), dpi=100)
        FigureCanvasAgg(figure)
        top = figure.add_axes((0.06, 0.1, 0.4, 0.82))
        height = figure.add_axes((0.54, 0.1, 0.44, 0.82))
        few = len(self._recorders) <= 10
        for vehicle, recorder in self._recorders.items():
            states: NDArray[np.float64] = recorder.states
            path = states[:, TR_POS : TR_POS + 3]
            (line,) = top.plot(path[:, 0], path[:, 1], lw=1.2, label=f"cf{vehicle}")
            if len(path):
                top.plot(*path[-1, :2], "s", color=line.get_color(), ms=4)
            height.plot(states[:, TR_TIME], path[:, 2], lw=1.2, color=line.get_color())
        top.set_aspect("equal", adjustable="datalim")
        for axis, across, up in ((top, "x [m]", "y [m]"), (height, "time [s]", "z [m]")):
            axis.set_xlabel(across)
            axis.set_ylabel(up)
            axis.grid(True, alpha=0.3)
        if few and self._recorders:
            handles, names = top.get_legend_handles_labels()
            figure.legend(handles, names, loc="upper center", ncols=10, fontsize=8, frameon=False)
        whole_file.save_figure(figure, self.folder / FIGURE)


def _row(time: float, state: Any) -> NDArray[np.float64]:
    row = np.full((1, TRACE_SIZE), np.nan)
    row[0, TR_TIME] = time
    row[0, TR_POS : TR_POS + 3] = state.position
    row[0, TR_QUAT : TR_QUAT + 4] = state.quaternion
    row[0, TR_RPY : TR_RPY + 3] = Rotation.from_quat(state.quaternion).as_euler("xyz")
    row[0, TR_VEL : TR_VEL + 3] = state.velocity
    row[0, TR_CONTACT] = UNKNOWN_CONTACT
    return row
