"""The base class of all controllers."""

from abc import ABC, abstractmethod


class Controller(ABC):
    """Made anew for every episode."""

    def __init__(self, obs, info, config):  # noqa: B027
        """Begin an episode with its first observation, an empty info and the level's file."""

    @abstractmethod
    def compute_control(self, obs, info=None):
        """Return the command of this step: (13,) in state mode, (4,) in attitude mode."""

    def step_callback(self, action, obs, reward, terminated, truncated, info):
        """Hear what came of a step; a true answer ends the episode."""
        return True

    def episode_callback(self):  # noqa: B027
        """Called once after the episode."""

    def episode_reset(self):  # noqa: B027
        """Called after :meth:`episode_callback`."""

    def reset(self):  # noqa: B027
        """Not called by the scripts."""

    def render_callback(self, sim):  # noqa: B027
        """Draw into ``sim``."""
