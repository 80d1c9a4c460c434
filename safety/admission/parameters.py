"""Which firmware parameters a controller may write, when, and within which range.

Whatever shapes how a vehicle flies (gains, masses, filters, limits, noise of the estimator) keeps
to a range around its boot value: what the vehicle had before the runner wrote it for the first
time. In flight it is closed, unless ``Limits.tune_in_flight`` opens it to the same range.
Values are looked at as the firmware stores them: integers lose their fraction.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.checks import check_param_name
from crazyarena.errors import BackendError
from crazyarena.safety.admission.memory import GROUP_MASK, VehicleMemory
from crazyarena.safety.admission.room import CONTROLLER, Room
from crazyarena.safety.flight_model import BRAKING

# What has nothing to do with flying: always open.
_DECORATION = ("ring.", "led.", "sound.", "usd.")
# What stops, blinds or drives motors past every controller.
_NEVER = (
    "motorPowerSet.",
    "powerDist.",
    "system.",
    "health.",
    "supervisor.",
    "flightmode.",
    "cmdrCPPM.",
    "deck.",
)


@dataclass(frozen=True, slots=True)
class _Range:
    """Factors of the boot value between which a parameter may be set."""

    low: float
    high: float


_GAIN = _Range(0.8, 1.25)
# The longest matching name counts. Chosen so that every corner still flies, with both
# controllers, what the gate lets pass: see benchmarks/gate_fuzz.py.
_TUNED: Mapping[str, _Range] = {
    "ctrlMel.": _GAIN,
    "ctrlMel.mass": _Range(0.85, 1.25),
    "ctrlMel.massThrust": _Range(0.85, 1.2),
    "posCtlPid.": _GAIN,
    "posCtlPid.thrustBase": _Range(0.9, 1.1),
    "posCtlPid.thrustMin": _Range(0.8, 1.1),
    "velCtlPid.": _GAIN,
    "pid_attitude.": _GAIN,
    "pid_rate.": _GAIN,
    "hlCommander.vtoff": _Range(0.2, 2.0),
    "hlCommander.vland": _Range(0.2, 2.0),
    "kalman.pN": _Range(0.5, 2.0),
    "kalman.mN": _Range(0.5, 2.0),
    "kalman.maxPos": _Range(1.0, 1.0),
    "kalman.maxVel": _Range(1.0, 1.0),
    "kalman.robust": _Range(1.0, 1.0),
    "locSrv.": _Range(0.5, 2.0),
    "imu_sensors.": _Range(1.0, 1.0),
    "quadSysId.": _Range(1.0, 1.0),
    # Avoidance moves setpoints on board: it is set as a whole, by a command that is checked.
    "colAv.": _Range(1.0, 1.0),
    "colAv.enable": _Range(0.0, 0.0),
}
# Types of what is an integer on the vehicle, as far as a rule depends on its value.
_INTEGERS = {
    CONTROLLER: "B",
    "stabilizer.estimator": "B",
    "stabilizer.stop": "B",
    "commander.enHighLevel": "B",
    "colAv.enable": "B",
    GROUP_MASK: "B",
    "posCtlPid.thrustBase": "H",
    "posCtlPid.thrustMin": "H",
}
_SLACK = 1e-6  # of a value that went through single precision


def as_stored(name: str, value: float) -> float:
    """What the vehicle keeps of ``value``: single precision, or a C integer.

    Raises
    ------
    OverflowError: its type does not hold it.
    """
    kind = _INTEGERS.get(name)
    try:
        if kind is None:
            return float(struct.unpack("<f", struct.pack("<f", value))[0])
        return float(struct.unpack("<" + kind, struct.pack("<" + kind, int(value)))[0])
    except struct.error as error:
        raise OverflowError(str(error)) from None


def set_param(
    room: Room, m: c.SetParam, memory: VehicleMemory, now: float
) -> tuple[c.Command, list[str]]:
    name = check_param_name("setParam", m.name)
    if name.startswith(_NEVER):
        raise memory.refusal(m, f"{name} is not for controllers")
    if name.startswith(_DECORATION):
        return m, []
    try:
        value = as_stored(name, float(m.value))
    except OverflowError as error:
        raise memory.refusal(m, f"{name} does not hold {m.value!r}: {error}") from None
    allowed = _range_of(name)
    if memory.flying_since is not None and not (allowed and room.limits.tune_in_flight):
        hint = (
            "; the safety limit tune_in_flight opens it to a range around its boot value"
            if allowed
            else ""
        )
        raise memory.refusal(m, f"{name} cannot be written in flight{hint}")
    if name == CONTROLLER:
        _refuse_unknown_braking(room, m, memory, value)
    if allowed is None:
        return m, []
    boot = _boot_value(room, m, memory, name)
    ends = (allowed.low * boot, allowed.high * boot)
    low, high = min(ends), max(ends)
    if low - _SLACK * abs(low) <= value <= high + _SLACK * abs(high):
        return m, []
    text = f"{name} {value:g} is outside {low:g} .. {high:g}, the range around its boot value"
    return c.SetParam(m.name, min(max(value, low), high)), [text]


def _range_of(name: str) -> _Range | None:
    best = max((stem for stem in _TUNED if name.startswith(stem)), key=len, default=None)
    return None if best is None else _TUNED[best]


def _boot_value(room: Room, m: c.SetParam, memory: VehicleMemory, name: str) -> float:
    boot = memory.boot.get(name)
    if boot is None:
        try:
            boot = float(room.parameter(memory.vehicle, name))
        except BackendError as error:
            raise memory.refusal(
                m, f"{name} cannot be bounded without its present value ({error})"
            ) from None
        if math.isnan(boot):
            raise memory.refusal(m, f"{name} cannot be bounded: its present value is NaN")
        memory.boot[name] = boot
    return boot


def _refuse_unknown_braking(room: Room, m: c.SetParam, memory: VehicleMemory, value: float) -> None:
    braking = BRAKING.get(int(value))
    if braking is None:
        known = ", ".join(str(number) for number in BRAKING)
        raise memory.refusal(
            m, f"{m.name} {value:g}: how this controller brakes is not known; there are {known}"
        )
    if braking < room.limits.braking:
        raise memory.refusal(
            m,
            f"{m.name} {value:g} brakes more gently than the guard was told; set it in the "
            f"vehicle list, or the safety limit braking to {braking:g}",
        )
