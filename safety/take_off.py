"""Follows the heading of one vehicle from the ground on: brings together poses and rates, compares
them, and asks for a nudge while too little is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from crazyarena.safety.heading import HeadingWatch, Turned
from crazyarena.safety.nudge import Nudge
from crazyarena.safety.observation import as_point
from crazyarena.safety.pairing import Pairing
from crazyarena.types import Pose, Telemetry

_LIFTED = 0.02  # m above where it stood; below, it is pushed by what it stands on
_STANDING = 10.0  # s with motors on and still on the ground, after which nobody is nudged
_LIFTING = 2.5  # s of flight, after which the nudge ends whatever is known


class TakeOffCheck:
    """For one vehicle.

    Parameters
    ----------
    nudge: m (safety/nudge.py).
    """

    def __init__(self, nudge: float) -> None:
        self._watch = HeadingWatch()
        self._pairing = Pairing()
        self._nudge = Nudge(nudge)
        self._begun: float | None = None
        self._lifted: float | None = None

    @property
    def turned(self) -> Turned:
        """What is known of the heading."""
        return self._watch.now

    def stands(self) -> None:
        """The vehicle does not fly: begin anew."""
        self._watch.reset()
        self._pairing.reset()
        self._begun = self._lifted = None

    def flies(self, captured: float, pose: Pose, above: float, told: Telemetry) -> Turned:
        """A believed pose of the vehicle in flight.

        Parameters
        ----------
        captured: s. above: m above where it stood. told: what it has told last.
        """
        if self._begun is None:
            self._begun = captured
        if above > _LIFTED:
            if self._lifted is None:
                self._lifted = captured
            x, y, z, w = pose.quaternion.tolist()
            self._pairing.pose(captured, as_point(pose.position), (x, y, z, w))
        for sample in self._pairing.told(told):
            self._watch.update(*sample)
        return self._watch.now

    def nudged(self, pose: Pose, now: float, allowed: bool = True) -> Pose:
        """The pose as the vehicle is to be told it."""
        dx, dy = self._nudge.shift(now, allowed and self._needed(now))
        if not dx and not dy:
            return pose
        return replace(pose, position=pose.position + np.array([dx, dy, 0.0]))

    def _needed(self, now: float) -> bool:
        if self._begun is None or self._watch.now.known:
            return False
        if self._lifted is None:
            return now - self._begun < _STANDING
        return now - self._lifted < _LIFTING
