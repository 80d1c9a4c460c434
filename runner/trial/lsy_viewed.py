"""A run in lsy_drone_racing's simulation that somebody may look at in the browser."""

from __future__ import annotations

from rich.console import Console

from crazyarena.viewer_process import View, ViewOptions


class Viewed:
    """What runs of one drone and of several have in common; ``wanted``: None for no viewer."""

    def __init__(self, console: Console | None, wanted: ViewOptions | None) -> None:
        self._console = console if console is not None else Console()
        self._wanted_view = wanted
        self._view: View | None = None

    def finish(self) -> None:
        """Let the viewer, if there is one, stay as long as somebody looks."""
        if self._view is not None:
            self._view.finish()

    def _close_view(self) -> None:
        if self._view is not None:
            self._view.close()

    def _open_view(self, vehicles: int = 1) -> View | None:
        if self._wanted_view is not None:
            self._view = View(
                self._wanted_view,
                lambda text: self._console.print(
                    text, highlight=False, markup=False, soft_wrap=True
                ),
                vehicles=vehicles,
            )
        return self._view
