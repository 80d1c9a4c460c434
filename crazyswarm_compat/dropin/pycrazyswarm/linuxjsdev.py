"""Linux joystick devices."""

from crazyarena.crazyswarm_compat.linuxjsdev import Joystick

__all__ = ["Joystick"]
