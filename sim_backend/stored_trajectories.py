"""What a vehicle's trajectory memory holds, and what a script should be told about it."""

from __future__ import annotations

import warnings

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.checks import UnknownTrajectory, beyond_memory


class StoredTrajectories:
    """Pieces that each trajectory of one vehicle takes up.

    Parameters
    ----------
    name: of the vehicle, for messages.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._places: dict[int, range] = {}

    def note(self, m: c.UploadTrajectory) -> None:
        """Note an upload; warns of another trajectory that it overwrites."""
        too_much = beyond_memory(m)
        if too_much is not None:
            warnings.warn(
                f"{self._name}: uploadTrajectory: a real vehicle refuses it: {too_much}",
                stacklevel=6,
            )
        places = range(int(m.piece_offset), int(m.piece_offset) + len(m.pieces))
        for other, taken in self._places.items():
            if other != m.trajectory_id and taken.start < places.stop and places.start < taken.stop:
                warnings.warn(
                    f"{self._name}: uploadTrajectory: trajectory {m.trajectory_id} "
                    f"(pieces {places.start}..{places.stop - 1}) overwrites trajectory {other} "
                    f"(pieces {taken.start}..{taken.stop - 1}) in a real vehicle's memory; give "
                    f"it another pieceOffset",
                    stacklevel=6,
                )
        self._places[m.trajectory_id] = places

    def require(self, trajectory_id: int) -> None:
        """Raise UnknownTrajectory if this one has not been uploaded."""
        if trajectory_id not in self._places:
            raise UnknownTrajectory(
                f"{self._name}: startTrajectory: trajectory {trajectory_id} has "
                f"not been uploaded; known are {sorted(self._places) or 'none'}"
            )
