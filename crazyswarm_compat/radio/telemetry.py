"""Log blocks of a vehicle, decoded into :class:`~crazyarena.types.Telemetry`."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from cflib.crazyflie.log import LogConfig
from cflib.utils.encoding import decompress_quaternion

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat.radio.uptime import Uptime
from crazyarena.crazyswarm_compat.radio.vehicle_time import VehicleTime
from crazyarena.types import Telemetry, Vector, VehicleState

_LOG = logging.getLogger(__name__)

# Bits of supervisor.info.
CAN_BE_ARMED, ARMED, AUTO_ARM, CAN_FLY, FLYING, TUMBLED, LOCKED, CRASHED = (
    1 << bit for bit in range(8)
)
HIGH_LEVEL_ACTIVE, TRAJECTORY_FINISHED, HIGH_LEVEL_DISABLED = (1 << bit for bit in range(8, 11))

# Compressed, so that a block fits into one packet; millimetres and milliradians. cflib can
# create blocks of up to nine variables.
_MOTION = ("x", "y", "z", "vx", "vy", "vz", "quat")
_RATES = ("rateRoll", "ratePitch", "rateYaw")
# The last is the vehicle's own count of the packets it got.
_COUNT = "radio.numRxUc"
_HEALTH = ("pm.vbat", "pm.state", "supervisor.info", "radio.rssi", _COUNT)
# What a model of the vehicle is identified from; 22 bytes with the voltage in mV.
_MOTORS = ("motor.m1", "motor.m2", "motor.m3", "motor.m4")
_ACCELEROMETER = ("acc.x", "acc.y", "acc.z")
_MILLIVOLTS = "pm.vbatMV"
_FULL_SCALE = 65535.0
# How sure the on-board filter is: m2 in the world, (m/s)2 along the body.
POSITION_VARIANCES = ("kalman.varX", "kalman.varY", "kalman.varZ")
VELOCITY_VARIANCES = ("kalman.varPX", "kalman.varPY", "kalman.varPZ")
# What firmware before the supervisor told instead.
_OLD_FLAGS = (("sys.canfly", CAN_FLY), ("sys.isFlying", FLYING), ("sys.isTumbled", TUMBLED))
_TICKS = 1 << 24
_LONGEST_PERIOD = 2540  # ms


Received = Callable[[Mapping[str, float], int], None]
OnState = Callable[[Telemetry, int], None]


def is_stopped(flags: int) -> bool:
    """Whether ``supervisor.info`` says that the motors are locked; or that it does not fly, of
    old firmware, which has no word for locked."""
    old = not flags & ~(CAN_FLY | FLYING | TUMBLED)
    return bool(flags & LOCKED) or (old and not flags & FLYING)


@dataclass(frozen=True, slots=True)
class SupervisorState:
    """``supervisor.info`` by name."""

    can_be_armed: bool
    armed: bool
    can_fly: bool
    flying: bool
    tumbled: bool
    locked: bool
    crashed: bool
    high_level_active: bool
    trajectory_finished: bool

    @classmethod
    def from_bits(cls, bits: int) -> SupervisorState:
        """Split the bit field."""
        masks = (CAN_BE_ARMED, ARMED, CAN_FLY, FLYING, TUMBLED, LOCKED, CRASHED)
        flags = [bool(bits & mask) for mask in (*masks, HIGH_LEVEL_ACTIVE, TRAJECTORY_FINISHED)]
        return cls(*flags)


class Block:
    """One running log block.

    Parameters
    ----------
    client: a connected cflib client.
    name, variables: of the block; all variables must be in the vehicle's table of contents.
    period_ms: a multiple of 10, 10..2540.
    received: called with the values by name and the vehicle's time stamp, ms modulo 2^24, in
        cflib's thread.
    """

    def __init__(
        self,
        client: Any,
        name: str,
        variables: Sequence[str],
        period_ms: int,
        received: Received,
    ) -> None:
        self._config = LogConfig(name, period_ms)
        for variable in variables:
            self._config.add_variable(variable)
        self._asked = self._period = period_ms
        self._received = received
        self._last: int | None = None
        self.packets = 0
        self.missed = 0
        client.log.add_config(self._config)
        self._config.data_received_cb.add_callback(self._data)
        self._config.error_cb.add_callback(self._error)
        self._config.start()

    def slow_down(self, divisor: int) -> None:
        """Go on with ``divisor`` times the period that it began with."""
        period_ms = min(_LONGEST_PERIOD, self._asked * divisor)
        if period_ms == self._period:
            return
        self._config.stop()
        self._period, self._last = period_ms, None
        self._config.period = period_ms // 10
        self._config.period_in_ms = period_ms
        self._config.start()

    def stop(self) -> None:
        """Stop and delete the block."""
        self._config.data_received_cb.remove_callback(self._data)
        self._config.stop()
        self._config.delete()

    def _data(self, stamp: int, values: Mapping[str, float], _: LogConfig) -> None:
        if self._last is not None:
            elapsed = (stamp - self._last) % _TICKS
            # A gap of hours is a reboot, not a loss.
            periods = round(elapsed / self._period)
            if 1 < periods < 10_000:
                self.missed += periods - 1
        self._last = stamp
        self.packets += 1
        self._received(values, stamp)

    def _error(self, _: LogConfig, message: str) -> None:
        _LOG.warning("log block %s: %s", self._config.name, message)


def knows(client: Any, variable: str) -> bool:
    """Whether the vehicle has this log variable."""
    group, name = variable.split(".")
    toc = client.log.toc
    return toc is not None and toc.get_element(group, name) is not None


class TelemetryReader:
    """Keeps the latest word of a vehicle.

    Parameters
    ----------
    clock: session clock.
    state_rate, health_rate: of the two blocks, Hz; 0 for none.
    sent: how many packets have gone to the vehicle by now.

    Attributes
    ----------
    plant_rate: of motors, accelerometer and voltage, Hz, from the next connection on; 0 for none.
    certainty_rate: of how sure its filter is of the estimate, likewise.
    on_restart: called when the stamps of its log data show that it was restarted.
    on_state: called with what is known and the vehicle's time stamp, ms modulo 2^24, at every
        estimate; in cflib's thread.
    """

    def __init__(
        self, clock: Clock, state_rate: float, health_rate: float, sent: Callable[[], int]
    ) -> None:
        self._clock = clock
        self._sent = sent
        self._count: int | None = None
        self._uplink = (0, 0)  # sent, arrived
        self._sent_before = 0
        self._rates = (state_rate, health_rate)
        self.plant_rate = 0.0
        self.certainty_rate = 0.0
        self.on_state: list[OnState] = []
        self.on_restart: Callable[[], None] = lambda: None
        self._uptime = Uptime()
        self._lock = threading.Lock()
        self._blocks: list[Block] = []
        self._divisor = 1
        self._last = Telemetry(timestamp=-math.inf)
        self._time = VehicleTime()
        self._omega: Vector = np.zeros(3)

    @property
    def latest(self) -> Telemetry:
        """Without waiting; fields that were never told are None."""
        return self._last

    def start(self, client: Any) -> None:
        """Create the blocks on a new connection; variables that the firmware lacks are left
        out."""
        state_rate, health_rate = self._rates
        self._blocks, self._divisor = [], 1
        self._count, self._uplink = None, (0, 0)
        motion = [f"stateEstimateZ.{name}" for name in _MOTION]
        if state_rate and all(knows(client, name) for name in motion):
            self._blocks.append(
                Block(client, "motion", motion, _period_ms(state_rate), self._motion)
            )
        # As often as the estimate: they show whether the cameras' heading is the vehicle's.
        rates = [f"stateEstimateZ.{name}" for name in _RATES]
        if state_rate and all(knows(client, name) for name in rates):
            self._blocks.append(Block(client, "rates", rates, _period_ms(state_rate), self._turn))
        health = [name for name in _HEALTH if knows(client, name)]
        if "supervisor.info" not in health:
            health += [name for name, _ in _OLD_FLAGS if knows(client, name)]
        if health_rate and health:
            self._blocks.append(
                Block(client, "health", health, _period_ms(health_rate), self._health)
            )

        certainty = (*POSITION_VARIANCES, *VELOCITY_VARIANCES)
        if self.certainty_rate and all(knows(client, name) for name in certainty):
            self._blocks.append(
                Block(
                    client, "certainty", certainty, _period_ms(self.certainty_rate), self._certainty
                )
            )
        plant = (*_MOTORS, *_ACCELEROMETER, _MILLIVOLTS)
        if self.plant_rate and all(knows(client, name) for name in plant):
            self._blocks.append(
                Block(client, "plant", plant, _period_ms(self.plant_rate), self._plant)
            )

    def slow_down(self, divisor: int) -> None:
        """Divide the rates that were asked for; 1 gives them back. Sends, but does not wait."""
        if divisor == self._divisor:
            return
        self._divisor = divisor
        for block in self._blocks:
            block.slow_down(divisor)

    def quality(self, link_quality: float) -> None:
        """Note the quality of the link, 0..1."""
        self._update(link_quality=link_quality)

    def packets(self) -> tuple[int, int]:
        """Log packets received and missed on this connection."""
        blocks = tuple(self._blocks)
        return sum(block.packets for block in blocks), sum(block.missed for block in blocks)

    def uplink(self) -> tuple[int, int]:
        """Packets sent on this connection and how many of them arrived, by the vehicle's own
        count; (0, 0) where it has none."""
        return self._uplink

    def _count_uplink(self, count: int) -> None:
        sent = self._sent()
        if self._count is not None:
            arrived = (count - self._count) & 0xFFFF
            total = self._uplink[0] + sent - self._sent_before
            # A count that never moves is none.
            if arrived or self._uplink[1]:
                self._uplink = (total, self._uplink[1] + arrived)
        self._count, self._sent_before = count, sent

    def _update(self, **changes: Any) -> None:
        with self._lock:
            self._last = replace(self._last, **changes)

    def _motion(self, values: Mapping[str, float], stamp: int) -> None:
        now = self._clock.now()
        milli = [1e-3 * values[f"stateEstimateZ.{name}"] for name in _MOTION[:6]]
        quaternion = decompress_quaternion(int(values["stateEstimateZ.quat"]))
        state = VehicleState(
            timestamp=now,
            position=np.array(milli[:3]),
            velocity=np.array(milli[3:]),
            quaternion=np.asarray(quaternion, dtype=np.float64),
            angular_velocity=self._omega,
        )
        self._update(timestamp=now, state=state)
        for listener in self.on_state:
            listener(self._last, stamp)

    def _certainty(self, values: Mapping[str, float], _: int) -> None:
        position, velocity = (
            math.sqrt(max(0.0, *(float(values[name]) for name in names)))
            for names in (POSITION_VARIANCES, VELOCITY_VARIANCES)
        )
        self._update(position_std=position, velocity_std=velocity)

    def _plant(self, values: Mapping[str, float], _: int) -> None:
        self._update(
            timestamp=self._clock.now(),
            battery=1e-3 * float(values[_MILLIVOLTS]),
            motors=np.array([float(values[name]) for name in _MOTORS]) / _FULL_SCALE,
            acceleration=np.array([float(values[name]) for name in _ACCELEROMETER]),
        )

    def _health(self, values: Mapping[str, float], stamp: int) -> None:
        changes: dict[str, Any] = {"timestamp": self._clock.now()}
        if "pm.vbat" in values:
            changes["battery"] = float(values["pm.vbat"])
        if "pm.state" in values:
            changes["power_state"] = int(values["pm.state"])
        if "radio.rssi" in values:
            changes["rssi"] = -float(values["radio.rssi"])
        if _COUNT in values:
            self._count_uplink(int(values[_COUNT]))
        if "supervisor.info" in values:
            changes["supervisor"] = int(values["supervisor.info"])
        elif "sys.canfly" in values:
            changes["supervisor"] = sum(mask for name, mask in _OLD_FLAGS if values.get(name))
        self._update(**changes)
        if self._uptime.restarted(stamp, self._clock.now()):
            self.on_restart()

    def _turn(self, values: Mapping[str, float], stamp: int) -> None:
        roll, pitch, yaw = (1e-3 * values[f"stateEstimateZ.{name}"] for name in _RATES)
        # The firmware logs the pitch rate in its legacy sign.
        self._omega = np.array([roll, -pitch, yaw])
        state = self._last.state
        if state is not None:
            turned = replace(state, angular_velocity=self._omega)
            made = self._time.made_at(stamp, self._clock.now())
            self._update(rates_at=made, state=turned)


def _period_ms(rate: float) -> int:
    return min(_LONGEST_PERIOD, max(10, 10 * round(100.0 / rate)))
