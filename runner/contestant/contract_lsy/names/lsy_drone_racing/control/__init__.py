"""Controllers; files beside the one that flies are found here, too."""

from .controller import Controller

__all__ = ["Controller"]
