"""Checks of uploaded trajectories, made when they are started."""

from __future__ import annotations

import numpy as np

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.safety.admission.memory import VehicleMemory
from crazyarena.safety.admission.room import Room
from crazyarena.safety.observation import as_point

_SAMPLES_PER_PIECE = 24


def upload(
    room: Room, m: c.UploadTrajectory, memory: VehicleMemory, now: float
) -> tuple[c.Command, list[str]]:
    memory.trajectories[int(m.trajectory_id)] = np.array(m.pieces, dtype=np.float64)
    return m, []


def start(
    room: Room, m: c.StartTrajectory, memory: VehicleMemory, now: float
) -> tuple[c.Command, list[str]]:
    pieces = memory.trajectories.get(int(m.trajectory_id))
    if pieces is None:
        raise memory.refusal(
            m,
            f"trajectory {m.trajectory_id} was not uploaded "
            "through this gate, so it cannot be checked",
        )
    places, velocities, acceleration = sampled(pieces, float(m.timescale))
    speed = float(np.linalg.norm(velocities, axis=1).max())
    if m.reverse:
        velocities = -velocities
    if m.relative:
        where = room.where(memory.vehicle)
        if where is None:
            raise memory.refusal(m, "relative, but nobody knows where the vehicle is")
        places = places + (np.array(where) - places[-1 if m.reverse else 0])
    worst = min(room.fence.room(x, y, z) for x, y, z in places.tolist())
    for what, found, limit in (
        ("speed", speed, room.limits.setpoint_speed),
        ("acceleration", acceleration, room.limits.setpoint_acceleration),
    ):
        if found > limit:
            raise memory.refusal(
                m, f"{what} reaches {found:.2f}, above {limit:g}; use a larger timescale"
            )
    if worst < 0.0:
        raise memory.refusal(m, f"it leads {-worst:.2f} m out of the fence")
    if room.link_loss.on:
        lost = max(
            room.link_loss.ballistic_excess(as_point(place), as_point(velocity))
            for place, velocity in zip(places, velocities, strict=True)
        )
        if lost > room.limits.link_loss_margin:
            raise memory.refusal(
                m,
                f"cut on the way the vehicle would end "
                f"{lost:.2f} m outside the fence; use a larger timescale or keep away from it",
            )
    memory.streaming = False
    return m, []


def sampled(pieces: np.ndarray, timescale: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Places (k, 3) m and velocities (k, 3) m/s along a trajectory, largest acceleration m/s2."""
    places, velocities, accelerations = [], [], []
    powers = np.arange(8)
    for piece in pieces:
        t = np.linspace(0.0, piece[0], _SAMPLES_PER_PIECE)[:, None]
        axes = piece[1:25].reshape(3, 8)
        basis = t**powers
        first = powers[1:] * t ** powers[:-1]
        second = powers[2:] * powers[1:-1] * t ** powers[:-2]
        places.append(basis @ axes.T)
        velocities.append(first @ axes[:, 1:].T)
        accelerations.append(np.linalg.norm(second @ axes[:, 2:].T, axis=1).max())
    return (
        np.concatenate(places),
        np.concatenate(velocities) / timescale,
        float(max(accelerations)) / timescale**2,
    )
