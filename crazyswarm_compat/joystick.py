"""``swarm.input``: buttons of a gamepad, or any key of the terminal where there is none."""

from __future__ import annotations

from typing import Any

from crazyarena.crazyswarm_compat import linuxjsdev
from crazyarena.crazyswarm_compat.keyboard import KeyPoller

_POLL = 0.01  # s
_SHOULDER = 5  # right shoulder button
_ANY = (3, 4, 5)


class Joystick:
    """First Linux joystick (number 0 preferred), else the keyboard.

    Parameters
    ----------
    timeHelper: waiting for a button sleeps on it, so that a simulation goes on meanwhile.
    reader: source of axes and buttons; the Linux joystick interface by default.
    """

    def __init__(self, timeHelper: Any, reader: Any = None) -> None:
        self.timeHelper = timeHelper
        self.js: Any = None
        self.joyID: int | None = None
        reader = linuxjsdev.Joystick() if reader is None else reader
        for device in reader.devices():
            try:
                reader.open(device["id"])
            except OSError:
                continue  # not ours to read; there may be another
            self.js, self.joyID = reader, device["id"]
            break
        if self.js is None:
            print("Warning: No joystick found!")

    def _buttons(self) -> list[int]:
        return [] if self.js is None else self.js.read(self.joyID)[1]

    def _pressed(self, numbers: tuple[int, ...]) -> list[int] | None:
        buttons = self._buttons()
        down = any(number < len(buttons) and buttons[number] for number in numbers)
        return buttons if down else None

    def checkIfButtonIsPressed(self) -> bool:
        """True while button 5 (right shoulder) is down."""
        return self._pressed((_SHOULDER,)) is not None

    def waitUntilButtonPressed(self) -> None:
        """Wait until button 5 has been pressed and released, or for any key of the terminal.

        Returns at once where the input has ended, so that scripts also run unattended.
        """
        if self.js is None:
            with KeyPoller() as keys:
                while keys.poll() is None and not keys.ended:
                    self.timeHelper.sleep(_POLL)
            return
        while not self.checkIfButtonIsPressed():
            self.timeHelper.sleep(_POLL)
        while self.checkIfButtonIsPressed():
            self.timeHelper.sleep(_POLL)

    def checkIfAnyButtonIsPressed(self) -> list[int] | None:
        """State of all buttons if one of the buttons 3, 4, 5 is down, else None."""
        return self._pressed(_ANY)

    def waitUntilAnyButtonPressed(self) -> list[int] | None:
        """Buttons as they were pressed, once released; None without a joystick."""
        if self.js is None:
            return None
        while (buttons := self.checkIfAnyButtonIsPressed()) is None:
            self.timeHelper.sleep(_POLL)
        while self.checkIfAnyButtonIsPressed() is not None:
            self.timeHelper.sleep(_POLL)
        return buttons
