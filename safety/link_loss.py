"""Where a vehicle comes down that hears nothing more after its present setpoint.

The firmware keeps the last setpoint for half a second, then levels out and coasts, and is cut by
its emergency-stop watchdog a second after it was last fed (Crazyflie firmware, ``supervisor``).
Until it levels out it is the damped spring of :mod:`~crazyarena.safety.flight_model`, with a tilt
that swings to what is asked for, and with the tilt that it has now:

    v' = b,    b'' = w^2 (f a + k (p - x) + c (s v_p - v) - b) - 2 z w b'

which settles at u = p + (s c v_p + f a) / k. Nothing else of the setpoint matters but the body
rates that are told with it: the firmware keeps them when it levels out, and Mellinger's attitude
loop holds a tilt against them, ``lean`` times what they are. Where it ends is linear in all
of it. The estimator on board knows no air: it takes the tilt that makes up for the drag of the last
second's speed for level, goes on doing so without poses, and so the push of that tilt stays.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm

from crazyarena.safety.fence import Fence
from crazyarena.safety.flight_model import GRAVITY, FlightModel
from crazyarena.safety.limits import Limits
from crazyarena.safety.observation import Point, as_point, upright_of, yaw_of
from crazyarena.types import VehicleState

Pair = tuple[float, float]

_HOLD = 0.5  # s for which the firmware keeps a setpoint
_CUT = 1.0  # s until its emergency-stop watchdog, no longer fed, stops the motors
_BISECTIONS = 10
_PLAN_SAMPLES = 16
_STRETCH, _STRETCHES = 1.15, 24  # up to 25 times as long
_ORIGIN = (0.0, 0.0, 0.0)
_LOOKS = (0.1, 0.4)  # s after it levels out, and after that, at which its place is looked at
_LEFT = 1.5  # times that tilt is what a vehicle flies with that has no poses, found in simulation
_BELIEVED = 0.1  # s; times drag, by how much the speed is overestimated on board, in simulation
_MEMORY = 1.0  # s, of the estimator on board, about the tilt that makes up for drag
_MOST_SWING = 30.0  # m/s3; more than that is noise of the cameras


@dataclass(frozen=True, slots=True)
class Moving:
    """How a vehicle moves: place m, velocity m/s; sideways also push (m/s2) and swing (m/s3), what
    its tilt, beyond what makes up for drag, and the change of that make of gravity; heading rad.
    usual: m/s, sideways, of the last second; that of now if nobody knows."""

    place: Point
    velocity: Point
    push: Pair = (0.0, 0.0)
    swing: Pair = (0.0, 0.0)
    heading: float = 0.0
    usual: Pair | None = None

    @classmethod
    def of(cls, state: VehicleState, most: float, drag: float) -> Moving:
        """As a state tells it; ``most`` m/s2 is what a vehicle can be pushed with; ``drag`` 1/s."""
        x, y, z, w = (float(value) for value in state.quaternion)
        up = max(upright_of(state.quaternion), 0.3)
        heading = yaw_of(state.quaternion)
        velocity = as_point(state.velocity)
        push = (
            2.0 * GRAVITY * (x * z + w * y) / up - drag * velocity[0],
            2.0 * GRAVITY * (y * z - w * x) / up - drag * velocity[1],
        )
        rates = float(state.angular_velocity[0]), float(state.angular_velocity[1])
        swing = turned(GRAVITY * rates[1], -GRAVITY * rates[0], heading)
        return cls(
            as_point(state.position),
            velocity,
            _at_most(push, most),
            _at_most(swing, _MOST_SWING),
            heading,
        )

    def after(self, time: float) -> Moving:
        """A moment later."""
        (x, y, z), (vx, vy, vz), (ax, ay) = self.place, self.velocity, self.push
        place = x + time * (vx + 0.5 * time * ax), y + time * (vy + 0.5 * time * ay), z + time * vz
        return replace(self, place=place, velocity=(vx + time * ax, vy + time * ay, vz))


@dataclass(frozen=True, slots=True)
class _Sideways:
    """Places after 0.25, 0.5, 0.6 and 1.0 s, and the speed then: rows of multiples of the distance
    to u, speed, push and swing now, of the push that is left after levelling out, and of the usual
    speed."""

    rows: tuple[tuple[float, float, float, float, float, float], ...]

    @classmethod
    def of(cls, model: FlightModel) -> _Sideways:
        """States: place and speed as believed on board, push believed, swing, push left, true place
        and speed, and the push that is taken for level."""
        k, c = model.stiffness[0], model.damping[0]
        w, z = model.swinging
        held = np.zeros((8, 8))
        held[0, 1] = held[1, 2] = held[2, 3] = held[5, 6] = held[6, 2] = held[6, 7] = 1.0
        held[6, 6] = -model.drag
        level = held.copy()
        held[3, :4] = -k * w * w, -c * w * w, -w * w, -2.0 * z * w
        level[3, 2:5] = -w * w, -2.0 * z * w, _LEFT * w * w
        begin = np.zeros((8, 6))
        begin[:5, :5] = np.eye(5)
        begin[1, 1] += _BELIEVED * model.drag
        begin[5, 0] = begin[6, 1] = 1.0
        begin[7, 5] = model.drag
        # Believed is what the tilt is beyond that.
        begin[2, 1], begin[2, 5] = model.drag, -model.drag
        half = expm(0.5 * _HOLD * held)
        states = [half @ begin]
        states.append(half @ states[-1])
        for gap in _LOOKS:
            states.append(expm(gap * level) @ states[-1])
        rows = [state[5] for state in states] + [states[-1][6]]
        return cls(tuple(tuple(float(value) for value in row) for row in rows))  # type: ignore[misc]

    def ways(
        self, away: float, speed: float, push: float, swing: float, left: float, usual: float
    ) -> list[float]:
        """The rows' sums, m from u, and m/s at last."""
        return [
            a * away + b * speed + c * push + d * swing + e * left + f * usual
            for a, b, c, d, e, f in self.rows
        ]


def _upwards(model: FlightModel, time: float) -> tuple[float, float]:
    """Height after some time, a multiple of (distance to u, speed) now: e'' = b and
    lag b' = -k e - c e' - b, from b = 0."""
    k, c, lag = model.stiffness[2], model.damping[2], model.thrusting
    m = expm(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-k / lag, -c / lag, -1.0 / lag]]) * time)
    return float(m[0, 0]), float(m[0, 1])


class UsualSpeed:
    """Speed of about the last second, sideways, as the estimator on board remembers it."""

    def __init__(self) -> None:
        self._speed: Pair | None = None
        self._time = -math.inf

    def see(self, time: float, velocity: Point) -> Pair:
        """Its value, m/s, at ``time`` (s), with the velocity of now."""
        gap, self._time = time - self._time, max(time, self._time)
        if self._speed is None or gap > _MEMORY:
            self._speed = velocity[0], velocity[1]
        elif gap > 0.0:
            share = -math.expm1(-gap / _MEMORY)
            x, y = (u + share * (v - u) for u, v in zip(self._speed, velocity, strict=False))
            self._speed = x, y
        return self._speed


class LinkLoss:
    """Keeps setpoints such that losing the link right after them ends inside the fence."""

    def __init__(self, fence: Fence, limits: Limits) -> None:
        self._fence = fence
        self._margin = limits.link_loss_margin
        self._delay = limits.link_delay
        model = limits.vehicle
        self._model = model
        self._sideways = _Sideways.of(model)
        self._heights = _upwards(model, 0.5 * _HOLD), _upwards(model, _HOLD)

    @property
    def on(self) -> bool:
        """Whether the limits ask for this at all."""
        return math.isfinite(self._margin)

    def seen(self, state: VehicleState) -> Moving:
        """How a vehicle moves, by what is believed of it."""
        return Moving.of(state, self._model.strongest, self._model.drag)

    def excess(
        self, moving: Moving, rest: Point, left: Pair = (0.0, 0.0), lift: float = 0.0
    ) -> float:
        """How far beyond the hard fence, m, the vehicle gets; negative inside.

        Parameters
        ----------
        moving: the vehicle when the last setpoint reaches it.
        rest: m, where that setpoint would bring it to rest (u of the module's text).
        left: m/s2, push that the body rates of that setpoint leave it with.
        lift: m, by which it rises over that once the firmware levels it out, which keeps height
            and vertical speed of the setpoint, but not its acceleration.
        """
        model = self._model
        ux, uy, uz = rest
        uz += model.floats
        (x, y, z), (vx, vy, vz) = moving.place, moving.velocity
        (ax, ay), (jx, jy) = moving.push, moving.swing
        usual = moving.usual or (vx, vy)
        ways_x = self._sideways.ways(x - ux, vx, ax, jx, left[0], usual[0])
        ways_y = self._sideways.ways(y - uy, vy, ay, jy, left[1], usual[1])
        # Level, it keeps its height; cut, it falls.
        height = uz + lift
        heights = [uz + a * (z - uz) + b * vz for a, b in self._heights] + [height, height]
        room = min(
            self._room((ux + a, uy + b, h))
            for a, b, h in zip(ways_x[:4], ways_y[:4], heights, strict=True)
        )
        fall = math.sqrt(2.0 * max(height, 0.0) / GRAVITY)
        down = ux + ways_x[3] + fall * ways_x[4], uy + ways_y[3] + fall * ways_y[4], height
        return -min(room, self._room(down))

    def velocity_excess(self, place: Point, velocity: Point) -> float:
        """The same for a vehicle told to keep a velocity, m/s."""
        x, y, z = place
        vx, vy, vz = velocity
        height = max(z + _CUT * vz, 0.0)
        fall = math.sqrt(2.0 * height / GRAVITY)
        time = _CUT + fall
        return -min(
            self._room((x + 0.5 * time * vx, y + 0.5 * time * vy, height)),
            self._room((x + time * vx, y + time * vy, height)),
        )

    def ballistic_excess(self, place: Point, moving: Point) -> float:
        """The same for a vehicle that follows a plan of its own, cut at this point of it."""
        (x, y, z), (vx, vy, vz) = place, moving
        top = max(z, 0.0) + max(vz, 0.0) ** 2 / (2.0 * GRAVITY)
        fall = (vz + math.sqrt(vz * vz + 2.0 * GRAVITY * max(z, 0.0))) / GRAVITY
        return -self._room((x + fall * vx, y + fall * vy, top))

    def duration(self, place: Point, moving: Point, goal: Point, duration: float) -> float:
        """Duration for a go-to plan on which the vehicle may be cut anywhere, at least as long.

        The one that gets least far out of those tried, if none is good: a vehicle that is fast
        already overshoots whatever it is told.
        """
        best, least = duration, math.inf
        for _ in range(_STRETCHES):
            worst = max(
                self.ballistic_excess(*_on_plan(place, moving, goal, duration, k / _PLAN_SAMPLES))
                for k in range(1, _PLAN_SAMPLES)
            )
            if worst <= self._margin:
                return duration
            if worst < least:
                best, least = duration, worst
            duration *= _STRETCH
        return best

    def position(
        self, moving: Moving, position: Point, left: Pair = (0.0, 0.0), lift: float = 0.0
    ) -> Point | None:
        """Position setpoint that may be told instead of this one; None if it is good as is."""
        later = moving.after(self._delay)
        ahead = _minus(position, later.place)
        share = self._share(
            lambda share: self.excess(later, _along(later.place, ahead, share), left, lift)
        )
        return None if share >= 1.0 else _along(later.place, ahead, share)

    def full_state(
        self,
        moving: Moving,
        position: Point,
        velocity: Point,
        acceleration: Point,
        omega: Point = _ORIGIN,
    ) -> tuple[Point, Point, Point] | None:
        """Position, velocity and body rates that a full-state setpoint may have; None if it is
        good as it is.

        Body rates go first: what they are good for is the time of a step. Of the rest only u
        matters, and a setpoint's velocity is what can be changed without a step in where the
        vehicle is to be; its position only if the controller heeds nothing else.
        """
        model = self._model
        lift = -model.feed[2] * acceleration[2] / model.stiffness[2]
        kept = self._rates(moving, position, velocity, acceleration, omega, lift)
        left = self.left(kept, moving.heading)
        rest = self.rest(position, velocity, acceleration, left)
        allowed = self.position(moving, rest, left, lift)
        if allowed is None:
            return None if kept is omega else (position, velocity, kept)
        if not model.follows_velocity:
            return _along(position, _minus(allowed, rest), 1.0), velocity, kept
        x, y, z = (
            v + (allow - u) * k / c
            for v, u, allow, k, c in zip(
                velocity, rest, allowed, model.stiffness, model.damping, strict=True
            )
        )
        return position, (x, y, z), kept

    def _rates(
        self,
        moving: Moving,
        position: Point,
        velocity: Point,
        acceleration: Point,
        omega: Point,
        lift: float,
    ) -> Point:
        """The largest share of body rates that ends inside; all or nothing if none does."""
        later = moving.after(self._delay)

        def excess(share: float) -> float:
            left = self.left(_along(_ORIGIN, omega, share), moving.heading)
            return self.excess(later, self.rest(position, velocity, acceleration, left), left, lift)

        if not (self._model.lean and (omega[0] or omega[1])):
            return omega
        asked = excess(1.0)
        if asked <= self._margin:  # as of nearly every setpoint
            return omega
        none = excess(0.0)
        if asked <= none:
            return omega
        x, y, z = omega
        share = 0.0
        if none <= self._margin:
            share = largest_share(lambda share: excess(share) <= self._margin, _BISECTIONS)
        return share * x, share * y, z

    def left(self, omega: Point, heading: float) -> Pair:
        """m/s2, push of the tilt that is held against body rates (rad/s) of a setpoint."""
        size = self._model.lean * GRAVITY
        return _at_most(turned(size * omega[1], -size * omega[0], heading), self._model.strongest)

    def rest(
        self, position: Point, velocity: Point, acceleration: Point, left: Pair = (0.0, 0.0)
    ) -> Point:
        """m, where a full-state setpoint brings the vehicle to rest: u of the module's text."""
        model = self._model
        x, y, z = (
            p + (c * v * model.follows_velocity + f * a + b) / k
            for p, v, a, b, k, c, f in zip(
                position,
                velocity,
                acceleration,
                (*left, 0.0),
                model.stiffness,
                model.damping,
                model.feed,
                strict=True,
            )
        )
        return x, y, z

    def velocity(self, place: Point, velocity: Point) -> Point | None:
        """Velocity setpoint that may be told instead of this one; None if it is good as is."""
        share = self._share(
            lambda share: self.velocity_excess(place, _along(_ORIGIN, velocity, share))
        )
        return None if share >= 1.0 else _along(_ORIGIN, velocity, share)

    def _share(self, excess: Callable[[float], float]) -> float:
        asked = excess(1.0)
        # One who is too far out already is not kept from coming back.
        if asked <= self._margin or asked <= excess(0.0):
            return 1.0
        return largest_share(lambda share: excess(share) <= self._margin, _BISECTIONS)

    def _room(self, point: Point) -> float:
        x, y, z = point
        z = max(z, self._fence.floor)
        room = self._fence.clearance(x, y, z)
        for zone in self._fence.people_zones:
            room = min(room, zone.distance(x, y, z))
        return room


def largest_share(good: Callable[[float], bool], steps: int) -> float:
    """The largest share of 1 that is still good, to ``steps`` bits; 0 always is."""
    low, high = 0.0, 1.0
    for _ in range(steps):
        middle = 0.5 * (low + high)
        if good(middle):
            low = middle
        else:
            high = middle
    return low


def turned(x: float, y: float, heading: float) -> Pair:
    """A vector of the body's level axes in the world's."""
    sin, cos = math.sin(heading), math.cos(heading)
    return cos * x - sin * y, sin * x + cos * y


def _at_most(pair: Pair, limit: float) -> Pair:
    size = math.hypot(*pair)
    if not size > limit:
        return pair
    return pair[0] * limit / size, pair[1] * limit / size


def _along(point: Point, direction: Point, share: float) -> Point:
    (x, y, z), (dx, dy, dz) = point, direction
    return x + share * dx, y + share * dy, z + share * dz


def _on_plan(
    start: Point, moving: Point, goal: Point, duration: float, x: float
) -> tuple[Point, Point]:
    """Place and velocity at share ``x`` of the firmware's polynomial of 7th order to a rest."""
    x3 = x * x * x
    # Basis functions of the way and of the initial velocity; acceleration and jerk begin at 0.
    way = x3 * x * (35.0 - x * (84.0 - x * (70.0 - 20.0 * x)))
    way_rate = 140.0 * x3 * (1.0 - x) ** 3
    carry = x - x3 * x * (20.0 - x * (45.0 - x * (36.0 - 10.0 * x)))
    carry_rate = 1.0 - x3 * (80.0 - x * (225.0 - x * (216.0 - 70.0 * x)))
    ahead = _minus(goal, start)
    place = _along(_along(start, ahead, way), moving, duration * carry)
    velocity = _along(_along(_ORIGIN, ahead, way_rate / duration), moving, carry_rate)
    return place, velocity


def _minus(a: Point, b: Point) -> Point:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]
