"""A smooth, time-parametrised path through gates and around obstacles.

The path is a chain of quintic pieces. Its knots are the start, every gate centre (crossed along
the gate's normal), one free knot in the middle of every leg, and the goal. Positions,
velocities and accelerations of the knots and the durations of the pieces are chosen by
L-BFGS-B, minimising flight time plus penalties for acceleration, speed, jerk and clearance.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

SAMPLES = 14  # per piece, for the penalties


@dataclass(frozen=True)
class Gate:
    """Centre (3,) m and unit normal (3,) in flight direction, world frame."""

    centre: np.ndarray
    normal: np.ndarray

    @property
    def lateral(self) -> np.ndarray:
        """Unit vector along the gate's horizontal beams."""
        return np.array([-self.normal[1], self.normal[0], 0.0])


@dataclass(frozen=True)
class Limits:
    """What the vehicle and the rules allow. SI units."""

    acceleration: float = 4.0
    braking: float = 1.5  # on the way to rest at the goal, which may be close to a wall
    # A vehicle that loses its radio link keeps the last setpoint for half a second and then
    # coasts: it comes down at p + coasting v + coasting_push a, and that should be inside, too.
    coasting: float = 0.75  # s
    coasting_push: float = 0.1  # s2
    speed: float = 2.5
    gate_speed: float = 1.6
    clearance: float = 0.14  # from the vehicle's centre to any surface
    obstacle_uncertainty: float = 0.0  # obstacles may stand this far from where they are said to


@dataclass(frozen=True)
class Capsules:
    """Vertical and horizontal bars to stay clear of: end points (n, 3), radius (n,) m."""

    start: np.ndarray
    end: np.ndarray
    radius: np.ndarray

    def clearance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances (k, n) of points (k, 3) to the surfaces, negative inside, and their
        gradients (k, n, 3)."""
        axis = self.end - self.start
        length2 = (axis * axis).sum(-1)
        offset = points[:, None, :] - self.start
        along = np.clip((offset * axis).sum(-1) / length2, 0.0, 1.0)
        offset -= along[:, :, None] * axis
        distance = np.sqrt((offset * offset).sum(-1) + 1e-12)
        return distance - self.radius, offset / distance[..., None]


def bars(gates: list[Gate], obstacles: np.ndarray, spread: float) -> Capsules:
    """Frames and stands of the gates and the obstacles (n, 2 or more: x, y, ...) as capsules."""
    ends: list[tuple[np.ndarray, np.ndarray, float]] = []
    up = np.array([0.0, 0.0, 0.225])
    for gate in gates:
        side = 0.225 * gate.lateral
        ends += [
            (gate.centre + side - up, gate.centre + side + up, 0.03),
            (gate.centre - side - up, gate.centre - side + up, 0.03),
            (gate.centre - side - up, gate.centre + side - up, 0.03),
            (gate.centre - side + up, gate.centre + side + up, 0.03),
            (gate.centre * [1, 1, 0], gate.centre - up, 0.06),
        ]
    for x, y in obstacles[:, :2]:
        ends.append((np.array([x, y, 0.0]), np.array([x, y, 0.93]), 0.06 + spread))
    start, end, radius = zip(*ends, strict=True)
    return Capsules(np.array(start), np.array(end), np.array(radius))


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
class Path:
    """Knots and durations; evaluate with :meth:`at`.

    position, velocity, acceleration (knots, 3) SI; duration (knots - 1,) s; begin is the time
    of the first knot; gate_knots are the indices of the knots that are gate centres.
    """

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    duration: np.ndarray
    gate_knots: tuple[int, ...]
    begin: float = 0.0

    def __post_init__(self) -> None:
        coefficients = quintics(self.position, self.velocity, self.acceleration, self.duration)
        object.__setattr__(self, "_coefficients", coefficients)
        times = self.begin + np.append(0.0, np.cumsum(self.duration))
        object.__setattr__(self, "_times", times.tolist())

    @property
    def end(self) -> float:
        return self._times[-1]

    def knot_time(self, knot: int) -> float:
        return self._times[knot]

    def at(self, t: float) -> np.ndarray:
        """Position, velocity, acceleration and jerk as rows (4, 3) at time ``t`` (s)."""
        if t >= self._times[-1]:
            rest = np.zeros((4, 3))
            rest[0] = self.position[-1]
            return rest
        piece = max(0, bisect_right(self._times, t) - 1)
        n = 1.0 / (self._times[piece + 1] - self._times[piece])
        x = max(0.0, (t - self._times[piece]) * n)
        x2, x3, n2, n3 = x * x, x * x * x, n * n, n * n * n
        basis = np.array(
            [
                [1.0, x, x2, x3, x2 * x2, x2 * x3],
                [0.0, n, 2 * n * x, 3 * n * x2, 4 * n * x3, 5 * n * x2 * x2],
                [0.0, 0.0, 2 * n2, 6 * n2 * x, 12 * n2 * x2, 20 * n2 * x3],
                [0.0, 0.0, 0.0, 6 * n3, 24 * n3 * x, 60 * n3 * x2],
            ]
        )
        return basis @ self._coefficients[piece]

    def peak_acceleration(self, pieces: slice) -> float:
        """Largest acceleration (m/s2) on some of the pieces, sampled."""
        second = np.einsum("mk,skd->smd", _BASES[2], self._coefficients[pieces])
        second /= self.duration[pieces, None, None] ** 2
        return float(np.sqrt((second**2).sum(-1)).max())

    def beyond(self, pieces: slice, limits: Limits, bounds: tuple[np.ndarray, np.ndarray]) -> float:
        """How far out of ``bounds``, m, a lost link on some of the pieces would end, sampled."""
        c, t = self._coefficients[pieces], self.duration[pieces, None, None]
        points, first, second = (
            np.einsum("mk,skd->smd", _BASES[order], c) / t**order for order in range(3)
        )
        lost = (points + limits.coasting * first + limits.coasting_push * second)[..., :2]
        return float(max((bounds[0][:2] - lost).max(), (lost - bounds[1][:2]).max()))

    def rerouted(
        self,
        now: float,
        gate_index: int,
        gate: Gate,
        limit: float,
        limits: Limits,
        bounds: tuple[np.ndarray, np.ndarray],
    ) -> Path:
        """The path from its state at ``now`` on, through a gate that turned out to be elsewhere.

        The pieces to and from the gate are rebuilt; if the detour would need more than
        ``limit`` m/s2 or swing too far out, both are given more time.
        """
        knot = self.gate_knots[gate_index]
        p, v, a, _ = self.at(now)
        speed = float(np.linalg.norm(self.velocity[knot]))
        position, velocity, acceleration = (
            np.vstack([row, rows[knot:]])
            for row, rows in ((p, self.position), (v, self.velocity), (a, self.acceleration))
        )
        position[1] = gate.centre
        remaining = np.append(self.knot_time(knot) - now, self.duration[knot:])
        knots = tuple(k - knot + 1 for k in self.gate_knots)
        for stretch in (1.0, 1.1, 1.2, 1.35, 1.5, 1.75, 2.0):
            velocity[1] = gate.normal * (speed / stretch)
            acceleration[1] = self.acceleration[knot] / stretch**2
            duration = remaining.copy()
            duration[0] = max(0.2, remaining[0]) * stretch
            duration[1] *= 0.5 + 0.5 * stretch
            path = Path(position, velocity, acceleration, duration, knots, now)
            detour = slice(0, 2)
            if (
                path.peak_acceleration(detour) <= limit
                and path.beyond(detour, limits, bounds) <= 0.0
            ):
                break
        return path


def fly_through(
    start: np.ndarray,
    gates: list[Gate],
    goal: np.ndarray,
    obstacles: np.ndarray,
    limits: Limits,
    bounds: tuple[np.ndarray, np.ndarray],
) -> Path:
    """Plan from rest at ``start`` (3,) through ``gates`` to rest at ``goal`` (3,).

    ``obstacles`` (n, >= 2) are upright poles; ``bounds`` are the lower and upper corner (3,) of
    the arena. The returned path begins at time 0.
    """
    stations = [start, *(g.centre for g in gates), goal]
    legs = len(stations) - 1
    knots = 2 * legs + 1
    gate_knots = np.arange(2, knots - 1, 2)
    middle = np.arange(1, knots, 2)
    normals = np.array([g.normal for g in gates]).reshape(-1, 3)
    walls = bars(gates, obstacles, limits.obstacle_uncertainty)
    # Start and goal may lie closer to a wall than the path in between should.
    low = np.minimum(bounds[0] + 0.25, np.minimum(start, goal) - 0.02)
    high = np.maximum(bounds[1] - 0.25, np.maximum(start, goal) + 0.02)
    low[2] = start[2] - 0.005

    position = np.zeros((knots, 3))
    velocity = np.zeros((knots, 3))
    acceleration = np.zeros((knots, 3))
    position[::2] = stations
    position[middle] = (position[:-1:2] + position[2::2]) / 2

    speed = np.full(len(gates), 0.8 * limits.gate_speed)
    velocity[gate_knots] = normals * speed[:, None]
    velocity[middle] = 1.2 * (position[2::2] - position[:-1:2])
    velocity[middle] /= np.maximum(np.linalg.norm(velocity[middle], axis=1, keepdims=True), 1.0)
    chord = np.linalg.norm(np.diff(position, axis=0), axis=1)
    duration = np.maximum(chord / 1.0, 0.4)

    effort_limit = np.full((2 * legs, 1), limits.acceleration)
    effort_limit[-1] = limits.braking

    n_gates, n_mid = len(gates), len(middle)
    sizes = np.cumsum([2 * legs, n_gates, 3 * n_gates, 3 * n_mid, 3 * n_mid, 3 * n_mid])

    def unpack(x: np.ndarray) -> tuple[np.ndarray, ...]:
        d, s, ga, mp, mv, ma = np.split(x, sizes[:-1])
        p, v, a = position.copy(), velocity.copy(), acceleration.copy()
        v[gate_knots] = normals * s[:, None]
        a[gate_knots] = ga.reshape(-1, 3)
        p[middle], v[middle] = mp.reshape(-1, 3), mv.reshape(-1, 3)
        a[middle] = ma.reshape(-1, 3)
        return p, v, a, np.exp(d)

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        p, v, a, d = unpack(x)
        c = quintics(p, v, a, d)
        length = d[:, None, None]
        points, first, second, third = (
            np.einsum("mk,skd->smd", basis, c) / length**order for order, basis in enumerate(_BASES)
        )
        speed, g_first = _excess(first, limits.speed, 4.0)
        effort, g_second = _excess(second, effort_limit, 2.0)
        jolt, g_third = _excess(third, 0.0, 2e-4)
        distance, away = walls.clearance(points.reshape(-1, 3))
        gap = np.maximum(limits.clearance - distance, 0.0)
        crash = 3000.0 * (gap**2).sum(-1).reshape(speed.shape)
        g_points = -6000.0 * (gap[..., None] * away).sum(1).reshape(points.shape)
        outside = np.minimum(points - low, 0.0) + np.maximum(points - high, 0.0)
        leaving = 3000.0 * (outside**2).sum(-1)
        g_points += 6000.0 * outside
        lost = points + limits.coasting * first + limits.coasting_push * second
        beyond = np.minimum(lost - bounds[0], 0.0) + np.maximum(lost - bounds[1], 0.0)
        beyond[..., 2] = 0.0
        leaving += 300.0 * (beyond**2).sum(-1)
        g_points += 600.0 * beyond
        g_first += 600.0 * limits.coasting * beyond
        g_second += 600.0 * limits.coasting_push * beyond

        density = 1.0 + (speed + effort + jolt + crash + leaving).mean(axis=1)
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
        g_d += g_chain
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
            np.zeros(3 * n_gates),
            position[middle].ravel(),
            velocity[middle].ravel(),
            np.zeros(3 * n_mid),
        ]
    )
    box = (
        [(np.log(0.15), np.log(4.0))] * (2 * legs)
        + [(0.5, limits.gate_speed)] * n_gates
        + [(-limits.acceleration, limits.acceleration)] * (3 * n_gates)
        + [(None, None)] * (6 * n_mid)
        + [(-limits.acceleration, limits.acceleration)] * (3 * n_mid)
    )
    best = minimize(cost, x0, jac=True, method="L-BFGS-B", bounds=box, options={"maxiter": 600})
    return Path(*unpack(best.x), tuple(int(k) for k in gate_knots))


def oriented(
    poses: list[tuple[np.ndarray, float]], start: np.ndarray, goal: np.ndarray
) -> list[Gate]:
    """Gates from centres and yaws, each crossed in the direction that the track leads."""
    centres = [start, *(centre for centre, _ in poses), goal]
    gates = []
    for i, (centre, yaw) in enumerate(poses):
        gate = Gate(np.asarray(centre, float), np.array([-np.sin(yaw), np.cos(yaw), 0.0]))
        ahead = np.asarray(centres[i + 2]) - np.asarray(centres[i])
        gates.append(gate if gate.normal @ ahead >= 0 else replace(gate, normal=-gate.normal))
    return gates
