"""What safety has to know of the vehicle that flies: how it follows, brakes and coasts.

Close to its setpoint a vehicle under a position controller is a damped spring, as soon as it has
the tilt, or the rotors the thrust, that are asked for:

    x'' = f a + k (p - x) + c (s v - x')

p, v and a being the setpoint, whose velocity the Mellinger controller follows (s = 1) and the PID
does not (s = 0). Mellinger and Kumar (ICRA 2011, eq. 6) ask for a force, so the stiffness depends
on the vehicle's mass and on what its motors make of a force asked for; the cascaded PID asks for
a tilt, which is an acceleration whatever the vehicle weighs. Drag does not appear: the estimator
on board knows none, and corrects its attitude until what it sees fits without.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

Point = tuple[float, float, float]

GRAVITY = 9.81
PID, MELLINGER = 1, 2
# m/s2 by value of ``stabilizer.controller``: 0 chooses the PID, whose tilt is limited. How others
# brake has not been measured.
BRAKING = {0: 3.5, PID: 3.5, MELLINGER: 6.0}
GENTLEST = min(BRAKING.values())
_OF_AGILITY = 0.98  # share of the motors' strength that braking may take
_SHARPEST = 0.75  # share of that strength that body rates may ask for; 1.0 goes over in simulation
_LEAST = 0.3  # m/s2, of a vehicle that can hardly lift itself
_SPEEDS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5)  # m/s, from which stops are looked at
_STEP, _PATIENCE = 0.005, 4.0  # s


@dataclass(frozen=True, slots=True)
class FlightModel:
    """One vehicle with one controller; the default is a ``cf21plus`` under Mellinger's.

    Attributes
    ----------
    controller: value of ``stabilizer.controller``.
    stiffness, damping: k in 1/s2, c in 1/s, by axis.
    feed: f, share of an acceleration asked for that arrives, by axis.
    follows_velocity: whether setpoints' velocities count.
    agility: m/s2, the strongest horizontal acceleration, at constant height, that controller and
        motors allow.
    tilting, thrusting: s, until a tilt, a thrust asked for is there (first-order lags).
    swinging: rad/s and damping ratio with which a tilt swings to what is asked for.
    lean: s, tilt (rad) that it keeps for every rad/s of a body rate that it is told and that its
        way does not need: kw over twice kR of Mellinger's attitude loop, whose error is twice the
        sine of the angle. The PID heeds none.
    winding: m/s2 of a setpoint's acceleration that are worth 1 m s of its controller's integral of
        the position error, sideways; 0 for the PID, whose integral is of the speed.
    drag: 1/s, share of its speed that the air takes.
    low: m by which it hovers below its setpoint.
    lift: all that the motors can lift over the weight.
    spent: V under load, at which they hardly lift the weight any more.
    """

    controller: int = MELLINGER
    stiffness: Point = (12.161, 12.161, 38.005)
    damping: Point = (6.081, 6.081, 12.161)
    feed: Point = (0.8817, 0.8817, 0.8817)
    follows_velocity: bool = True
    agility: float = 11.472
    tilting: float = 0.176
    thrusting: float = 0.08
    swinging: tuple[float, float] = (13.5, 0.85)
    lean: float = 0.1429
    winding: float = 1.7241
    drag: float = 0.409
    low: float = 0.0305
    lift: float = 1.5387
    spent: float = 2.585

    @property
    def floats(self) -> float:
        """m by which it surely hovers above its setpoint, at least 0. Of one that hovers below it
        is not asked more: the next of its kind may be lighter."""
        return max(0.0, -self.low)

    @property
    def braking(self) -> float:
        """m/s2 that it is trusted with: its controller's, or what its motors have."""
        return min(BRAKING.get(self.controller, GENTLEST), max(_LEAST, _OF_AGILITY * self.agility))

    @property
    def strongest(self) -> float:
        """m/s2, the strongest horizontal acceleration that the motors have at constant height."""
        return GRAVITY * math.sqrt(max(self.lift * self.lift - 1.0, 0.0))

    @property
    def sharpest(self) -> float:
        """rad/s at which a plan may tip the vehicle: such rates are told along with it, and with
        more of them the attitude loop asks for a lean that it does not come back from."""
        if self.lean <= 0.0:
            return math.inf
        return _SHARPEST * self.strongest / (self.lean * GRAVITY)

    def response(self, braking: float) -> float:
        """s for which a stop with ``braking``, m/s2, seems to begin too late, from speeds up to
        3.5 m/s: what the vehicle goes too far, over its speed."""
        return max((self.stop(v, braking) - 0.5 * v * v / braking) / v for v in _SPEEDS)

    def stop(self, speed: float, braking: float) -> float:
        """m gone until rest, led by setpoints that slow down evenly from where it is, m/s."""
        k, c, f = self.stiffness[0], self.damping[0], self.feed[0]
        duration = speed / braking
        place, moving, pushed = 0.0, speed, 0.0
        time = 0.0
        while moving > 0.0 and time < _PATIENCE:
            left = max(0.0, 1.0 - time / duration)
            told = speed * min(time, duration) * 0.5 * (1.0 + left)
            along = speed * left if self.follows_velocity else 0.0
            ahead = -braking if left > 0.0 else 0.0
            asked = f * ahead + k * (told - place) + c * (along - moving)
            asked = min(max(asked, -self.agility), self.agility)
            pushed += (asked - pushed) * _STEP / (self.tilting + _STEP)
            moving += pushed * _STEP
            place += moving * _STEP
            time += _STEP
        return place


@dataclass(frozen=True, slots=True)
class ModelFacts:
    """What the vehicle's file and its parameters foretell.

    Attributes
    ----------
    name: of the file; flies: how the vehicle follows what it is told.
    mass, mass_thrust: values of ``ctrlMel.mass`` (kg) and ``ctrlMel.massThrust``, either of which
        brings it up to its setpoint under Mellinger's controller.
    """

    name: str
    flies: FlightModel
    mass: float
    mass_thrust: float
