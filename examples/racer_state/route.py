"""A smooth, time-parametrised route through gates and around poles.

The route is a chain of quintic pieces. Its knots are where the drone is, every gate's centre
(crossed along the gate's normal), one free knot in the middle of every leg, and a place beyond the
last gate. Positions, velocities and accelerations of the knots and the durations of the pieces are
chosen by BFGS (Nocedal and Wright, Numerical Optimization, chapter 6), minimising flight time plus
penalties for acceleration, speed, jerk and clearance.

A :class:`Plan` is worked on in small portions, so that a controller may think a few milliseconds
at every step, and is begun from the route flown so far and what was learned about its curvature.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

SAMPLES = 14  # per piece, for the penalties
UNSEEN = 0.12  # m, that poles and stands nobody has seen are thought to be thicker
DEEP = 0.12  # m, that frames nobody has seen are thought to reach before and behind
BEYOND = 0.5  # m, behind the last gate
PER_LEG = 15  # unknowns: two durations, speed, acceleration at the gate, 9 of the middle knot
UNEVEN = 1.0  # logarithm of how many times longer a leg's one half may last than the other
SWING = 0.4  # m, by which another way round is tried
SIGHT, SLOWING = 0.75, 0.5  # m, at which gates are seen; on which it slows down before
SLOW = 0.5  # m/s, the least through a gate
THROUGH, ROOM = 0.1, 0.18  # m, before and behind a gate straight on; wanted beside a pole there
_SHIFTS = np.array([0.0, *(sign * 0.01 * k for k in range(1, 11) for sign in (1, -1))])


@dataclass(frozen=True)
class Gate:
    """Centre (3,) m; unit normal in flight direction (3,), world frame; whether it is known."""

    centre: np.ndarray
    normal: np.ndarray
    seen: bool


@dataclass(frozen=True)
class Limits:
    """What the drone and the rules allow. SI units."""

    acceleration: float = 5.0
    speed: float = 2.2
    slow: float = 1.0  # on legs that are to be flown slowly
    unseen_speed: float = 1.35  # where a gate comes into sight that was not seen before
    gate_speed: float = 1.35
    clearance: float = 0.18  # from the drone's centre to any surface
    low: tuple[float, float, float] = (-2.4, -1.4, 0.0)
    high: tuple[float, float, float] = (2.4, 1.4, 1.9)


def _aside(centre: np.ndarray, axes: np.ndarray, poles: np.ndarray) -> float:
    """How far (m) beside its centre, along its second axis, to fly through a gate in which a pole
    (tops (n, 3)) stands, or right before or behind it."""
    if not len(poles):
        return 0.0
    along, across = ((poles - centre)[:, :2] @ axes[:2, :2]).T
    depth = np.maximum(np.abs(along) - THROUGH, 0.0)
    gap = np.hypot(depth[:, None], across[:, None] - _SHIFTS).min(axis=0) - 0.015
    return float(_SHIFTS[np.argmax(np.minimum(np.minimum(gap, ROOM), 0.2 - np.abs(_SHIFTS)))])


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
        centre += _aside(centre, axes, np.asarray(obs["obstacles_pos"], float)) * axes[:, 1]
        left.append(Gate(centre, sign * axes[:, 0], bool(obs["gates_visited"][number])))
    return left


def bars(gates_pos, gates_quat, obstacles_pos, seen, poles_seen):
    """Frames and stands of all gates, and the poles, as capsules: ends (n, 3) twice, radius (n,).

    What has not been seen is thought to be larger.
    """
    ends = [(np.array([0.0, 0.0, -9.0]), np.array([0.0, 0.0, -8.0]), 0.0)]  # never none
    for middle, quat, known in zip(np.asarray(gates_pos, float), gates_quat, seen, strict=True):
        axes = Rotation.from_quat(quat).as_matrix()
        side, up = 0.28 * axes[:, 1], 0.28 * axes[:, 2]
        for depth in (0.0,) if known else (-DEEP, DEEP):
            centre = middle + depth * axes[:, 0]
            ends += [
                (centre + side - up, centre + side + up, 0.08),
                (centre - side - up, centre - side + up, 0.08),
                (centre - side - up, centre + side - up, 0.08),
                (centre - side + up, centre + side + up, 0.08),
            ]
        wide = 0.06 if known else 0.06 + UNSEEN
        ends.append((middle - 1.36 * axes[:, 2], middle - (wide + 0.3) * axes[:, 2], wide))
    for top, known in zip(np.asarray(obstacles_pos, float), poles_seen, strict=True):
        ends.append((top * [1, 1, 0], top, 0.015 if known else 0.015 + UNSEEN))
    start, end, radius = zip(*ends, strict=True)
    return np.array(start), np.array(end), np.array(radius)


class Walls:
    """Distances to the capsules of :func:`bars`."""

    def __init__(self, start: np.ndarray, end: np.ndarray, radius: np.ndarray) -> None:
        self.start, self.axis, self.radius = start, end - start, radius
        self.length2 = (self.axis**2).sum(-1)
        self.start2 = (start**2).sum(-1)
        self.start_axis = (start * self.axis).sum(-1)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distances (k, n) of points (k, 3) to all surfaces, negative inside, m."""
        offset = points[:, None] - self.start
        along = np.clip((offset * self.axis).sum(-1) / self.length2, 0.0, 1.0)
        return np.linalg.norm(offset - along[..., None] * self.axis, axis=-1) - self.radius

    def push(self, points: np.ndarray, clearance: float) -> tuple[np.ndarray, np.ndarray]:
        """Sum of the squared intrusions (k,) of points (k, 3) and its gradient (k, 3)."""
        offset_axis = points @ self.axis.T - self.start_axis
        along = np.minimum(np.maximum(offset_axis / self.length2, 0.0), 1.0)
        offset2 = (points**2).sum(-1)[:, None] - 2.0 * points @ self.start.T + self.start2
        squared = offset2 + along * (along * self.length2 - 2.0 * offset_axis)
        point, bar = np.nonzero(squared < (self.radius + clearance) ** 2)
        cost, gradient = np.zeros(len(points)), np.zeros_like(points)
        if len(point):
            nearest = self.start[bar] + along[point, bar, None] * self.axis[bar]
            away = points[point] - nearest
            distance = np.sqrt((away**2).sum(-1) + 1e-12)
            gap = self.radius[bar] + clearance - distance
            np.add.at(cost, point, gap**2)
            np.add.at(gradient, point, (-2.0 * gap / distance)[:, None] * away)
        return cost, gradient


def _basis(tau: np.ndarray, order: int) -> np.ndarray:
    """Derivative of the monomials 1, t, ... t^5 at ``tau``: (len(tau), 6)."""
    powers = np.zeros((len(tau), 6))
    for k in range(order, 6):
        factor = np.prod(np.arange(k - order + 1, k + 1)) if order else 1.0
        powers[:, k] = factor * tau ** (k - order)
    return powers


_ENDS = np.array([0.0, 1.0])
# From position, velocity and acceleration at both ends, in normalised time, to coefficients.
_QUINTIC = np.linalg.inv(
    np.array([_basis(_ENDS, order)[end] for end in range(2) for order in range(3)])
)
_TAU = (np.arange(SAMPLES) + 0.5) / SAMPLES
_SAMPLED = np.concatenate([_basis(_TAU, order) for order in range(4)]) @ _QUINTIC  # (4 SAMPLES, 6)
_SAMPLED_T = np.ascontiguousarray(_SAMPLED.T)
_ORDERS = np.array([0, 1, 2, 0, 1, 2])


def _ends(knots: np.ndarray, duration: np.ndarray) -> np.ndarray:
    """Both ends (pieces, 6, 3) of the pieces between knots (n, 3, 3), in normalised time."""
    both = np.concatenate([knots[:-1], knots[1:]], axis=1)
    return both * (duration[:, None] ** _ORDERS)[..., None]


@dataclass(frozen=True)
class Route:
    """Knots (n, 3, 3): position, velocity, acceleration in rows, SI; durations (n - 1,) s, and
    the time of the first knot."""

    knots: np.ndarray
    duration: np.ndarray
    begin: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "_coefficients", _QUINTIC @ _ends(self.knots, self.duration))
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

    def left_at(self, t: float, gates: int) -> tuple[np.ndarray, np.ndarray]:
        """Guess (knots and durations) for a route from ``t`` on through the last ``gates``."""
        first = len(self.duration) - 2 * (gates + 1)
        duration, knots = self.duration[first:].copy(), self.knots[first:].copy()
        knots[0] = self.at(t)
        middle, target = self._times[first + 1], self._times[first + 2]
        if t > self._times[first]:
            if middle - t < 0.3 * (target - t):
                middle = 0.5 * (t + target)
                knots[1] = self.at(middle)
            duration[:2] = middle - t, target - middle
        return knots, duration


def first_guess(
    start: np.ndarray, gates: list[Gate], swing: float, lift: float
) -> tuple[np.ndarray, np.ndarray]:
    """Straight legs from a start (3, 3), their middles moved sideways and up by some metres, away
    from the side on which a gate would have to be passed twice."""
    stations = [start[0]]
    stations += [gate.centre for gate in gates]
    stations.append(gates[-1].centre + BEYOND * gates[-1].normal)
    count = 2 * len(stations) - 1
    knots = np.zeros((count, 3, 3))
    position, velocity = knots[:, 0], knots[:, 1]
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
    middle = np.arange(1, count, 2)
    velocity[middle] = position[2::2] - position[:-1:2]
    velocity[middle] /= np.maximum(np.linalg.norm(velocity[middle], axis=1, keepdims=True), 0.5)
    knots[0] = start
    return knots, np.maximum(chord / 1.3, 0.25)


def swung(
    guess: tuple[np.ndarray, np.ndarray], leg: int, way: int
) -> tuple[np.ndarray, np.ndarray]:
    """A guess whose ``leg`` passes elsewhere: to the right, the left, above, below."""
    knots, duration = (rows.copy() for rows in guess)
    along = knots[2 * leg + 2, 0] - knots[2 * leg, 0]
    aside = np.cross(along, [0.0, 0.0, 1.0])
    aside *= SWING / max(1e-3, float(np.linalg.norm(aside)))
    up = np.array([0.0, 0.0, SWING])
    knots[2 * leg + 1, 0] += (aside, -aside, up, -up)[way % 4]
    return knots, duration


class Plan:
    """A route in the making, from ``begin`` (s) and the first knot of ``guess`` through ``gates``.

    walls: see :class:`Walls`. curvature: that of an earlier plan through the same last gates.
    slow: on which legs it is to fly slowly (legs,).
    """

    def __init__(
        self,
        gates: list[Gate],
        walls: Walls,
        limits: Limits,
        begin: float,
        guess: tuple[np.ndarray, np.ndarray],
        curvature: np.ndarray | None = None,
        slow: np.ndarray | None = None,
    ) -> None:
        knots, duration = (rows.copy() for rows in guess)
        self._legs = legs = len(gates) + 1
        self._walls, self._limits, self.begin = walls, limits, begin
        # The place beyond the last gate is like a gate.
        self._normals = np.array([g.normal for g in gates] + [gates[-1].normal])
        places = [g.centre for g in gates] + [gates[-1].centre + BEYOND * gates[-1].normal]
        # The middle of a leg goes half the way with each of its ends.
        moved = places - knots[2::2, 0]
        knots[1::2, 0] += 0.5 * moved
        knots[3::2, 0] += 0.5 * moved[:-1]
        knots[2::2, 0] = places
        self._knots = knots
        low, high = np.array(limits.low), np.array(limits.high)
        self._low = np.minimum(low, knots[0, 0] - 0.005)
        self._high = np.maximum(high, knots[0, 0] + 0.005)
        # In the first moments only where it is decides, and close to the floor nothing else can be.
        self._low[2] = min(knots[0, 0, 2] - 0.005, 0.25)
        self._bounds = np.empty((2 * legs, 3, SAMPLES))
        self._bounds[:] = np.array([limits.speed, limits.acceleration, 0.0])[:, None]
        self._top = np.full(2 * legs, limits.speed)
        self.slow = slow
        self._weights = np.repeat(_WEIGHTS[None], 2 * legs, axis=0)
        if slow is not None:
            slow = np.repeat(slow, 2)
            self._top[slow], self._weights[slow, 0] = limits.slow, STRICT
        self._bounds[:, 0] = self._top[:, None]
        # The gate at the end of each piece, if it may turn out to be elsewhere.
        self._unseen = np.array([i for i, gate in enumerate(gates) if not gate.seen], int)
        self._unseen = np.repeat(2 * self._unseen, 2) + np.tile([0, 1], len(self._unseen))
        self._suspects = np.repeat(knots[2::2, 0, :2], 2, axis=0)[self._unseen, None]
        speed = (knots[2::2, 1] * self._normals).sum(-1)
        share = np.clip((speed - SLOW) / (limits.gate_speed - SLOW), 0.02, 0.98)
        rows = np.empty((legs, PER_LEG))
        rows[:, :2] = np.log(duration).reshape(legs, 2)
        rows[:, 2] = np.log(share / (1.0 - share))
        rows[:, 3:6] = knots[2::2, 2]
        rows[:, 6:] = knots[1::2].reshape(legs, 9)
        self._x = rows.ravel()
        self._f, self._g = self._cost(self._x)
        self.at_first = self._f
        size = len(self._x)
        if curvature is not None and len(curvature) >= size:
            self.curvature, self._fresh = curvature[-size:, -size:].copy(), False
        else:
            self.curvature, self._fresh = np.eye(size), True

    @property
    def cost(self) -> float:
        """Flight time, s, plus what breaks a limit."""
        return self._f

    @property
    def excess(self) -> np.ndarray:
        """What breaks a limit other than that of speed on each leg, s (legs,): part of its cost."""
        knots, d, _ = self._unpack(self._x)
        density, _, values, _, _ = self._density(knots, d)
        fast = np.maximum(np.linalg.norm(values[:, 1], axis=-1) - self._bounds[:, 0], 0.0)
        density = density - 1.0 - self._weights[:, 0, 0] * (fast**2).mean(axis=1)
        return (d * density).reshape(-1, 2).sum(axis=1)

    @property
    def route(self) -> Route:
        """The best so far."""
        knots, duration, _ = self._unpack(self._x)
        return Route(knots, duration, self.begin)

    def _unpack(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rows = x.reshape(self._legs, PER_LEG)
        share = 1.0 / (1.0 + np.exp(-rows[:, 2]))
        knots = self._knots.copy()
        speed = SLOW + (self._limits.gate_speed - SLOW) * share
        knots[2::2, 1] = self._normals * speed[:, None]
        knots[2::2, 2] = rows[:, 3:6]
        knots[1::2] = rows[:, 6:].reshape(-1, 3, 3)
        return knots, np.exp(rows[:, :2]).ravel(), share

    def _cost(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        knots, d, share = self._unpack(x)
        density, slopes, values, ends, scale = self._density(knots, d)
        pieces = len(d)
        by_order = (slopes * values).sum((2, 3)) / SAMPLES  # times d: share of a piece's cost
        slopes *= ((d / SAMPLES)[:, None] * scale)[:, :, None, None]
        g_ends = _SAMPLED_T @ slopes.reshape(pieces, 4 * SAMPLES, 3)
        g_d = density - by_order @ np.arange(4.0)
        powers = d[:, None] ** _ORDERS
        g_d += ((g_ends * ends).sum(-1) @ _ORDERS) / d
        g_ends *= powers[..., None]
        g_knots = np.zeros_like(knots)
        g_knots[:-1] += g_ends[:, :3]
        g_knots[1:] += g_ends[:, 3:]
        gradient = np.empty((self._legs, PER_LEG))
        # A leg whose pieces differ much in length has little to turn with.
        uneven = np.log(d[::2] / d[1::2])
        too_uneven = uneven - np.clip(uneven, -UNEVEN, UNEVEN)
        gradient[:, :2] = (g_d * d).reshape(-1, 2)
        gradient[:, :2] += 2.0 * too_uneven[:, None] * [1.0, -1.0]
        width = self._limits.gate_speed - SLOW
        gradient[:, 2] = (g_knots[2::2, 1] * self._normals).sum(-1) * width * share * (1.0 - share)
        gradient[:, 3:6] = g_knots[2::2, 2]
        gradient[:, 6:] = g_knots[1::2].reshape(-1, 9)
        return float((d * density).sum() + too_uneven @ too_uneven), gradient.ravel()

    def _density(self, knots: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, ...]:
        """Cost per second of each piece, its slopes by what was looked at, and that itself."""
        pieces = len(d)
        ends = _ends(knots, d)
        scale = (1.0 / d)[:, None] ** np.arange(4)
        values = (_SAMPLED @ ends).reshape(pieces, 4, SAMPLES, 3) * scale[:, :, None, None]
        slopes = np.empty_like(values)
        norm = np.sqrt((values[:, 1:] ** 2).sum(-1) + 1e-9)
        near = self._slow_down(values[:, 0])  # before the bounds are looked at
        over = np.maximum(norm - self._bounds, 0.0)
        cost = (self._weights * over**2).sum(1)
        slopes[:, 1:] = (2.0 * self._weights * over / norm)[..., None] * values[:, 1:]
        points = values[:, 0]
        outside = np.minimum(points - self._low, 0.0) + np.maximum(points - self._high, 0.0)
        crash, push = self._walls.push(points.reshape(-1, 3), self._limits.clearance)
        cost += 3000.0 * (outside**2).sum(-1) + 5000.0 * crash.reshape(pieces, SAMPLES)
        slopes[:, 0] = 6000.0 * outside + 5000.0 * push.reshape(points.shape)
        density = 1.0 + cost.mean(axis=1)
        too_fast = 2.0 * self._weights[self._unseen, 0] * over[self._unseen, 0]
        slopes[self._unseen, 0, :, :2] -= too_fast[..., None] * near
        return density, slopes, values, ends, scale

    def _slow_down(self, points: np.ndarray) -> np.ndarray:
        """Lower the bounds of speed before gates that nobody has seen; their gradient by place."""
        limits = self._limits
        offset = points[self._unseen, :, :2] - self._suspects
        distance = np.sqrt((offset**2).sum(-1) + 1e-9)
        slope = (limits.speed - limits.unseen_speed) / SLOWING
        bound = limits.unseen_speed + slope * (distance - SIGHT)
        top = self._top[self._unseen, None]
        least = np.minimum(limits.unseen_speed, top)
        inside = (bound > least) & (bound < top)
        self._bounds[self._unseen, 0] = np.clip(bound, least, top)
        return (inside * slope / distance)[..., None] * offset

    def improve(self, tries: int) -> None:
        """Look at ``tries`` more routes; each takes a quarter of a millisecond or so."""
        while tries > 0:
            direction = -self.curvature @ self._g
            slope = float(direction @ self._g)
            if slope >= -1e-12:
                if self._fresh:
                    return
                self.curvature, self._fresh = np.eye(len(self._x)), True
                continue
            step = 1.0
            if self._fresh:
                step = min(1.0, 0.3 / float(np.linalg.norm(direction)))
            # Durations are logarithms: no piece changes by more than a factor in one go.
            step = min(step, 1.0 / max(1e-9, float(np.abs(direction).max()) / 1.5))
            while True:
                x = self._x + step * direction
                f, g = self._cost(x)
                tries -= 1
                if f <= self._f + 1e-4 * step * slope:
                    break
                # The minimum of the parabola through both.
                step *= min(0.5, max(0.1, -0.5 * step * slope / (f - self._f - step * slope)))
                if tries <= 0 or step < 1e-6:
                    self._stuck(step)
                    return
            self._learn(x - self._x, g - self._g)
            self._x, self._f, self._g = x, f, g

    def _stuck(self, step: float) -> None:
        if step < 1e-3:
            self.curvature, self._fresh = np.eye(len(self._x)), True

    def _learn(self, s: np.ndarray, y: np.ndarray) -> None:
        """BFGS's update of the inverse Hessian."""
        sy = float(s @ y)
        if sy <= 1e-10 * float(np.sqrt((s @ s) * (y @ y))):
            return
        h = self.curvature
        if self._fresh:
            h *= sy / float(y @ y)
            self._fresh = False
        hy = h @ y
        h += np.outer(s, s * (1.0 + float(y @ hy) / sy) / sy)
        cross = np.outer(hy, s) / sy
        h -= cross
        h -= cross.T


_WEIGHTS = np.array([4.0, 2.0, 2e-4])[:, None]  # of too much speed, acceleration, and of all jerk
STRICT = 30.0  # of too much speed where it is to fly slowly: not through what is in the way
