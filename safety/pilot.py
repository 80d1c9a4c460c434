"""What the watchdog flies once it has taken over: brake, hold, come back inside, land.

Pure: commands follow from the time, the action and the observations. Setpoints are streamed and
each stands for itself, so that a lost one costs nothing. The descent goes on to below the
ground, so that a wrong height does not keep the motors running.
"""

from __future__ import annotations

import math
from dataclasses import replace

from crazyarena.crazyswarm_compat.commands import Command, CutMotors, Emergency, FullState
from crazyarena.errors import InputError
from crazyarena.safety import steerable
from crazyarena.safety.events import Action
from crazyarena.safety.fence import Fence
from crazyarena.safety.flight_model import GRAVITY
from crazyarena.safety.lasting import Lasting
from crazyarena.safety.limits import Limits
from crazyarena.safety.link_loss import LinkLoss, Moving, UsualSpeed
from crazyarena.safety.neighbours import beside
from crazyarena.safety.observation import Observation, Point, as_point

_PERIOD = 0.0095  # s, at least, between setpoints: every frame of a 100 Hz camera system
_EMERGENCY_REPEATS = 15
_BELOW_GROUND = 0.3  # m, where the descent ends
_TOUCHDOWN = 0.06  # m above where it stood: counts as down
_STILL = 0.25  # m/s
_REST_TIME = 0.3  # s of touching down until the motors are stopped
_UPWARDS = 2.5  # m/s2, with which a climb is braked
# m/s2, without poses: a sharp tilt excites slow rotors, and nothing steadies what comes of it.
_BLIND_BRAKING = 3.0
_AGILITY = 25.0  # m/s2, more than a vehicle has
_BRIDGE = 0.2  # s without a position, after which any velocity is believed again
_FAR = 1.2  # m, more than the gate lets a setpoint lead
_MOST_WOUND = 2.0  # m s, as the firmware bounds it
# s: damping over stiffness of Mellinger's attitude loop about the vertical, by which a heading may
# be ahead of one that spins for its motors to do nothing at first; rad.
_SPIN, _MOST_SPUN = 0.2, 2.0
_STOP_TIME = 0.5  # s for which the stop is repeated


class SafePilot:
    """Flies one vehicle of which the watchdog has taken control.

    Parameters
    ----------
    ground: m, height of the vehicle's centre when it stands.
    """

    def __init__(self, fence: Fence, limits: Limits, ground: float = 0.03) -> None:
        self._fence = fence
        self._limits = limits
        self._link_loss = LinkLoss(fence, limits)
        self.ground = ground
        self._begun = -math.inf
        self._brake: tuple[Point, Point, Point] | None = None  # from, at, and for so long by axis
        self._place: Point = (0.0, 0.0, 0.0)
        self._target: Point = (0.0, 0.0, 0.0)
        self._yaw = 0.0
        self._descending = False
        self._moved = -math.inf
        self._sent = -math.inf
        self._touched = Lasting()
        self._stopping: float | None = None
        self._emergencies = 0
        self._velocity: Point = (0.0, 0.0, 0.0)
        self._seen = -math.inf
        self._usual = UsualSpeed()
        self._wound = (0.0, 0.0)  # m s, of the integral of the controller on board
        self.reference: Point | None = None
        self.landed = False

    def see(self, obs: Observation) -> None:
        """Follow the vehicle's velocity no faster than it can change; for every observation.

        Cameras that hang and catch up make an estimate explode for some frames, and what is
        flown from such a velocity runs away.
        """
        if obs.position is None or obs.time <= self._seen:
            return
        self._wind(obs)
        change = math.dist(obs.velocity, self._velocity)
        if not math.isfinite(change):
            return
        gap, self._seen = obs.time - self._seen, obs.time
        share = 1.0 if gap > _BRIDGE or change <= _AGILITY * gap else _AGILITY * gap / change
        x, y, z = (a + share * (b - a) for a, b in zip(self._velocity, obs.velocity, strict=True))
        self._velocity = (x, y, z)
        self._usual.see(obs.time, self._velocity)

    def _wind(self, obs: Observation) -> None:
        """Follow the integral of the position error that the controller on board keeps."""
        told, place = self.reference or obs.streamed, obs.flown_from(self._limits.disagreement)
        if not obs.airborne:
            self._wound = (0.0, 0.0)
        if told is None or place is None or not obs.airborne:
            return
        if math.dist(told, place) > _FAR:  # nobody was told that: somebody errs
            return
        gap = obs.time - self._seen
        if gap > _BRIDGE:  # the first look, or one after a long pause
            return
        x, y = (
            min(max(i + gap * (t - p), -_MOST_WOUND), _MOST_WOUND)
            for i, t, p in zip(self._wound, told, place, strict=False)
        )
        self._wound = x, y

    def _unwound(self, setpoint: FullState) -> FullState:
        """With an acceleration against that integral: of a contestant who asked for places far
        ahead it is a push outwards that lasts for seconds."""
        size = self._limits.vehicle.winding
        ax, ay, az = as_point(setpoint.acceleration)
        return replace(
            setpoint, acceleration=(ax - size * self._wound[0], ay - size * self._wound[1], az)
        )

    def update(self, action: Action, obs: Observation) -> list[Command]:
        """Commands for now; ``reference`` is where the vehicle should be, ``landed`` is set when
        it is down and its motors are stopped."""
        self.see(obs)
        if action is Action.CUT:
            self.reference = None
            if self._emergencies < _EMERGENCY_REPEATS:
                self._emergencies += 1
                return [Emergency()]
            return []
        if not action.takes_over or self.landed:
            return []
        if self._begun == -math.inf:
            self._begin(obs)
        if obs.time - self._sent < _PERIOD:
            return []
        self._sent = obs.time
        if self._stopping is not None or self._is_down(action, obs):
            if self._stopping is None:
                self._stopping = obs.time
            self.reference = None
            self.landed = obs.time - self._stopping >= _STOP_TIME
            return [CutMotors()]
        told = self._mindful(self._fly(action, obs), obs)
        return [self._unwound(self._steerable(told, obs))]

    def _mindful(self, setpoint: FullState, obs: Observation) -> FullState:
        """The setpoint as it may be the last one to arrive."""
        place = obs.flown_from(self._limits.disagreement)
        if place is None or not self._link_loss.on:
            return setpoint
        push = obs.horizontal_acceleration(self._limits.vehicle.strongest)
        slower = self._link_loss.full_state(
            Moving(place, self._velocity, push, usual=self._usual.see(obs.time, self._velocity)),
            as_point(setpoint.position),
            as_point(setpoint.velocity),
            as_point(setpoint.acceleration),
        )
        if slower is None:
            return setpoint
        return replace(setpoint, position=slower[0], velocity=slower[1])

    def _steerable(self, setpoint: FullState, obs: Observation) -> FullState:
        """At a height that leaves the motors what keeps the vehicle upright: a hold that asks for
        all of their thrust, or for none, has it go over."""
        place = obs.flown_from(self._limits.disagreement)
        if place is None:
            return setpoint
        model = self._limits.vehicle
        x, y, z = as_point(setpoint.position)
        told = as_point(setpoint.velocity)[2], as_point(setpoint.acceleration)[2]
        z -= model.floats
        busy = steerable.is_busy(obs.upright, steerable.tipping(obs.rates))
        least = steerable.LEAST_LIFT if busy else steerable.CALM_LIFT
        if not self._descending:  # one that stands on something is told to be far below
            z = steerable.lowest(model, place[2], self._velocity[2], z, *told, least)
        if busy:
            z = steerable.highest(model, place[2], self._velocity[2], z, *told)
        ax, ay, az = as_point(setpoint.acceleration)
        if az >= 0.0 or not model.follows_velocity:
            return replace(setpoint, position=(x, y, z))
        # Braking is asked for by the place: firmware that hears no more levels the vehicle out
        # without the acceleration of its last setpoint, which would let it up again.
        z += model.feed[2] * az / model.stiffness[2]
        return replace(setpoint, position=(x, y, z), acceleration=(ax, ay, 0.0))

    def _begin(self, obs: Observation) -> None:
        self._begun = self._moved = obs.time
        # One that spins is not stopped at once: that takes two of its four motors.
        lead = min(max(_SPIN * obs.rates[2], -_MOST_SPUN), _MOST_SPUN)
        yaw = math.remainder(obs.yaw + lead, math.tau)
        self._yaw = yaw if math.isfinite(yaw) else 0.0
        position = obs.flown_from(self._limits.disagreement)
        if position is None:
            # Nobody knows where it is: level it at the setpoint it had, and land from there.
            self._place = self._target = obs.setpoint or (0.0, 0.0, self.ground + 0.5)
            return
        velocity = self._velocity
        braking = self._limits.braking
        if obs.pose_age > self._limits.pose_hold:
            braking = min(braking, _BLIND_BRAKING)
        stop = math.hypot(*velocity) / braking
        # One that falls drifts on no longer than it has to.
        aside = min(stop, 2.0 * math.hypot(*velocity[:2]) / braking)
        # A climb is braked gently: rotors that stand still cannot steer.
        times = (aside, aside, max(stop, self._level_off(position[2], velocity[2])))
        self._brake = (position, velocity, times)
        x, y, z = (p + 0.5 * v * t for p, v, t in zip(position, velocity, times, strict=True))
        rest = (x, y, z)
        rest = (rest[0], rest[1], max(rest[2], self.ground + 0.1))
        self._place = rest
        try:
            self._target = self._fence.nearest(rest, self._limits.inside, position)
        except InputError:
            self._target = rest

    def _level_off(self, height: float, climb: float) -> float:
        """s, to end a climb in: more sharply if the ceiling is near, but rotors turn."""
        if climb <= 0.0:
            return 0.0
        free = max(self._fence.bounds[1][2] - self._limits.inside - height, 0.0)
        hard = (1.0 - steerable.LEAST_LIFT) * GRAVITY
        return max(climb / hard, min(climb / _UPWARDS, 2.0 * free / climb))

    def _is_down(self, action: Action, obs: Observation) -> bool:
        if not obs.airborne:
            return True
        position = obs.flown_from(self._limits.disagreement)
        if position is None:
            # Blind: the reference says when it must be down.
            return self._descending and self._place[2] <= self.ground - _BELOW_GROUND
        low = position[2] <= self.ground + _TOUCHDOWN
        # A reference this far below a vehicle that no longer moves: it stands on something.
        low = low or (self._descending and self._place[2] <= position[2] - 0.5)
        down = low and action is Action.LAND and abs(obs.velocity[2]) < _STILL
        held = self._touched.update(down, obs.time)
        return held is not None and held >= _REST_TIME

    def _fly(self, action: Action, obs: Observation) -> FullState:
        elapsed = obs.time - self._begun
        if self._brake is not None and elapsed < max(self._brake[2]):
            axes = [_braked(*axis, elapsed) for axis in zip(*self._brake, strict=True)]
            (x, vx, ax), (y, vy, ay), (z, vz, az) = axes
            place = (x, y, max(z, self.ground + 0.05))
            self.reference = place
            return FullState(place, (vx, vy, vz), (ax, ay, az), self._yaw, (0.0, 0.0, 0.0))
        dt = obs.time - max(self._moved, self._begun)
        self._moved = obs.time
        velocity = self._advance(action, obs, dt)
        self.reference = self._place
        return FullState(self._place, velocity, (0.0, 0.0, 0.0), self._yaw, (0.0, 0.0, 0.0))

    def _advance(self, action: Action, obs: Observation, dt: float) -> Point:
        """Move the place to be at for ``dt`` s; returns its velocity."""
        x, y, z = self._place
        tx, ty, tz = self._target
        dx, dy, dz = tx - x, ty - y, tz - z
        away = math.sqrt(dx * dx + dy * dy + (0.0 if self._descending else dz * dz))
        step = self._limits.return_speed * dt
        share = 1.0 if away <= step or away < 1e-9 else step / away
        vx, vy, vz = (
            (0.0, 0.0, 0.0) if dt <= 0.0 else (dx * share / dt, dy * share / dt, dz * share / dt)
        )
        blind = obs.pose_age > self._limits.pose_hold
        if action is Action.LAND and obs.below and not blind:
            self._step_aside(obs)
        # Without poses the vehicle drifts: being down soon matters more than where.
        elif action is Action.LAND and (blind or away < 0.1):
            self._descending = True
        if self._descending:
            vz = -(self._limits.blind_descent if blind else self._limits.descent)
            lowest = self.ground - 2.0 * _BELOW_GROUND
            if z + vz * dt < lowest:
                vz = min(0.0, (lowest - z) / dt) if dt > 0.0 else 0.0
        self._place = (x + vx * dt, y + vy * dt, z + vz * dt)
        return vx, vy, vz

    def _step_aside(self, obs: Observation) -> None:
        """Towards a place beside whoever is below; down where it is if there is no such place."""

        def within(place: Point) -> Point:
            try:
                return self._fence.nearest(place, self._limits.inside, self._place)
            except InputError:
                return self._place

        aside = beside(self._place, obs.below, within)
        self._descending = aside is None
        if aside is not None:
            self._target = aside


def _braked(place: float, speed: float, time: float, now: float) -> tuple[float, float, float]:
    """Place, speed and acceleration of one axis, ``now`` s into a stop that takes ``time``."""
    if now >= time:
        return place + 0.5 * speed * time, 0.0, 0.0
    left = 1.0 - now / time
    return place + speed * now * 0.5 * (1.0 + left), speed * left, -speed / time
