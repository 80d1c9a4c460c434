"""Where a vehicle comes down that hears nothing more after its present setpoint.

The firmware keeps the last setpoint for half a second, then levels out and coasts, and is cut by
its emergency-stop watchdog a second after it was last fed (Crazyflie firmware, ``supervisor``).
Until it levels out it is the damped spring of :mod:`~crazyarena.safety.flight_model`,

    x'' = b,    tau b' = f a + k (p - x) + c (s v - x') - b

which settles at u = p + (s c v + f a) / k. Nothing else of the setpoint matters, and where the
vehicle ends is linear in u. It coasts as if there were no air: the estimator on board knows none,
and takes the tilt that makes up for drag for level.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from crazyarena.safety.fence import Fence
from crazyarena.safety.flight_model import GRAVITY, FlightModel
from crazyarena.safety.limits import Limits
from crazyarena.safety.observation import Point

_HOLD = 0.5  # s for which the firmware keeps a setpoint
_CUT = 1.0  # s until its emergency-stop watchdog, no longer fed, stops the motors
_LEVELLING_TIME = 0.08  # s, of the last push; found in simulation, and rather short
_BISECTIONS = 10
_PLAN_SAMPLES = 16
_STRETCH, _STRETCHES = 1.15, 24  # up to 25 times as long
_ORIGIN = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class _Response:
    """Place, speed and push after some time, each a multiple of (distance to u, speed) now."""

    place_place: float
    place_speed: float
    speed_place: float
    speed_speed: float
    push_place: float
    push_speed: float

    @classmethod
    def after(cls, time: float, stiffness: float, damping: float, lag: float) -> _Response:
        """Of e'' = b, lag b' = -k e - c e' - b, from b = 0."""
        rates = np.array(
            [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-stiffness / lag, -damping / lag, -1.0 / lag]]
        )
        m = expm(rates * time)
        return cls(*(float(m[row, column]) for row in range(3) for column in range(2)))


class LinkLoss:
    """Keeps setpoints such that losing the link right after them ends inside the fence."""

    def __init__(self, fence: Fence, limits: Limits) -> None:
        self._fence = fence
        self._margin = limits.link_loss_margin
        self._delay = limits.link_delay
        model = limits.vehicle
        self._model = model
        self._halfway = _responses(model, 0.5 * _HOLD)
        self._levelling = _responses(model, _HOLD)

    @property
    def on(self) -> bool:
        """Whether the limits ask for this at all."""
        return math.isfinite(self._margin)

    def excess(self, place: Point, moving: Point, rest: Point, lift: float = 0.0) -> float:
        """How far beyond the hard fence, m, the vehicle gets; negative inside.

        Parameters
        ----------
        place, moving: m, m/s, of the vehicle when the last setpoint reaches it.
        rest: m, where that setpoint would bring it to rest (u of the module's text).
        lift: m, by which it rises over that once the firmware levels it out, which keeps height
            and vertical speed of the setpoint, but not its acceleration.
        """
        model = self._model
        rest = (rest[0], rest[1], rest[2] + max(0.0, -model.low))
        halfway = _moved(place, moving, rest, self._halfway)
        levelling = _moved(place, moving, rest, self._levelling)
        # Of the tilt that is left something goes on pushing until it is level.
        speed = [
            (r.speed_place + _LEVELLING_TIME * r.push_place) * (p - u)
            + (r.speed_speed + _LEVELLING_TIME * r.push_speed) * v
            for p, u, v, r in zip(place, rest, moving, self._levelling, strict=True)
        ]
        # Level, it keeps its height; cut, it falls.
        height = rest[2] + lift
        coasting = _CUT - _HOLD + math.sqrt(2.0 * max(height, 0.0) / GRAVITY)
        x, y, _ = levelling
        down = (x + coasting * speed[0], y + coasting * speed[1], height)
        between = (x + 0.5 * coasting * speed[0], y + 0.5 * coasting * speed[1], height)
        return -min(self._room(point) for point in (halfway, levelling, between, down))

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
        self, place: Point, moving: Point, position: Point, lift: float = 0.0
    ) -> Point | None:
        """Position setpoint that may be told instead of this one; None if it is good as is."""
        place = _along(place, moving, self._delay)
        ahead = _minus(position, place)
        share = self._share(
            lambda share: self.excess(place, moving, _along(place, ahead, share), lift)
        )
        return None if share >= 1.0 else _along(place, ahead, share)

    def full_state(
        self, place: Point, moving: Point, position: Point, velocity: Point, acceleration: Point
    ) -> tuple[Point, Point] | None:
        """Position and velocity that a full-state setpoint may have; None if it is good as it is.

        Of a setpoint only u matters, and its velocity is what can be changed without a step in
        where the vehicle is to be; its position only if the controller heeds nothing else.
        """
        model = self._model
        rest = self.rest(position, velocity, acceleration)
        lift = -model.feed[2] * acceleration[2] / model.stiffness[2]
        allowed = self.position(place, moving, rest, lift)
        if allowed is None:
            return None
        if not model.follows_velocity:
            return _along(position, _minus(allowed, rest), 1.0), velocity
        x, y, z = (
            v + (allow - u) * k / c
            for v, u, allow, k, c in zip(
                velocity, rest, allowed, model.stiffness, model.damping, strict=True
            )
        )
        return position, (x, y, z)

    def rest(self, position: Point, velocity: Point, acceleration: Point) -> Point:
        """m, where a full-state setpoint brings the vehicle to rest: u of the module's text."""
        model = self._model
        x, y, z = (
            p + (c * v * model.follows_velocity + f * a) / k
            for p, v, a, k, c, f in zip(
                position,
                velocity,
                acceleration,
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


def _moved(place: Point, moving: Point, rest: Point, responses: list[_Response]) -> Point:
    x, y, z = (
        u + r.place_place * (p - u) + r.place_speed * v
        for p, u, v, r in zip(place, rest, moving, responses, strict=True)
    )
    return x, y, z


def _responses(model: FlightModel, time: float) -> list[_Response]:
    lags = (model.tilting, model.tilting, model.thrusting)
    return [
        _Response.after(time, k, c, lag)
        for k, c, lag in zip(model.stiffness, model.damping, lags, strict=True)
    ]


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
