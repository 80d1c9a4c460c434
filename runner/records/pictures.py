"""The pictures of a run: which episodes are drawn, when, and what became of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from crazyarena.plain_text import shown_line
from crazyarena.runner.judging.referee import (
    COLLISION,
    CONSTRAINT_VIOLATION,
    MAX_EPISODE_DURATION,
    TASK_COMPLETION,
    TUMBLED,
)
from crazyarena.runner.judging.result import (
    CONTROLLER_ERROR,
    CONTROLLER_TIMEOUT,
    SAFETY,
)
from crazyarena.runner.records.drawing import SHEET, Choice, Drawer, Figures
from crazyarena.runner.records.recorder import Recorder
from crazyarena.sim_backend.trace import TR_POS

if TYPE_CHECKING:
    from crazyarena.runner.records.ground import Ground
    from crazyarena.runner.records.picture import Outcome, Picture
    from crazyarena.runner.records.sheet import Tile

# On a tile there is room for a word.
_SHORT = {
    TASK_COMPLETION: "touched",
    COLLISION: "collision",
    CONSTRAINT_VIOLATION: "violation",
    MAX_EPISODE_DURATION: "too long",
    TUMBLED: "tumbled",
    CONTROLLER_ERROR: "error",
    CONTROLLER_TIMEOUT: "too slow",
    SAFETY: "safety",
    # Of lsy_drone_racing.
    "GATES PASSED": "touched",
    "OUT OF BOUNDS": "out",
    "SAFETY LIMITS": "out",
    "FLOOR": "floor",
    "TIME LIMIT": "too long",
    "CONTROLLER FINISHED": "gave up",
}


class Pictures:
    """Pictures of the episodes of a run.

    Parameters
    ----------
    meanwhile: draw while the run goes on. Not in wall time: nothing is to take the processor from
        a flight.
    """

    def __init__(self, wanted: Figures, episodes: int, meanwhile: bool) -> None:
        self._choice = Choice(wanted, episodes)
        self._ground: Ground | None = None
        self._meanwhile = meanwhile
        self._waiting: list[tuple[Outcome, Picture]] = []
        self._tiles: list[Tile] = []
        self._files: dict[Path, Outcome | None] = {}
        self._drawer = Drawer()

    @property
    def wanted(self) -> bool:
        """Whether states have to be kept."""
        return self._choice.wanted is not Figures.NONE

    def begin(self) -> None:
        """The run begins."""
        if self._meanwhile and self.wanted and self._choice.wanted is not Figures.FAILURES:
            self._drawer.warm_up()

    def add(
        self,
        out: Path,
        result: Outcome,
        recorder: Recorder,
        ground: Ground,
        isolated: bool,
    ) -> None:
        """An episode has been flown over this ground."""
        from crazyarena.runner.records.picture import picture
        from crazyarena.runner.records.sheet import tile

        states = recorder.states
        if self._choice.sheet:
            told = "done" if result.clean else _SHORT.get(result.termination, "failed")
            text = f"{told} {result.flight_time:.1f} s"
            position = states[:, TR_POS : TR_POS + 3]
            self._tiles.append(tile(result.index, result.clean, text, position, ground.gates))
            self._ground = self._ground or replace(ground, arena=None)
        if not self._choice(result.clean, result.why or result.termination):
            return
        shown = picture(
            ground,
            result,
            states,
            entities=recorder.first_scene.get("entities"),
            commanded_from=recorder.commanded_from,
            isolated=isolated,
        )
        if self._meanwhile:
            self._draw(out, result, shown)
        else:
            self._waiting.append((result, shown))

    def _draw(self, out: Path, result: Outcome, shown: Picture) -> None:
        file = out / f"episode_{result.index:03d}.png"
        self._files[file] = result
        self._drawer.draw(file, shown)

    def end(self, out: Path, isolated: bool) -> None:
        """All has been flown: what is left to draw may be drawn now."""
        for result, shown in self._waiting:
            self._draw(out, result, shown)
        self._waiting.clear()
        if len(self._tiles) > 1:
            self._files[out / SHEET] = None
            self._drawer.draw(out / SHEET, self._ground, self._tiles, isolated)

    def finish(self) -> list[Path]:
        """Wait until everything is drawn; returns what is, and names it in the results."""
        try:
            self._drawer.finish()
        except KeyboardInterrupt:
            self._drawer.close()
        drawn = [file for file in self._files if file not in self._drawer.refused]
        for file in drawn:
            episode = self._files[file]
            if episode is not None:
                episode.files["figure"] = file.name
        return drawn

    def told(self, drawn: Sequence[Path]) -> list[str]:
        """What is said of the pictures: of many the first and the last."""
        few = drawn if len(drawn) <= 3 else [drawn[0], drawn[-1]]
        lines = [f"Figure: {shown_line(str(file))}" for file in few]
        if len(few) < len(drawn):
            lines.append(f"... and {len(drawn) - len(few)} more figures there")
        if drawn and self._choice.left:
            told = f"{self._choice.left} episodes are on {SHEET} alone"
            lines.append(f"{told}; --figure all draws each, crazyarena replay shows all")
        return lines

    @property
    def refused(self) -> list[str]:
        """Why pictures were not written."""
        return list(self._drawer.refused.values())

    def close(self) -> None:
        """Drop what is not drawn yet. Idempotent."""
        self._drawer.close()
