"""One vehicle of an :class:`~crazyarena.sim_backend.arena.ArenaFleet` as the services see it."""

from __future__ import annotations

import numpy as np

from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.arena_params import PARAM_INDEX, PARAMS, YAW_MODE
from crazyarena.sim_backend.firmware import commander as cm
from crazyarena.sim_backend.firmware import stack_2026
from crazyarena.sim_backend.firmware import supervisor as sv
from crazyarena.sim_backend.firmware.parameters import default_row
from crazyarena.sim_backend.vehicles.rows import WRITTEN
from crazyarena.types import Pose

_DEFAULTS = default_row(PARAMS, 2026)
_NAMES = frozenset(param.name for param in PARAMS)

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class ArenaVehicle:
    """The supervisor, commander, estimator and parameters of one vehicle.

    Parameters
    ----------
    fleet, index: the vehicle.
    address: radio address; its low byte is the vehicle's id on the localization port.
    """

    def __init__(self, fleet: ArenaFleet, index: int, address: int) -> None:
        self.fleet = fleet
        self.index = index
        self.address = address
        self.rows = fleet.rows(index)
        self.measured: tuple[Vector, Quaternion | None] | None = None
        self.measured_at = 0

    def now_ms(self) -> int:
        """Firmware time, ms since boot."""
        return int(self.rows.memory[stack_2026.F_TICK])

    def now(self) -> float:
        """Firmware time, s since boot."""
        return 1e-3 * float(self.rows.memory[stack_2026.F_TICK])

    # Supervisor

    def info(self) -> int:
        return int(self.rows.supervisor[sv.SV_INFO])

    def is_armed(self) -> bool:
        return bool(self.rows.supervisor[sv.SV_ARMED])

    def arm(self, arm: bool) -> bool:
        return bool(sv.supervisor_request_arming(self.rows.supervisor, arm))

    def recover(self) -> bool:
        return bool(sv.supervisor_request_recovery(self.rows.supervisor))

    def emergency_stop(self) -> None:
        self.rows.supervisor[sv.SV_STOP] = 1.0

    def feed_watchdog(self) -> None:
        self.fleet.emergency_watchdog(self.index)

    # Commander

    def priority(self) -> int:
        return int(self.rows.commander[cm.CM_PRIORITY])

    def yaw_angle(self) -> bool:
        return self.fleet.get_param(self.index, YAW_MODE) == 1

    def offer(self, row: np.ndarray) -> None:
        self.fleet.setpoint(self.index, row)

    def notify_setpoints_stop(self) -> None:
        stack_2026.notify_setpoints_stop(self.rows.memory)

    # Estimator

    def external_position(self, position: Vector) -> None:
        self._note(position, None)
        self.fleet.external_position(self.index, position)

    def external_pose(self, position: Vector, quaternion: Quaternion) -> None:
        self._note(position, quaternion)
        self.fleet.external_pose(self.index, Pose(np.array(position), np.array(quaternion)))

    def _note(self, position: Vector, quaternion: Quaternion | None) -> None:
        self.measured = (position, quaternion)
        self.measured_at = self.now_ms()

    def peer_position(self, peer: int, position: Vector) -> None:
        # Id 0 marks an empty place in the table of peers.
        if peer:
            self.fleet.peer_position(self.index, peer, position)

    # Parameters

    def get_param(self, name: str) -> float | None:
        return self.fleet.get_param(self.index, name) if name in _NAMES else None

    def boot_param(self, name: str) -> float | None:
        """What the vehicle's model says of a parameter, where it differs from the firmware's own
        default and is not for a ground station to write; and which positioning deck it has."""
        if (fitted := self.fleet.decks.fitted(self.index, name)) is not None:
            return fitted
        index = PARAM_INDEX.get(name)
        if (
            index is None
            or name in WRITTEN
            or self.fleet.models[self.index].params[index] == _DEFAULTS[index]
        ):
            return None
        return float(self.fleet.models[self.index].params[index])

    def set_param(self, name: str, value: float) -> None:
        if name in _NAMES:
            self.fleet.set_param(self.index, name, value)
