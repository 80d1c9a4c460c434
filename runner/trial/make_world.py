"""The simulated world that a level's profile asks for."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crazyarena.levels.schema import Level, Profile
from crazyarena.runner.trial.entry import Entry
from crazyarena.runner.trial.world import World

# What only arena levels need is imported when one is flown: it would double the start-up.
if TYPE_CHECKING:
    from crazyarena.mocap.camera_model import CameraModel
    from crazyarena.safety.limits import Limits
    from crazyarena.sim_backend.vehicles import VehicleSupply


def make_world(
    level: Level,
    seed: int,
    limits: Limits | None = None,
    supply: VehicleSupply | None = None,
    cameras: CameraModel | None = None,
    deck: str | None = None,
    entry: Entry | None = None,
) -> World:
    """Return the simulated world of a level's profile; ``seed`` is that of its noise, ``limits``
    those of its watchdog, ``supply`` of the vehicles of an arena, ``cameras`` its own, ``deck`` on
    its vehicle instead of those, ``entry`` what has a track of its own."""
    if level.profile is Profile.COMPETITION:
        from crazyarena.sim_backend.competition import CompetitionWorld

        return CompetitionWorld(level.control_frequency)
    from crazyarena.runner.rig.rig import simulated
    from crazyarena.runner.trial.tracked_world import TrackedWorld

    rig = simulated(
        level,
        seed,
        cameras,
        limits=limits,
        supply=supply,
        deck=deck,
        track=None if entry is None else entry.track,
        params=None if entry is None else entry.params,
    )
    return TrackedWorld(rig)
