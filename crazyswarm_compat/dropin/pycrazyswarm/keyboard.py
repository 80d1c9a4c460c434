"""Single key strokes."""

from crazyarena.crazyswarm_compat.keyboard import KeyPoller

__all__ = ["KeyPoller"]
