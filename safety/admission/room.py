"""Where setpoints may be and how fast: the rules that several kinds of commands share."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import BackendError, InputError
from crazyarena.safety import steerable
from crazyarena.safety.admission.memory import Refused, VehicleMemory
from crazyarena.safety.attitude_path import AttitudeLoss
from crazyarena.safety.fence import Fence
from crazyarena.safety.limits import Limits
from crazyarena.safety.link_loss import LinkLoss, Moving, UsualSpeed, largest_share
from crazyarena.safety.observation import LAG, Point, as_point, upright_of, yaw_of
from crazyarena.safety.planner import Motion
from crazyarena.types import VehicleState

# Peaks of the firmware's rest-to-rest polynomial of 7th order over distance and duration.
_PEAK_SPEED = 35.0 / 16.0
_PEAK_ACCELERATION = 7.5132
_VELOCITY_HORIZON = 0.5  # s of a velocity setpoint that have to end inside the fence
_MEMORY = 0.5  # s after which the last setpoint no longer bounds the next
_MOST_LAG = 0.4  # m
_FACES, _YAWS = 0.2, 1.0  # rad and rad/s by which a vehicle may be turned that leans or tips
_SPINS = 0.8  # rad of a heading, from the vehicle's own, that any vehicle may be told
_WAY_STEP = 0.025  # m, between looks along a way
CONTROLLER = "stabilizer.controller"
OUT_IF_LOST = "it would carry the vehicle out of the fence if the link were lost now"


class Room:
    """Fence, limits and what is believed of the vehicles, as the checks need them.

    Methods that bound something append to ``reasons`` what they had to change.

    Parameters
    ----------
    state: latest believed state of a vehicle, or None.
    parameter: value of a firmware parameter of a vehicle; raises BackendError.
    low: whether a vehicle is so low that its motors may stop.
    """

    def __init__(
        self,
        fence: Fence,
        limits: Limits,
        state: Callable[[int], VehicleState | None],
        parameter: Callable[[int, str], float],
        low: Callable[[int], bool] = lambda vehicle: False,
    ) -> None:
        self.fence = fence
        self.limits = limits
        self.link_loss = LinkLoss(fence, limits)
        self.attitude_loss = AttitudeLoss(fence, limits)
        self._usual: dict[int, UsualSpeed] = {}
        self.state = state
        self.parameter = parameter
        self.low = low

    def where(self, vehicle: int) -> Point | None:
        state = self.state(vehicle)
        return None if state is None else as_point(state.position)

    def controller(self, vehicle: int) -> float | None:
        """Value of ``stabilizer.controller``; None if nobody knows it."""
        with suppress(BackendError):
            return self.parameter(vehicle, CONTROLLER)
        return None

    def seen(self, vehicle: int) -> Motion | None:
        """How the vehicle moves, as far as anybody knows."""
        state = self.state(vehicle)
        if state is None:
            return None
        return Motion(as_point(state.position), as_point(state.velocity))

    def near_its_plan(
        self, m: c.Command, memory: VehicleMemory, begin: Point | None, seen: Motion | None
    ) -> None:
        """Refuse what would begin on a plan that the vehicle is not following."""
        if begin is None or seen is None:
            return
        away = math.dist(begin, seen.position)
        if away > self.limits.setpoint_lead:
            raise memory.refusal(
                m,
                f"the vehicle is {away:.2f} m from where its plan has it, at most "
                f"{self.limits.setpoint_lead:g} m may be",
            )

    def clear_share(self, begin: Point, end: Point, least: float) -> float:
        """Share of the straight way from ``begin`` to ``end`` with at least ``least`` m of room.

        The ground is where a vehicle stands, so what is below counts as lying on it.
        """
        fence = self.fence
        steps = max(1, math.ceil(math.dist(begin, end) / _WAY_STEP))

        def good(share: float) -> bool:
            x, y, z = (a + share * (b - a) for a, b in zip(begin, end, strict=True))
            return fence.room(x, y, max(z, fence.floor)) >= least - 1e-6

        bad = next((k for k in range(1, steps + 1) if not good(k / steps)), None)
        if bad is None:
            return 1.0
        last = (bad - 1) / steps
        return last + largest_share(lambda part: good(last + part / steps), 6) / steps

    def motion(self, vehicle: int) -> Moving | None:
        """How the vehicle moves, for the look at link losses; None if off, or nobody knows."""
        state = self.state(vehicle) if self.link_loss.on else None
        if state is None:
            return None
        usual = self._usual.setdefault(vehicle, UsualSpeed())
        moving = self.link_loss.seen(state)
        return replace(moving, usual=usual.see(state.timestamp, moving.velocity))

    def inside(self, point: Point, vehicle: int, reasons: list[str], what: str) -> Point:
        margin = self.fence.soft_margin
        room = self.fence.room(*point)
        # The level's own start or goal may lie between soft and hard limit, so only what is
        # beyond the hard one is moved, and then to the soft one.
        if room >= 0.0:
            return point
        try:
            moved = self.fence.nearest(point, margin, self.where(vehicle))
        except InputError:
            raise Refused(
                f"cf{vehicle}: {what} {text(point)} m is outside the fence, and nothing inside "
                "is near"
            ) from None
        reasons.append(
            f"{what} {text(point)} m is {-room:.2f} m outside the fence, moved to {text(moved)}"
        )
        return moved

    def slowed(self, velocity: Point, reasons: list[str], what: str, limit: float) -> Point:
        size = math.hypot(*velocity)
        if size <= limit:
            return velocity
        reasons.append(f"{what} of {size:.2f} is above {limit:g}")
        share = limit / size
        return velocity[0] * share, velocity[1] * share, velocity[2] * share

    def near_fence(self, place: Point, velocity: Point, reasons: list[str]) -> Point:
        """Slow a velocity setpoint that leads out of the fence, or would if it were the last."""
        if self.link_loss.on:
            allowed = self.link_loss.velocity(place, velocity)
            if allowed is not None:
                reasons.append(
                    f"velocity {text(velocity)} m/s would lead out of the fence if the link were "
                    "lost now"
                )
                velocity = allowed
        if math.hypot(*velocity) < 1e-9:
            return velocity
        horizon = _VELOCITY_HORIZON

        def room_after(share: float) -> float:
            ahead = [p + share * horizon * v for p, v in zip(place, velocity, strict=True)]
            return self.fence.room(ahead[0], ahead[1], max(ahead[2], self.fence.floor))

        if room_after(1.0) >= 0.0 and room_after(0.5) >= 0.0:
            return velocity
        left = largest_share(lambda share: room_after(share) >= 0.0, 12)
        reasons.append(f"velocity {text(velocity)} m/s leads out of the fence within {horizon:g} s")
        return velocity[0] * left, velocity[1] * left, velocity[2] * left

    @staticmethod
    def _lag(where: Point, moving: Point, point: Point, velocity: Point) -> float:
        """m that a vehicle on its way to ``point`` is behind because ``velocity`` says less than
        its speed: the controller's damping takes that for a disturbance."""
        away = math.dist(where, point)
        if away < 1e-9:
            return 0.0
        ahead = [p - w for p, w in zip(point, where, strict=True)]
        closing = sum(a * v for a, v in zip(ahead, moving, strict=True))
        untold = closing - sum(a * told for a, told in zip(ahead, velocity, strict=True))
        return min(max(LAG * min(closing, untold) / away, 0.0), _MOST_LAG)

    def reachable(
        self,
        point: Point,
        memory: VehicleMemory,
        now: float,
        reasons: list[str],
        velocity: Point = (0.0, 0.0, 0.0),
    ) -> Point:
        """Bound a streamed position by the one before it, and by where the vehicle is.

        ``velocity``: m/s, that is streamed with it.
        """
        n = self.limits
        age = now - memory.setpoint_time
        if memory.setpoint is not None and age <= _MEMORY:
            limit = n.setpoint_step + n.setpoint_speed * age
            point = towards(memory.setpoint, point, limit, "last setpoint", reasons)
        state = self.state(memory.vehicle)
        if state is not None:
            where = as_point(state.position)
            lead = n.setpoint_lead + self._lag(where, as_point(state.velocity), point, velocity)
            point = towards(where, point, lead, "vehicle", reasons)
            if not self.fence.is_convex:
                point = self._in_sight(where, point, reasons)
        return point

    def upright(
        self,
        point: Point,
        memory: VehicleMemory,
        reasons: list[str],
        velocity: Point = (0.0, 0.0, 0.0),
        acceleration: Point = (0.0, 0.0, 0.0),
    ) -> Point:
        """Lower a place to which a vehicle that is busy with its attitude would climb with all it
        has: the motors have nothing left then to stop its turn, and it goes over."""
        state = self._busy(memory.vehicle)
        if state is None:
            return point
        height, climb = float(state.position[2]), float(state.velocity[2])
        told = point[2], velocity[2], acceleration[2]
        highest = steerable.highest(self.limits.vehicle, height, climb, *told)
        if highest >= point[2]:
            return point
        reasons.append(
            f"height {point[2]:.2f} m takes all thrust while the vehicle leans or tips, "
            f"{highest:.2f} m for now"
        )
        return point[0], point[1], highest

    def facing(self, yaw: float, memory: VehicleMemory, now: float, reasons: list[str]) -> float:
        """Keep a heading near the vehicle's, and a new one nearer to that of one that is busy with
        its attitude: what motors turn it with is missing elsewhere, too. One that it had before
        it may have."""
        state = self.state(memory.vehicle)
        if state is None or not math.isfinite(yaw):
            return yaw
        busy = self._busy(memory.vehicle) is not None
        last, age = memory.heading[0], now - memory.heading[1]
        step = abs(math.remainder(yaw - last, math.tau))
        seen = yaw_of(state.quaternion)
        turn = math.remainder(yaw - seen, math.tau)
        had = busy and age <= _MEMORY and step <= _YAWS * age + 1e-3
        most = _FACES if busy and not had else _SPINS
        if abs(turn) <= most:
            return yaw
        why = " while the vehicle leans or tips" if busy else ", more than at once"
        reasons.append(f"heading {yaw:.2f} rad turns by {turn:.2f}{why}")
        return seen + math.copysign(most, turn)

    def turning(self, rate: float, memory: VehicleMemory, reasons: list[str]) -> float:
        """The same for a rate of yaw, rad/s."""
        busy = self._busy(memory.vehicle) is not None
        most = _YAWS if busy else self.limits.setpoint_yaw_rate
        if abs(rate) <= most:
            return rate
        why = " while the vehicle leans or tips" if busy else f", above {most:g}"
        reasons.append(f"yaw rate of {rate:.2f} rad/s{why}")
        return math.copysign(most, rate)

    def turned_in(
        self, yaw: float | None, relative: bool, vehicle: int, duration: float, reasons: list[str]
    ) -> float:
        """The duration, or the shortest in which a plan may turn the vehicle to ``yaw``, rad."""
        state = self.state(vehicle)
        if yaw is None or state is None:
            return duration
        turn = abs(math.remainder(yaw - (0.0 if relative else yaw_of(state.quaternion)), math.tau))
        least = _PEAK_SPEED * turn / self.limits.setpoint_yaw_rate
        if duration >= least:
            return duration
        reasons.append(f"a turn by {turn:.2f} rad in {duration:g} s needs {least:.2f} s")
        return least

    def carried(self, point: Point, memory: VehicleMemory, reasons: list[str]) -> Point:
        """Raise a place, told without a velocity, to which a vehicle would fall without thrust."""
        state = self.state(memory.vehicle)
        if state is None or self.low(memory.vehicle):
            return point
        height, climb = float(state.position[2]), float(state.velocity[2])
        lowest = steerable.lowest(self.limits.vehicle, height, climb, point[2], 0.0, 0.0)
        lowest = min(lowest, height)  # one that climbs may be stopped where it is
        if lowest <= point[2]:
            return point
        reasons.append(f"height {point[2]:.2f} m asks for no lift, {lowest:.2f} m for now")
        return point[0], point[1], lowest

    def _busy(self, vehicle: int) -> VehicleState | None:
        """The vehicle's state, if it leans or tips so that it needs its motors to be upright."""
        state = self.state(vehicle)
        if state is None:
            return None
        rate = steerable.tipping(as_point(state.angular_velocity))
        return state if steerable.is_busy(upright_of(state.quaternion), rate) else None

    def _in_sight(self, where: Point, point: Point, reasons: list[str]) -> Point:
        """``point``, or the last place before fence or zone on the straight way to it."""
        x, y, z = where
        least = min(0.0, self.fence.room(x, y, max(z, self.fence.floor)))
        share = self.clear_share(where, point, least)
        if share >= 1.0:
            return point
        reasons.append(f"the way to {text(point)} m leads out of the fence")
        x, y, z = (a + share * (b - a) for a, b in zip(where, point, strict=True))
        return x, y, z

    def duration(
        self,
        distance: float,
        duration: float,
        reasons: list[str],
        most: float = math.inf,
        fastest: float = math.inf,
    ) -> float:
        """The duration, or the shortest that keeps the polynomial within the limits, its
        acceleration within ``most``, m/s2, and its speed within ``fastest``, m/s."""
        n = self.limits
        least = max(
            _PEAK_SPEED * distance / min(n.setpoint_speed, fastest),
            math.sqrt(_PEAK_ACCELERATION * distance / min(n.setpoint_acceleration, most)),
        )
        if duration >= least:
            return duration
        reasons.append(f"{distance:.2f} m in {duration:g} s is too fast, {least:.2f} s are needed")
        return least


def towards(origin: Point, point: Point, limit: float, what: str, reasons: list[str]) -> Point:
    """``point``, or the one ``limit`` m from ``origin`` on the way to it."""
    distance = math.dist(origin, point)
    if distance <= limit:
        return point
    reasons.append(f"position is {distance:.2f} m from the {what}, at most {limit:.2f} m may be")
    share = limit / distance
    x, y, z = (a + share * (b - a) for a, b in zip(origin, point, strict=True))
    return x, y, z


def text(point: Point) -> str:
    return "[" + ", ".join(f"{value:.2f}" for value in point) + "]"
