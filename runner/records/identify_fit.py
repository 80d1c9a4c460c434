"""What single streams of a flight's log tell of its vehicle, each by a regression of its own.

Rotor drag: the specific force along the body's x and y axes is drag alone, whatever the rotors do
(Svacha, Loianno and Kumar, "Inertial Yaw-Independent Velocity and Attitude Estimation", RA-L
2019). Thrust: at hover the torques of four rotors balance, so each carries a quarter. Battery:
voltage against the current that the motors' commands stand for. Rotor lag: a first-order lag of
the rotors' speeds between commands and turning rates (Förster, ETH Zurich 2015).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize_scalar
from scipy.signal import butter, lfilter, savgol_filter, sosfilt, sosfiltfilt
from scipy.spatial.transform import Rotation

from crazyarena.runner.records.validate_flights import RealFlight, Series
from crazyarena.runner.records.validate_replay import judged
from crazyarena.sim_backend.firmware.stack_2026 import GYRO_CUTOFF
from crazyarena.sim_backend.physics import arena_plant as ap
from crazyarena.sim_backend.physics.rigid_body import P_MASS

Array = NDArray[np.float64]

FAST = 190.0  # Hz, below which a rotor lag cannot be seen in turning rates
_SLOW = 0.25  # m/s, root mean square along an axis, below which its drag is not seen
_CLOCKS = 0.06  # s by which the clocks of two streams may differ
_STEP_AMPERES = 0.4  # standard deviation of the current below which resistance is not seen
_FULL = 0.97  # command above which a motor counts as saturated
_LAGS = (0.005, 0.4)  # s, in which a rotor lag is sought
_BAND = (0.8, 40.0)  # Hz, of the turning rates that are compared


class NotTold(Exception):
    """The log does not tell this number; the text says why, for a user."""


@dataclass(frozen=True, slots=True)
class Told:
    """A number (or several) and its standard error, both of the same shape."""

    value: Array
    error: Array


def rate(series: Series) -> float:
    """Samples per second."""
    if len(series) < 3:
        return 0.0
    return float(1.0 / max(np.median(np.diff(series.time)), 1e-6))


def velocity(pose: Series) -> Series:
    """Velocity (n, 3) m/s of logged positions, by local cubics over 0.15 s."""
    step = 0.01
    time = np.arange(pose.time[0], pose.time[-1], step)
    if len(time) < 31:
        raise NotTold("the log is shorter than 0.3 s")
    at = pose.at(time)
    return Series(time, savgol_filter(at, 15, 3, deriv=1, delta=step, axis=0))


def saturation(flight: RealFlight) -> float:
    """Share of the judged time in which a motor is at its full command."""
    motors = flight.motors
    if not len(motors):
        return 0.0
    inside = judged(flight, motors.time)
    return float((motors.value[inside] > _FULL).any(axis=1).mean()) if inside.any() else 0.0


def drag(flight: RealFlight) -> Told:
    """Drag along body x and y by mass, 1/s.

    Raises
    ------
    NotTold: no accelerometer or attitude, or too slow.
    """
    force, attitude = flight.acceleration, flight.attitude
    if not len(force) or not len(attitude):
        raise NotTold("needs accelerometer and attitude")
    inside = judged(flight, force.time)
    if inside.sum() < 50:
        raise NotTold("too short: fewer than 50 samples of the accelerometer")
    time, pull = force.time[inside], ap.GRAVITY * force.value[inside, :2]
    moving = velocity(flight.pose)

    def along(shift: float) -> Array:
        turn = Rotation.from_quat(attitude.at(time))
        return np.asarray(turn.inv().apply(moving.at(time + shift)))[:, :2]

    def fit(shift: float) -> tuple[Array, Array, float]:
        speed = along(shift)
        values, errors, rest = np.empty(2), np.empty(2), 0.0
        for axis in range(2):
            columns = np.stack([speed[:, axis], np.ones(len(time))], axis=1)
            found, error, left = _regress(columns, -pull[:, axis])
            values[axis], errors[axis] = found[0], error[0]
            rest += left
        return values, errors, rest

    slow = np.sqrt((along(0.0) ** 2).mean(axis=0))
    if slow.min() < _SLOW:
        axis = "xy"[int(slow.argmin())]
        raise NotTold(f"too slow: {slow.min():.2f} m/s along body {axis}; fly above {_SLOW:g}")
    shifts = np.arange(-_CLOCKS, _CLOCKS + 1e-9, 0.005)
    best = min(shifts, key=lambda shift: fit(shift)[2])
    values, errors, _ = fit(best)
    return Told(values, errors)


def _regress(columns: Array, target: Array) -> tuple[Array, Array, float]:
    """Least squares: coefficients, their standard errors, and what is left (sum of squares).

    Samples of a flight hang together: errors count one sample in ten.
    """
    solved, _, rank, _ = np.linalg.lstsq(columns, target, rcond=None)
    found: Array = solved.astype(np.float64)
    left = target - columns @ found
    rest = float(left @ left)
    if rank < columns.shape[1]:
        raise NotTold("the flight does not vary enough")
    free = max(len(target) // 10 - columns.shape[1], 1)
    scale = rest / len(target)
    inverse = np.linalg.inv(columns.T @ columns / len(target))
    return found, np.sqrt(scale * np.diag(inverse) / free), rest


def nominal(flight: RealFlight, plant: Array, time: Array, motors: Array) -> Array:
    """Steady thrust (n, 4) N of the model's motors for logged commands and battery voltage."""
    if not len(flight.volts):
        raise NotTold("needs battery voltage and motor commands")
    volts = flight.volts.at(time)[:, 0]
    polynomial = plant[ap.AP_THRUST : ap.AP_THRUST + 4]
    thrust = np.polynomial.polynomial.polyval(motors * volts[:, None], polynomial)
    return np.asarray(np.maximum(thrust, 0.0))


def follow(wanted: Array, step: float, up: float, down: float) -> Array:
    """Speeds (n, m) that follow the wanted ones (n, m) with first-order lags, s; ``step`` s."""
    rise = 1.0 - np.exp(-step / up)
    if up == down:
        past = (1.0 - rise) * wanted[:1]
        return np.asarray(lfilter([rise], [1.0, rise - 1.0], wanted, axis=0, zi=past)[0])
    fall = 1.0 - np.exp(-step / down)
    speeds = np.empty_like(wanted)
    speed = wanted[0].copy()
    for k, target in enumerate(wanted):
        change = target - speed
        speed += np.where(change > 0.0, rise, fall) * change
        speeds[k] = speed
    return speeds


def _lagged(flight: RealFlight, plant: Array) -> tuple[Array, Array]:
    """Times (n,) and root-of-thrust speeds (n, 4) of the model's rotors."""
    motors = flight.motors
    if not len(motors):
        raise NotTold("needs battery voltage and motor commands")
    wanted = np.sqrt(nominal(flight, plant, motors.time, motors.value))
    step = 1.0 / rate(motors)
    speeds = follow(wanted, step, float(plant[ap.AP_LAG_UP]), float(plant[ap.AP_LAG_DOWN]))
    return motors.time, speeds


def strength(flight: RealFlight, plant: Array) -> Told:
    """Strength (4,) of M1..M4 relative to the model, for the model's mass.

    Raises
    ------
    NotTold: no motor commands or voltage, or never in the air.
    """
    time, speeds = _lagged(flight, plant)
    inside = judged(flight, time) & (flight.motors.value > 0.05).all(axis=1)
    if inside.sum() < 50:
        raise NotTold("too short: fewer than 50 samples of motors in flight")
    pull = 1.0
    if len(flight.acceleration):
        chosen = judged(flight, flight.acceleration.time)
        pull = float(flight.acceleration.value[chosen, 2].mean())
    share = 0.25 * float(plant[P_MASS]) * ap.GRAVITY * pull
    thrust = speeds[inside] ** 2
    mean = thrust.mean(axis=0)
    error = thrust.std(axis=0) / np.sqrt(max(len(thrust) / 50.0, 1.0)) / mean
    return Told(share / mean, share / mean * error)


def resistance(flight: RealFlight, plant: Array) -> Told:
    """Resistance (1,) Ohm of the battery, for the model's current law.

    Raises
    ------
    NotTold: no motor commands or voltage, or a current that hardly changes.
    """
    time, speeds = _lagged(flight, plant)
    current = plant[ap.AP_CURRENT] * (speeds**3).sum(axis=1)
    volts = flight.volts
    known = (volts.time >= time[0]) & (volts.time <= time[-1])
    at = volts.time[known]
    if len(at) < 20:
        raise NotTold("too short: fewer than 20 samples of the voltage")
    drawn = Series(time, np.concatenate(([0.0], np.cumsum(current[:-1] * np.diff(time)))))
    amperes, charge = Series(time, current).at(at)[:, 0], drawn.at(at)[:, 0]
    if amperes.std() < _STEP_AMPERES:
        raise NotTold("the current hardly changes: log from before take-off")
    columns = np.stack([-amperes, np.ones(len(at)), -charge], axis=1)
    found, error, _ = _regress(columns, volts.value[known])
    return Told(found[:1], error[:1])


def lag(flight: RealFlight, plant: Array) -> Told:
    """Rotor lag (2,) s, up and down: from rotor speeds if they are logged, else (both equal) from
    turning rates.

    Raises
    ------
    NotTold: motors, or both of these, are logged too slowly or not at all.
    """
    motors = flight.motors
    if not len(motors) or rate(motors) < FAST:
        raise NotTold(f"needs motor commands at {FAST:.0f} Hz or more")
    if rate(flight.rotors) >= FAST:
        return _lag_of_speeds(flight, plant)
    if rate(flight.gyro) >= FAST:
        return _lag_of_rates(flight, plant)
    raise NotTold(f"needs rotor speeds or gyro at {FAST:.0f} Hz or more")


def _grid(flight: RealFlight, plant: Array) -> tuple[Array, float, Array]:
    """Even times (n,) of the judged flight, their step, and wanted speeds (n, 4)."""
    motors = flight.motors
    chosen = motors.time[judged(flight, motors.time)]
    if len(chosen) < 400:
        raise NotTold("too short: fewer than 400 fast samples")
    step = 1.0 / rate(motors)
    time = np.arange(chosen[0], chosen[-1], step)
    commands = motors.value[np.clip(np.searchsorted(motors.time, time + 1e-9) - 1, 0, None)]
    return time, step, np.sqrt(nominal(flight, plant, time, commands))


def _lag_of_speeds(flight: RealFlight, plant: Array) -> Told:
    time, step, wanted = _grid(flight, plant)
    seen = flight.rotors.at(time)

    def residual(logs: Array) -> Array:
        speeds = follow(wanted, step, float(np.exp(logs[0])), float(np.exp(logs[1])) + 1e-9)
        left = np.empty_like(seen)
        for rotor in range(4):
            columns = np.stack([speeds[:, rotor], np.ones(len(time))], axis=1)
            scale = np.linalg.lstsq(columns, seen[:, rotor], rcond=None)[0]
            left[:, rotor] = seen[:, rotor] - columns @ scale
        return left.ravel()

    low, high = np.log(_LAGS)
    best = least_squares(
        residual, np.log([0.06, 0.07]), bounds=(low, high), diff_step=1e-2, xtol=1e-4
    )
    return Told(np.exp(best.x), np.exp(best.x) * _spread(best))


def _spread(best: object) -> Array:
    """Standard errors of fitted logarithms; samples hang together, one in fifty counts."""
    jacobian, left = best.jac, best.fun  # type: ignore[attr-defined]
    scale = 50.0 * float(left @ left) / max(len(left) - jacobian.shape[1], 1)
    inverse = np.linalg.pinv(jacobian.T @ jacobian)
    return np.asarray(np.sqrt(scale * np.diag(inverse)))


def _lag_of_rates(flight: RealFlight, plant: Array) -> Told:
    time, step, wanted = _grid(flight, plant)
    band = butter(2, _BAND, btype="bandpass", fs=1.0 / step, output="sos")
    # The firmware logs its gyro behind this filter, so the model's torque passes it as well.
    gyro = butter(2, GYRO_CUTOFF, fs=1.0 / step, output="sos") if step < 0.4 / GYRO_CUTOFF else None
    seen = sosfiltfilt(band, flight.gyro.at(time)[:, :2], axis=0)
    seen /= seen.std(axis=0)

    def left(lag: float) -> Array:
        # Each rotor's own lever: motors that differ turn the vehicle when all get stronger.
        turned = step * np.cumsum(follow(wanted, step, lag, lag) ** 2, axis=0)
        turned = turned if gyro is None else sosfilt(gyro, turned - turned[0], axis=0)
        turned = sosfiltfilt(band, turned, axis=0)
        levers = np.linalg.lstsq(turned, seen, rcond=None)[0]
        return np.asarray(seen - turned @ levers)

    def cost(log: float) -> float:
        return float((left(float(np.exp(log))) ** 2).sum())

    best = minimize_scalar(cost, bounds=tuple(np.log(_LAGS)), method="bounded")
    found = float(np.exp(best.x))
    return Told(np.full(2, found), np.full(2, found * _curvature(cost, float(best.x), len(time))))


def _curvature(cost: Callable[[float], float], at: float, samples: int) -> float:
    """Standard error of a logarithm that minimises a sum of squares of ``samples``."""
    step = 0.1
    bend = (cost(at + step) - 2.0 * cost(at) + cost(at - step)) / step**2
    if bend <= 0.0:
        return float("inf")
    return float(np.sqrt(2.0 * 50.0 * cost(at) / samples / bend))
