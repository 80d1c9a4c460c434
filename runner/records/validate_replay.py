"""Real flights flown again: logged setpoints through simulated firmware and plant.

The simulated vehicle stands where the real one stood, hears what the real one was told when it
was told, and is seen by cameras whenever the real one was seen: a frame for every logged pose,
but 125 a second at most.
Nothing else of the flight is told to the simulation, and nothing is fitted but the thrust it
takes to hover (:func:`hover_strength`), which motors, battery and accelerometer tell.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import CommandError
from crazyarena.mocap.rotations import rotate
from crazyarena.runner.records.validate_flights import RealFlight
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.arena_kernel import DT
from crazyarena.sim_backend.physics import arena_plant as ap
from crazyarena.sim_backend.physics.rigid_body import P_MASS
from crazyarena.sim_backend.vehicles import Rows
from crazyarena.types import Pose

Array = NDArray[np.float64]

SETTLE, LEAD_OUT = 4.5, 3.0  # s after the first and before the last command that are not judged
_STAND = 0.3  # m: a vehicle that begins higher is in the air
_BOOT = 2.0  # s on the ground before the first command
_CLIMB = 6.0  # s that a flight whose log begins in the air is given to get there
_STEP = 0.01  # s
_FRAME = 0.008  # s, at least, between frames: logs on board repeat what ground stations send
_SIGHT = 0.01  # s from exposure of the cameras to the estimator


@dataclass(frozen=True, slots=True)
class SimulatedFlight:
    """What the simulation made of a flight, at the times of the real poses.

    time (n,) s, position (n, 3) m of the tracked body, volts (n,) of the battery; strength: of
    the motors, relative to the model.
    """

    time: Array
    position: Array
    volts: Array
    strength: float


def judged(flight: RealFlight, time: Array) -> NDArray[np.bool_]:
    """Which times count: not take-off and landing, unless the log is too short for that."""
    first, last = flight.start, flight.end
    inside: NDArray[np.bool_] = (time > first + SETTLE) & (time < last - LEAD_OUT)
    return inside if inside.sum() * 2 > len(time) * 0.1 else (time >= first) & (time <= last)


def hover_strength(flight: RealFlight, rows: Rows) -> float | None:
    """Strength of the motors relative to the model, from what it took them to hold the vehicle.

    The mean nominal thrust of the logged motor commands at the logged battery voltage, against
    the weight of the model and the logged vertical acceleration. None where motors or battery
    were not logged.
    """
    if not len(flight.motors) or not len(flight.volts):
        return None
    time = flight.motors.time
    inside = judged(flight, time) & (flight.motors.value > 0.05).all(axis=1)
    if inside.sum() < 10:
        return None
    volts = flight.volts.at(time)[:, 0]
    each = rows.plant[ap.AP_THRUST : ap.AP_THRUST + 4]
    strengths = rows.plant[ap.AP_STRENGTH : ap.AP_STRENGTH + 4]
    thrust = np.polynomial.polynomial.polyval(flight.motors.value * volts[:, None], each)
    nominal = float((np.maximum(thrust, 0.0) @ strengths)[inside].mean())
    pull = 1.0
    if len(flight.acceleration):
        pull = float(flight.acceleration.value[judged(flight, flight.acceleration.time), 2].mean())
    weight = float(rows.plant[P_MASS]) * ap.GRAVITY
    return weight * pull / nominal if nominal > 0.0 else None


def with_strength(rows: Rows, strength: float) -> Rows:
    """Rows of a vehicle whose motors are so much stronger."""
    plant = rows.plant.copy()
    plant[ap.AP_STRENGTH : ap.AP_STRENGTH + 4] *= strength
    return replace(rows, plant=plant)


def fly(flight: RealFlight, rows: Rows, strength: float = 1.0) -> SimulatedFlight:
    """Fly a flight again, with motors of ``strength`` relative to the model."""
    replay = _Replay(flight, with_strength(rows, strength))
    try:
        return replay.run(strength)
    finally:
        replay.fleet.close()


class _Replay:
    def __init__(self, flight: RealFlight, rows: Rows) -> None:
        self.flight = flight
        start = flight.start
        before = flight.pose.time <= start
        ground = flight.pose.value[before] if before.any() else flight.pose.value[:1]
        x, y, _ = (float(value) for value in ground[-1])
        self.in_air = float(ground[-1, 2]) > _STAND
        self.fleet = ArenaFleet([(x, y, 0.0)], vehicles=rows)
        self.fleet.set_param(0, "stabilizer.controller", flight.controller)
        # The tracked body's origin lies above the centre, by what the log shows on the ground.
        rest = float(self.fleet.true_pose(0).position[2])
        high = rows.offset[2] if self.in_air else float(np.median(ground[:, 2])) - rest
        self.offset = rows.offset + (0.0, 0.0, high - rows.offset[2])
        self._charge(rows, start)

    def _charge(self, rows: Rows, start: float) -> None:
        """Begin with the battery that the log shows at rest, where it does."""
        volts = self.flight.volts
        if self.in_air or not len(volts) or not (volts.time < start).any():
            return
        seen = float(np.median(volts.value[volts.time < start]))
        plant = rows.plant
        seen += plant[ap.AP_RESISTANCE] * plant[ap.AP_IDLE_CURRENT]
        table = plant[ap.AP_OPEN : ap.AP_OPEN + ap.OPEN_POINTS]
        drawn = float(np.interp(-seen, -table, np.linspace(0.0, 1.0, ap.OPEN_POINTS)))
        self.fleet.bodies[0, ap.AB_CHARGE] = drawn * plant[ap.AP_CAPACITY]

    def run(self, strength: float) -> SimulatedFlight:
        flight, fleet = self.flight, self.fleet
        self._prepare()
        start = flight.start
        base = fleet.tick
        poses = flight.pose.time[(flight.pose.time >= start)]
        poses = poses[poses <= flight.end]
        seen, volts = np.empty((len(poses), 3)), np.empty(len(poses))
        commands = iter([*flight.commands, (np.inf, None)])
        due, command = next(commands)
        framed = -np.inf
        for k, time in enumerate(poses):
            # What falls on the same millisecond: first the frame, then the command.
            while command is not None and due < time:
                self._advance(base, due - start)
                self._send(command)
                due, command = next(commands)
            self._advance(base, time - start)
            due_frame = time - framed >= _FRAME
            framed = time if due_frame else framed
            seen[k] = self._frame() if due_frame else self._body().position
            volts[k] = fleet.bodies[0, ap.AB_VOLTS]
        return SimulatedFlight(poses, seen, volts, strength)

    def _prepare(self) -> None:
        first = np.asarray(self.flight.pose.value[0])
        for k in range(round((_CLIMB if self.in_air else _BOOT) / _STEP)):
            self._frame()
            if self.in_air and k > round(_BOOT / _STEP):
                self._send(c.Position(first))
            self.fleet.advance(round(_STEP / DT))

    def _advance(self, base: int, time: float) -> None:
        ticks = base + round(time / DT) - self.fleet.tick
        if ticks > 0:
            self.fleet.advance(ticks)

    def _send(self, command: c.Command) -> None:
        try:
            self.fleet.send(command, 0)
        except CommandError:
            return  # the real one could not have been sent it either

    def _frame(self) -> Array:
        """Let the cameras see the vehicle; where they see the tracked body."""
        body = self._body()
        self.fleet.external_pose(0, body, _SIGHT)
        return body.position

    def _body(self) -> Pose:
        """Of the tracked body."""
        pose = self.fleet.true_pose(0)
        return Pose(pose.position + rotate(pose.quaternion, self.offset), pose.quaternion)
