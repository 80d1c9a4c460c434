"""Films."""

from crazyarena.crazyswarm_compat.video import VideoWriter

__all__ = ["VideoWriter"]
