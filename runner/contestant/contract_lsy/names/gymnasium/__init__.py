"""Stands in for gymnasium where it is not installed: its spaces."""

from . import spaces


class Env:
    """An environment."""


class Wrapper(Env):
    """An environment around another."""


__all__ = ["Env", "Wrapper", "spaces"]
