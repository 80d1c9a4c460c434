"""Helpers that controllers import."""

from .utils import draw_line, load_config, load_controller

__all__ = ["draw_line", "load_config", "load_controller"]
