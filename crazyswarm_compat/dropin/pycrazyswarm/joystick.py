"""Gamepad; the older name of genericJoystick."""

from crazyarena.crazyswarm_compat.joystick import Joystick

__all__ = ["Joystick"]
