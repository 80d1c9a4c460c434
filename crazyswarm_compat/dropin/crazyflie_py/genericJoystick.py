"""Gamepad or keyboard."""

from crazyarena.crazyswarm_compat.joystick import Joystick

__all__ = ["Joystick"]
