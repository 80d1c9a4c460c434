"""The end of a stream: a vehicle that is released and has nothing to follow stops its motors.

The firmware's high-level commander takes over within 10 ms, and an idle one asks for nothing. So
the word is kept until a plan follows it; if none does, the vehicle holds its last setpoint, until
the watchdog misses the stream and holds it.
"""

from __future__ import annotations

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.safety.admission.memory import VehicleMemory
from crazyarena.safety.admission.room import Room
from crazyarena.safety.planner import Flown


def release(
    room: Room, m: c.NotifySetpointsStop, memory: VehicleMemory, now: float
) -> tuple[c.Command, list[str]]:
    if memory.planner.flown is not Flown.STREAM or not memory.addressed(m.group_mask):
        return m, []
    if room.low(memory.vehicle):
        memory.then = memory.stopped  # on the ground that is how a stream ends
    else:
        memory.then = lambda: memory.releases(m)
    return m, []
