"""Real Crazyflies, and virtual ones that look like them, through cflib.

:class:`RadioBackend` is the backend; the modules behind it, from the wire up: ``packets``
(layouts), ``lanes``, ``emergency`` and ``outbox`` (traffic classes and hand-over rules),
``client``, ``parameters``, ``trajectory_memory``, ``quality``, ``sender`` and ``link`` (one
vehicle), ``telemetry``, ``preflight``, ``events``, ``script_report`` (what a script hears of them).
"""

from crazyarena.crazyswarm_compat.radio.backend import RadioBackend, open_radio
from crazyarena.crazyswarm_compat.radio.events import (
    AirShort,
    CommandDoubtful,
    CommandLost,
    CommandRefused,
    LinkEvent,
    LinkLost,
    LinkUp,
    StreamEnded,
    TrajectoryUploaded,
    VehicleRestarted,
)
from crazyarena.crazyswarm_compat.radio.lanes import Lane, LaneStatistics, OutboxOptions
from crazyarena.crazyswarm_compat.radio.options import RadioOptions
from crazyarena.crazyswarm_compat.radio.preflight import Preparation
from crazyarena.crazyswarm_compat.radio.quality import LinkStatistics
from crazyarena.crazyswarm_compat.radio.telemetry import SupervisorState

__all__ = [
    "AirShort",
    "CommandDoubtful",
    "CommandLost",
    "CommandRefused",
    "Lane",
    "LaneStatistics",
    "LinkEvent",
    "LinkLost",
    "LinkStatistics",
    "LinkUp",
    "OutboxOptions",
    "Preparation",
    "RadioBackend",
    "RadioOptions",
    "StreamEnded",
    "SupervisorState",
    "TrajectoryUploaded",
    "VehicleRestarted",
    "open_radio",
]
