"""A button whose click reaches us whatever else is pressed, typed or dragged at the same time.

Inputs of a panel share one sender in the browser, which keeps the newest of what comes within
50 ms: a click between two other inputs would be dropped. Commands (of viser's palette) go out at
once, each by itself, and a command is called by its keys. So the button is a piece of HTML that
presses the keys of a command; people may press them, too.
"""

from __future__ import annotations

import html
import threading
from collections.abc import Callable
from typing import Any

LOOKS = """<style>
.sure { display: block; width: calc(100% - 1.5em); margin: 0.4em auto; height: 3.4em; border: 0;
  border-radius: 4px; color: white; font: inherit; font-size: 1.1em; font-weight: 700;
  cursor: pointer; touch-action: manipulation; }
.sure:hover { filter: brightness(1.1); }
.sure:active { filter: brightness(0.85); }
</style>"""

_PRESS = (
    "document.documentElement.dispatchEvent(new KeyboardEvent('keydown',"
    "{key:'%s',code:'Key%s',ctrlKey:true,altKey:true,shiftKey:true,bubbles:true}))"
)


class SureButton:
    """A button and its command in one browser; neither is there before it is shown.

    Parameters
    ----------
    gui: of a viser client, with :data:`LOOKS` on its page.
    label: what to press. colour: of CSS.
    key: upper-case letter; with Ctrl (or Cmd), Alt and Shift it does the same.
    pressed: called in a thread of its own, so that no press waits for an earlier one.
    """

    def __init__(
        self,
        gui: Any,
        label: str,
        colour: str,
        key: str,
        order: float,
        pressed: Callable[[], None],
    ) -> None:
        self._command = gui.add_command(
            label, hotkey=key, modifier="cmd/ctrl+alt+shift", disabled=True
        )

        # A coroutine is run where messages arrive; viser's pool of threads may be busy.
        @self._command.on_trigger
        async def _(event: Any) -> None:
            threading.Thread(target=pressed, daemon=True).start()

        press = html.escape(_PRESS % (key, key))
        self._html = gui.add_html(
            f'<button class="sure" type="button" style="background:{colour}" '
            f'title="Ctrl+Alt+Shift+{key}" onclick="{press}">{html.escape(label)}</button>',
            order=order,
            visible=False,
        )

    def show(self, wanted: bool) -> None:
        """Let it be pressed, or not."""
        self._command.disabled = not wanted
        self._html.visible = wanted
