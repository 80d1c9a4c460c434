"""The check of each kind of command; what has none passes as it is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.safety.admission import (
    attitudes,
    avoidance,
    parameters,
    plans,
    release,
    setpoints,
    trajectories,
)
from crazyarena.safety.admission.memory import VehicleMemory
from crazyarena.safety.admission.room import Room

# Of (room, command, memory, now): the command as it may be sent, and what had to be changed.
Fitter = Callable[[Room, Any, VehicleMemory, float], tuple[c.Command, list[str]]]

FITTERS: dict[type, Fitter] = {
    c.FullState: setpoints.full_state,
    c.Position: setpoints.position,
    c.VelocityWorld: setpoints.velocity_world,
    c.Hover: setpoints.hover,
    c.Attitude: attitudes.attitude,
    c.RollPitchYawThrust: attitudes.angles,
    c.NotifySetpointsStop: release.release,
    c.Takeoff: plans.takeoff,
    c.Land: plans.land,
    c.GoTo: plans.go_to,
    c.UploadTrajectory: trajectories.upload,
    c.StartTrajectory: trajectories.start,
    c.CollisionAvoidance: avoidance.collision_avoidance,
    c.SetParam: parameters.set_param,
}
