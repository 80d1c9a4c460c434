"""A smooth, time-parametrised route through gates and around poles.

The route is a chain of quintic pieces. Its knots are where the drone is, every gate's centre
(crossed along the gate's normal), one free knot in the middle of every leg, and a place beyond the
last gate. Positions, velocities and accelerations of the knots and the durations of the pieces are
chosen by L-BFGS-B, minimising flight time plus penalties for acceleration, speed, jerk and
clearance. A route can be planned anew from any state; the one before is then the first guess.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

SAMPLES = 14  # per piece, for the penalties
BEYOND = 0.5  # m, behind the last gate


@dataclass(frozen=True)
class Gate:
    """Centre (3,) m; unit normal in flight direction, lateral and up axis (3,), world frame."""

    centre: np.ndarray
    normal: np.ndarray
    lateral: np.ndarray
    up: np.ndarray


@dataclass(frozen=True)
class Limits:
    """What the drone and the rules allow. SI units."""

    acceleration: float = 5.0
    speed: float = 2.2
    gate_speed: float = 1.35
    clearance: float = 0.18  # from the drone's centre to any surface
    low: tuple[float, float, float] = (-2.4, -1.4, 0.0)
    high: tuple[float, float, float] = (2.4, 1.4, 1.9)


@dataclass(frozen=True)
class State:
    """Position, velocity, acceleration (3,) SI."""

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


def gates_of(obs) -> list[Gate]:
    """The gates that are left to pass, as far as an observation tells of them."""
    sequence = obs.get("gate_sequence", np.arange(len(obs["gates_pos"])))
    direction = obs.get("gate_sequence_direction", np.ones(len(sequence)))
    if "n_gates_passed" in obs:
        passed = int(obs["n_gates_passed"])
    else:
        passed = len(sequence) if obs["target_gate"] < 0 else int(obs["target_gate"])
    left = []
    for number, sign in list(zip(sequence, direction, strict=True))[passed:]:
        axes = Rotation.from_quat(obs["gates_quat"][number]).as_matrix()
        centre = np.array(obs["gates_pos"][number], dtype=float)
        left.append(Gate(centre, sign * axes[:, 0], axes[:, 1], axes[:, 2]))
    return left


def bars(gates_pos, gates_quat, obstacles_pos, spread) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames and stands of all gates, and the poles, as capsules: ends (n, 3) twice, radius (n,).

    ``spread`` (m,) is added to the radius of the poles.
    """
    ends = []
    for centre, quat in zip(np.asarray(gates_pos, float), gates_quat, strict=True):
        axes = Rotation.from_quat(quat).as_matrix()
        side, up = 0.28 * axes[:, 1], 0.28 * axes[:, 2]
        ends += [
            (centre + side - up, centre + side + up, 0.08),
            (centre - side - up, centre - side + up, 0.08),
            (centre - side - up, centre + side - up, 0.08),
            (centre - side + up, centre + side + up, 0.08),
            (centre - 1.36 * axes[:, 2], centre - 0.36 * axes[:, 2], 0.06),
        ]
    for top, more in zip(np.asarray(obstacles_pos, float), spread, strict=True):
        ends.append((top * [1, 1, 0], top, 0.015 + more))
    start, end, radius = zip(*ends, strict=True)
    return np.array(start), np.array(end), np.array(radius)


def _clearance(walls, points):
    """Distances (k, n) of points (k, 3) to capsules, negative inside, and gradients (k, n, 3)."""
    start, end, radius = walls
    axis = end - start
    length2 = (axis * axis).sum(-1)
    offset = points[:, None, :] - start
    along = np.clip((offset * axis).sum(-1) / length2, 0.0, 1.0)
    offset -= along[:, :, None] * axis
    distance = np.sqrt((offset * offset).sum(-1) + 1e-12)
    return distance - radius, offset / distance[..., None]


def _basis(tau: np.ndarray, order: int) -> np.ndarray:
    """Derivative of the monomials 1, t, ... t^5 at ``tau``: (len(tau), 6)."""
    powers = np.zeros((len(tau), 6))
    for k in range(order, 6):
        factor = np.prod(np.arange(k - order + 1, k + 1)) if order else 1.0
        powers[:, k] = factor * tau ** (k - order)
    return powers


_TAU = (np.arange(SAMPLES) + 0.5) / SAMPLES
_BASES = [_basis(_TAU, order) for order in range(4)]


def quintics(p: np.ndarray, v: np.ndarray, a: np.ndarray, duration: np.ndarray) -> np.ndarray:
    """Coefficients (pieces, 6, 3) in normalised time between knots (pieces + 1, 3)."""
    t = duration[:, None]
    p0, v0, a0 = p[:-1], v[:-1] * t, a[:-1] * t * t / 2
    dp = p[1:] - p0 - v0 - a0
    dv = v[1:] * t - v0 - 2 * a0
    da = a[1:] * t * t - 2 * a0
    c3 = 10 * dp - 4 * dv + da / 2
    c4 = -15 * dp + 7 * dv - da
    c5 = 6 * dp - 3 * dv + da / 2
    return np.stack([p0, v0, a0, c3, c4, c5], axis=1)


def _knot_gradient(
    g: np.ndarray, v: np.ndarray, a: np.ndarray, duration: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Turn the gradient of the coefficients into that of knots and durations.

    The reverse of :func:`quintics`, line by line.
    """
    t = duration[:, None]
    g0, g1, g2, g3, g4, g5 = (g[:, k] for k in range(6))
    g_dp = 10 * g3 - 15 * g4 + 6 * g5
    g_dv = -4 * g3 + 7 * g4 - 3 * g5
    g_da = g3 / 2 - g4 + g5 / 2
    g0 = g0 - g_dp
    g1 = g1 - g_dp - g_dv
    g2 = g2 - g_dp - 2 * g_dv - 2 * g_da
    g_p, g_v, g_a = (np.zeros_like(v) for _ in range(3))
    g_p[:-1], g_v[:-1], g_a[:-1] = g0, t * g1, t * t / 2 * g2
    g_p[1:] += g_dp
    g_v[1:] += t * g_dv
    g_a[1:] += t * t * g_da
    g_t = (v[:-1] * g1 + v[1:] * g_dv + t * (a[:-1] * g2 + 2 * a[1:] * g_da)).sum(-1)
    return g_p, g_v, g_a, g_t


def _excess(
    vectors: np.ndarray, limit: float | np.ndarray, weight: float
) -> tuple[np.ndarray, np.ndarray]:
    """Squared excess of the norms over ``limit``, and its gradient."""
    norm = np.sqrt((vectors * vectors).sum(-1) + 1e-9)
    over = np.maximum(norm - limit, 0.0)
    return weight * over**2, (2 * weight * over / norm)[..., None] * vectors


@dataclass(frozen=True)
class Route:
    """Knots (position, velocity, acceleration (knots, 3) SI), durations (knots - 1,) s, the time
    of the first knot, and what it costs: flight time plus what breaks a limit."""

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    duration: np.ndarray
    begin: float
    cost: float

    def __post_init__(self) -> None:
        coefficients = quintics(self.position, self.velocity, self.acceleration, self.duration)
        object.__setattr__(self, "_coefficients", coefficients)
        times = self.begin + np.append(0.0, np.cumsum(self.duration))
        object.__setattr__(self, "_times", times.tolist())

    @property
    def end(self) -> float:
        """When the last knot is reached, s."""
        return self._times[-1]

    @property
    def gate_times(self) -> list[float]:
        """When its gates are passed, s."""
        return self._times[2:-1:2]

    def at(self, t: float) -> np.ndarray:
        """Position, velocity, acceleration as rows (3, 3) at a time, s; straight on at the end."""
        late = max(0.0, t - self._times[-1])
        piece = min(max(0, bisect_right(self._times, t) - 1), len(self.duration) - 1)
        n = 1.0 / self.duration[piece]
        x = min(max(0.0, (t - self._times[piece]) * n), 1.0)
        x2, x3, n2 = x * x, x * x * x, n * n
        basis = np.array(
            [
                [1.0, x, x2, x3, x2 * x2, x2 * x3],
                [0.0, n, 2 * n * x, 3 * n * x2, 4 * n * x3, 5 * n * x2 * x2],
                [0.0, 0.0, 2 * n2, 6 * n2 * x, 12 * n2 * x2, 20 * n2 * x3],
            ]
        )
        rows = basis @ self._coefficients[piece]
        if late:
            rows[0] += late * rows[1]
            rows[2] = 0.0
        return rows

    def left_at(self, t: float, gates: int) -> tuple[np.ndarray, ...]:
        """Guess for a route from time ``t`` on through the last ``gates`` gates."""
        pieces = 2 * (gates + 1)
        first = len(self.duration) - pieces
        duration = self.duration[first:].copy()
        p, v, a = (
            rows[first:].copy() for rows in (self.position, self.velocity, self.acceleration)
        )
        gone = (t - self._times[first]) / (self._times[first + 2] - self._times[first])
        if gone > 0.0:
            # The middle of what is left of the leg.
            target = self._times[first + 2]
            half = max(0.08, 0.5 * (target - t))
            p[1], v[1], a[1] = self.at(max(target - half, self._times[0]))
            duration[:2] = half
        return p, v, a, duration


def first_guess(start: State, gates: list[Gate], swing: float, lift: float) -> tuple:
    """Straight legs, their middles moved sideways and up by some metres, away from the side on
    which a gate would have to be passed twice."""
    stations = [start.position]
    stations += [gate.centre for gate in gates]
    stations.append(gates[-1].centre + BEYOND * gates[-1].normal)
    knots = 2 * len(stations) - 1
    position, velocity, acceleration = (np.zeros((knots, 3)) for _ in range(3))
    position[::2] = stations
    position[1::2] = (position[:-1:2] + position[2::2]) / 2
    for i in range(len(gates) - 1):
        # From gate i to gate i + 1: out along its normal, in along the next one's.
        out, into = gates[i].normal, gates[i + 1].normal
        middle = position[2 * i + 3]
        middle += swing * (out - into) / 2
        middle[2] += lift
    velocity[2:-1:2] = [gate.normal for gate in gates]
    velocity[-1] = gates[-1].normal
    chord = np.linalg.norm(np.diff(position, axis=0), axis=1)
    middle = np.arange(1, knots, 2)
    velocity[middle] = position[2::2] - position[:-1:2]
    velocity[middle] /= np.maximum(np.linalg.norm(velocity[middle], axis=1, keepdims=True), 0.5)
    return position, velocity, acceleration, np.maximum(chord / 1.3, 0.25)


def plan(
    start: State, gates: list[Gate], walls, limits: Limits, begin: float, guess, iterations: int
) -> Route:
    """Route from ``start`` through ``gates``; ``walls`` are those of :func:`bars`."""
    position, velocity, acceleration, duration = (np.array(rows, float) for rows in guess)
    legs = len(gates) + 1
    gate_knots = np.arange(2, 2 * legs + 1, 2)  # the place beyond the last gate is like a gate
    middle = np.arange(1, 2 * legs + 1, 2)
    normals = np.array([g.normal for g in gates] + [gates[-1].normal])
    position[0], velocity[0], acceleration[0] = start.position, start.velocity, start.acceleration
    position[gate_knots[:-1]] = [g.centre for g in gates]
    position[-1] = gates[-1].centre + BEYOND * gates[-1].normal
    low = np.minimum(np.array(limits.low), start.position - 0.005)
    high = np.maximum(np.array(limits.high), start.position + 0.005)
    # In the first moments only where it is decides, and close to the floor nothing else can be.
    low[2] = min(start.position[2] - 0.005, 0.25)
    speed = np.clip((velocity[gate_knots] * normals).sum(-1), 0.5, limits.gate_speed)
    n_gates, n_mid = len(gate_knots), len(middle)
    sizes = np.cumsum([2 * legs, n_gates, 3 * n_gates, 3 * n_mid, 3 * n_mid, 3 * n_mid])

    def unpack(x):
        d, s, ga, mp, mv, ma = np.split(x, sizes[:-1])
        p, v, a = position.copy(), velocity.copy(), acceleration.copy()
        v[gate_knots] = normals * s[:, None]
        a[gate_knots] = ga.reshape(-1, 3)
        p[middle], v[middle] = mp.reshape(-1, 3), mv.reshape(-1, 3)
        a[middle] = ma.reshape(-1, 3)
        return p, v, a, np.exp(d)

    def cost(x):
        p, v, a, d = unpack(x)
        c = quintics(p, v, a, d)
        length = d[:, None, None]
        points, first, second, third = (
            np.einsum("mk,skd->smd", basis, c) / length**order for order, basis in enumerate(_BASES)
        )
        pace, g_first = _excess(first, limits.speed, 4.0)
        effort, g_second = _excess(second, limits.acceleration, 2.0)
        jolt, g_third = _excess(third, 0.0, 2e-4)
        distance, away = _clearance(walls, points.reshape(-1, 3))
        gap = np.maximum(limits.clearance - distance, 0.0)
        crash = 5000.0 * (gap**2).sum(-1).reshape(pace.shape)
        g_points = -10000.0 * (gap[..., None] * away).sum(1).reshape(points.shape)
        outside = np.minimum(points - low, 0.0) + np.maximum(points - high, 0.0)
        leaving = 3000.0 * (outside**2).sum(-1)
        g_points += 6000.0 * outside
        density = 1.0 + (pace + effort + jolt + crash + leaving).mean(axis=1)
        share = length / SAMPLES
        slopes = (g_points * share, g_first * share, g_second * share, g_third * share)
        g_c = sum(
            np.einsum("mk,smd->skd", basis, slope) / length**order
            for order, (basis, slope) in enumerate(zip(_BASES, slopes, strict=True))
        )
        g_d = density - sum(
            order * (slope * value).sum((1, 2)) / d
            for order, (slope, value) in enumerate(
                zip(slopes, (points, first, second, third), strict=True)
            )
        )
        g_p, g_v, g_a, g_chain = _knot_gradient(g_c, v, a, d)
        g_d = g_d + g_chain
        gradient = np.concatenate(
            [
                g_d * d,
                (g_v[gate_knots] * normals).sum(-1),
                g_a[gate_knots].ravel(),
                g_p[middle].ravel(),
                g_v[middle].ravel(),
                g_a[middle].ravel(),
            ]
        )
        return float((d * density).sum()), gradient

    x0 = np.concatenate(
        [
            np.log(duration),
            speed,
            acceleration[gate_knots].ravel(),
            position[middle].ravel(),
            velocity[middle].ravel(),
            acceleration[middle].ravel(),
        ]
    )
    most = limits.acceleration
    box = (
        [(np.log(0.05), np.log(4.0))] * (2 * legs)
        + [(0.5, limits.gate_speed)] * n_gates
        + [(-most, most)] * (3 * n_gates)
        + [(None, None)] * (6 * n_mid)
        + [(-most, most)] * (3 * n_mid)
    )
    best = minimize(
        cost, x0, jac=True, method="L-BFGS-B", bounds=box, options={"maxiter": iterations}
    )
    return Route(*unpack(best.x), begin, float(best.fun))
