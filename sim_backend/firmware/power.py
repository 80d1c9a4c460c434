"""Power distribution: from a controller's output to motor commands.

Three variants: the 2022 firmware (each motor clipped on its own), the 2026 firmware (battery
compensation first, then all motors shifted down together), and the Python mixer of the 2022
competition software, which works in floating point and ends in rotor forces.

Motor rows hold M1 (front right), M2 (back right), M3 (back left), M4 (front left). Commands are
on the 0..65535 scale, kept as whole numbers in float64.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.firmware.layout import CT_PITCH, CT_ROLL, CT_THRUST, CT_YAW
from crazyarena.sim_backend.firmware.parameters import Param

PARAMS = (Param("powerDist.idleThrust", 0.0, 0.0, "uint32"),)
IDLE_THRUST = 0

MOTORS = 4
FULL_SCALE = 65535.0

# Platform row: what a build of the 2026 firmware takes its vehicle for.
PF_MAX_FORCE = 0  # N of one motor, at full scale
PF_MIN_FORCE = 1  # N: below it the fit of the volts does not hold, the motor is off
PF_ARM = 2  # m, from a motor to the x (and y) axis
PF_TORQUE = 3  # m, reaction torque per thrust
PF_THRUST = 4  # static thrust (N) of one motor over its voltage: c0 .. c3
# With v = t + shift the cubic is t^3 + linear t = force/c3 - constant.
PF_SHIFT = 8
PF_LINEAR = 9
PF_CONSTANT = 10
PLATFORM_SIZE = 11

_MIN_SUPPLY = 2.0  # V

# Competition software.
COMPETITION_KF = 3.16e-10  # N/rpm^2
COMPETITION_PWM_TO_RPM = 0.2685
COMPETITION_RPM_OFFSET = 4070.3
COMPETITION_MIN_PWM = 20000.0
_COMPETITION_SUPPLY = 3.0  # V


def platform_row(
    thrust: Sequence[float], max_force: float, min_force: float, arm: float, torque: float
) -> np.ndarray:
    """Platform row of a firmware build.

    Parameters
    ----------
    thrust
        (4,) static thrust (N) of one motor as a cubic of its volts, ascending powers; it must
        rise from the voltage of ``min_force`` on.
    max_force, min_force
        N of one motor.
    arm
        m, from the centre to a motor.
    torque
        m, reaction torque per thrust.
    """
    c0, c1, c2, c3 = thrust
    row = np.zeros(PLATFORM_SIZE)
    row[PF_MAX_FORCE], row[PF_MIN_FORCE] = max_force, min_force
    row[PF_ARM], row[PF_TORQUE] = 0.707106781 * arm, torque
    row[PF_THRUST : PF_THRUST + 4] = thrust
    shift = -c2 / (3.0 * c3)
    row[PF_SHIFT] = shift
    row[PF_LINEAR] = c1 / c3 - c2**2 / (3.0 * c3**2)
    row[PF_CONSTANT] = c0 / c3 + c1 / c3 * shift - 2.0 * shift**3
    return row


@kernel
def _whole(value: float) -> float:
    """Drop the fraction; not-a-number (undefined in C) becomes 0."""
    if math.isnan(value):
        return 0.0
    return float(np.trunc(value))


@kernel
def _add32(left: float, right: float) -> float:
    return float(np.float32(left) + np.float32(right))


@kernel
def mix(control: np.ndarray, motors: np.ndarray) -> None:
    """Write the unlimited whole-numbered motor commands of a control row (both generations)."""
    roll = _whole(0.5 * control[CT_ROLL])
    pitch = _whole(0.5 * control[CT_PITCH])
    yaw = control[CT_YAW]
    # The firmware adds in single precision: near a whole number that moves the result by one.
    thrust = np.float32(control[CT_THRUST])
    motors[0] = _whole(_add32(_add32(_add32(thrust, -roll), pitch), yaw))
    motors[1] = _whole(_add32(_add32(_add32(thrust, -roll), -pitch), -yaw))
    motors[2] = _whole(_add32(_add32(_add32(thrust, roll), -pitch), yaw))
    motors[3] = _whole(_add32(_add32(_add32(thrust, roll), pitch), -yaw))


@kernel
def _at_least(command: float, idle: float) -> float:
    """The larger one, as the firmware stores it: ``powerDist.idleThrust`` has 32 bits, this 16."""
    return max(command, idle) % (FULL_SCALE + 1.0)


@kernel
def distribute_2022(control: np.ndarray, idle: float, motors: np.ndarray) -> None:
    """Motor commands of the 2022 firmware: mixed, each clipped to 0..65535, at least ``idle``."""
    mix(control, motors)
    for i in range(MOTORS):
        motors[i] = _at_least(min(max(motors[i], 0.0), FULL_SCALE), idle)


@kernel
def brushed_volts(command: float) -> float:
    """Motor voltage that the 2022 generation asks for at a command (0..65535)."""
    grams = command / 65536.0 * 60.0
    return -0.0006239 * grams * grams + 0.088 * grams


@kernel
def compensate_2022(supply: float, motors: np.ndarray) -> None:
    """Motor driver of the 2022 firmware: scale commands for a battery of ``supply`` volts."""
    for i in range(MOTORS):
        ratio = min(1.0, brushed_volts(motors[i]) / supply)
        motors[i] = _whole(ratio * FULL_SCALE)


@kernel
def motor_volts_2026(platform: np.ndarray, force: float) -> float:
    """Voltage at which one motor lifts ``force`` newton (inverse of the cubic fit)."""
    linear = platform[PF_LINEAR]
    target = force / platform[PF_THRUST + 3] - platform[PF_CONSTANT]
    # Newton's method from within a few percent for the forces of a flight; where the cubic does
    # not rise everywhere, from above its largest root, from where it cannot miss.
    if linear > 0.0:
        t = target / (linear + 0.233 * abs(target))
    else:
        t = np.cbrt(max(target, 0.0)) + math.sqrt(-linear)
    for _ in range(100):
        step = (t * (t * t + linear) - target) / (3.0 * t * t + linear)
        t -= step
        if not abs(step) > 1e-8 * (1.0 + abs(t)):
            break
    return t + platform[PF_SHIFT]


@kernel
def compensate_2026(platform: np.ndarray, supply: float, motors: np.ndarray) -> None:
    """Battery compensation of the 2026 firmware, before capping; may exceed 65535.

    Parameters
    ----------
    platform
        Row of :func:`platform_row`.
    supply
        Low-passed battery voltage, see :func:`filter_supply`.
    motors
        Whole-numbered commands, changed in place.
    """
    for i in range(MOTORS):
        force = motors[i] / FULL_SCALE * platform[PF_MAX_FORCE]
        if force < platform[PF_MIN_FORCE] or supply < _MIN_SUPPLY:
            motors[i] = 0.0
        else:
            motors[i] = _whole(FULL_SCALE * (motor_volts_2026(platform, force) / supply))


@kernel
def filter_supply(filtered: float, measured: float) -> float:
    """Next low-passed battery voltage (one 1 ms loop; 4.2 V at boot)."""
    return filtered + 0.01 * (measured - filtered)


@kernel
def cap_2026(motors: np.ndarray, idle: float) -> bool:
    """Shift all motors down by the excess of the largest, then raise them to ``idle``.

    Returns
    -------
    True when something had to be reduced.
    """
    excess = max(max(motors[0], motors[1]), max(motors[2], motors[3])) - FULL_SCALE
    capped = excess > 0.0
    for i in range(MOTORS):
        value = motors[i] - excess if capped else motors[i]
        motors[i] = _at_least(value, idle)
    return capped


@kernel
def distribute_2026(
    platform: np.ndarray, control: np.ndarray, supply: float, idle: float, motors: np.ndarray
) -> bool:
    """Whole 2026 chain: mixed, battery compensated, capped; True when capped."""
    mix(control, motors)
    compensate_2026(platform, supply, motors)
    return cap_2026(motors, idle)


@kernel
def mix_force_torque_2026(
    platform: np.ndarray,
    thrust: float,
    torque_x: float,
    torque_y: float,
    torque_z: float,
    motors: np.ndarray,
) -> None:
    """Uncapped commands of the force/torque mode: newton, newton metre."""
    part = 0.25 * thrust
    roll = 0.25 * torque_x / platform[PF_ARM]
    pitch = 0.25 * torque_y / platform[PF_ARM]
    yaw = 0.25 * torque_z / platform[PF_TORQUE]
    motors[0] = part - roll - pitch - yaw
    motors[1] = part - roll + pitch + yaw
    motors[2] = part + roll + pitch - yaw
    motors[3] = part + roll - pitch + yaw
    for i in range(MOTORS):
        motors[i] = _whole(max(motors[i], 0.0) / platform[PF_MAX_FORCE] * FULL_SCALE)


@kernel
def mix_normalized_2026(normalized: np.ndarray, motors: np.ndarray) -> None:
    """Commands of the per-motor mode: four values, clipped to 0..1."""
    for i in range(MOTORS):
        motors[i] = _whole(min(max(normalized[i], 0.0), 1.0) * FULL_SCALE)


@kernel
def distribute_competition(control: np.ndarray, pwm: np.ndarray, forces: np.ndarray) -> None:
    """Mixer of the 2022 competition software, down to rotor forces.

    Parameters
    ----------
    control
        Control row.
    pwm
        Written: PWM of M1..M4 at a constant 3 V supply, 0..65535, not whole-numbered.
    forces
        Written: newton per rotor in the environment's order M4, M3, M2, M1.
    """
    roll = 0.5 * control[CT_ROLL]
    pitch = 0.5 * control[CT_PITCH]
    yaw = control[CT_YAW]
    thrust = control[CT_THRUST]
    pwm[0] = thrust - roll + pitch + yaw
    pwm[1] = thrust - roll - pitch - yaw
    pwm[2] = thrust + roll - pitch + yaw
    pwm[3] = thrust + roll + pitch - yaw
    for i in range(MOTORS):
        volts = brushed_volts(min(max(pwm[i], 0.0), FULL_SCALE))
        pwm[i] = FULL_SCALE * min(1.0, volts / _COMPETITION_SUPPLY)
        limited = max(pwm[i], COMPETITION_MIN_PWM)
        rpm = COMPETITION_PWM_TO_RPM * limited + COMPETITION_RPM_OFFSET
        forces[MOTORS - 1 - i] = COMPETITION_KF * rpm * rpm
