"""Which firmware parameters a controller may write, and when."""

from __future__ import annotations

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.safety.admission.memory import VehicleMemory
from crazyarena.safety.admission.room import Room

# What may be written in flight: decoration, and the gains of controllers. Nothing that stops or
# blinds a vehicle (supervisor, estimator, motors, commander).
_PARAMETERS_IN_FLIGHT = (
    "ring.",
    "led.",
    "colAv.",
    "ctrlMel.",
    "posCtlPid.",
    "velCtlPid.",
    "pid_attitude.",
    "pid_rate.",
    "hlCommander.",
)
_NEVER_BY_RUNNER = ("motorPowerSet.", "system.", "health.", "powerDist.idleThrust")


def set_param(
    room: Room, m: c.SetParam, memory: VehicleMemory, now: float
) -> tuple[c.Command, list[str]]:
    name = m.name.replace("/", ".")
    if name.startswith(_NEVER_BY_RUNNER):
        raise memory.refusal(m, f"{name} is not for controllers")
    flying = memory.flying_since is not None
    if flying and not name.startswith(_PARAMETERS_IN_FLIGHT):
        raise memory.refusal(m, f"{name} cannot be written in flight")
    return m, []
