"""After a run: back above the track, down at the start, disarmed."""

from __future__ import annotations

import numpy as np

from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.errors import InputError
from crazyarena.levels.schema import Level
from crazyarena.mocap.estimator import Freshness
from crazyarena.runner.rig.rig import Rig
from crazyarena.runner.trial.hands import DOWN, STILL, TICK, Hands
from crazyarena.runner.trial.phase import Aborted, Array, Grip, OnPhase, Phase, Timeouts
from crazyarena.runner.trial.tracked_world import roll_pitch_yaw
from crazyarena.safety.fence import Fence
from crazyarena.sim_backend.firmware.supervisor import INFO_ARMED, INFO_AUTO_ARM, INFO_FLYING

_PEAK_SPEED = 1.0  # m/s on the way home
_PEAK_OVER_MEAN = 35.0 / 16.0  # of the firmware's rest-to-rest polynomial
_BRAKING = 3.0  # m/s2, after the run
_OF_BRAKING = 0.8  # share of what the watchdog would brake with
_ASIDE = 0.25  # m from the fence, from where it flies home
_HOME_ASIDE = 0.1  # m from the fence, at home
_DRAW_BACK = 0.4  # m/s on the way there
_GATE_HALF = 0.36  # m, of a gate's frame
_GATE_CLEAR = 0.45  # m from a gate's plane, from where nothing of it is above
_GATE_NEAR = 0.35  # m from its plane, within which it is in the way up
_SETTLED = 0.5  # s at rest before it goes on
_SWINGS = 3.0  # s more for a vehicle that still swings
_MOST_OFF = 0.2  # m, by which a vehicle is believed to hover off the height it is told
_ABOVE_TRACK = 0.35  # m above the highest gate, on the way home


class Homecoming(Hands):
    """Brings a vehicle home. ``grip`` is what the operator holds until it is down, if anything."""

    def __init__(self, rig: Rig, level: Level, on_phase: OnPhase, timeouts: Timeouts) -> None:
        super().__init__(rig, on_phase)
        self._level = level
        self._timeouts = timeouts
        self._home: Array | None = None
        self._off = 0.0
        self.grip: Grip | None = None

    def announce(self, phase: Phase, text: str) -> None:
        """Tell of a phase that is not the crew's own work."""
        self._on_phase(phase, text)

    def bring_home(self) -> None:
        """Fly back above the track and land at the start, as long as the vehicle can; then disarm.

        Raises :class:`Aborted` if it cannot be brought down, or not there.
        """
        problem: Aborted | None = None
        try:
            with self._phase(Phase.RETURN, land_on_failure=False):
                self._return()
        except Aborted as error:
            problem = error
            self._come_down()
        if self._taken():
            self.stand_down()
        else:
            with self._phase(Phase.DISARM, land_on_failure=False):
                self._disarm()
        if problem is not None:
            raise problem

    def stand_down(self) -> None:
        """For a vehicle that the watchdog has taken and brought down: only make sure of it."""
        with self._phase(Phase.DISARM, land_on_failure=False):
            self._send_quietly(cs.CutMotors())
            self._until(
                lambda: self._height() <= DOWN or not self._flyable(),
                self._timeouts.disarm,
                Phase.DISARM,
                lambda: f"the vehicle is still {self._height():.2f} m high",
            )
        self._may_let_go()

    def _return(self) -> None:
        if not self._flyable():
            self._on_phase(Phase.RETURN, "the vehicle cannot fly any more; motors off")
            self._send_quietly(cs.CutMotors())
            return
        if self._height() <= DOWN:
            self._send(cs.NotifySetpointsStop())
            self._send(cs.Stop())
            return
        assert self._home is not None
        place, yaw = self._stop_moving()
        above = self._safe_height()
        self._send(cs.NotifySetpointsStop())
        self._go(np.array([place[0], place[1], max(above, place[2])]), yaw)
        # A start at the very fence is no place to brake for.
        over = np.array([*self._home[:2], max(above, place[2])])
        self._go(self._inside(over, _HOME_ASIDE), yaw)
        self._land_here()

    def _stop_moving(self) -> tuple[Array, float]:
        """Brake, draw back from the fence and out of a gate; the place (3,) m and heading there.

        A plan that begins on the move swings out by a fifth of its duration times the speed: too
        much for a run that ended close to the fence. By how much the vehicle hovers above its
        setpoint (a controller that takes it for another weight) is learnt here for the way home.
        """
        self._off = 0.0
        state = self._estimate().state
        begin, velocity = state.position.copy(), state.velocity.copy()
        yaw = roll_pitch_yaw(state.quaternion)[2]
        speed = float(np.linalg.norm(velocity))
        braking = speed / self._deceleration()
        rest = begin + 0.5 * braking * velocity
        rest[2] = max(rest[2], begin[2], DOWN + 0.1)
        inside = self._out_of_gates(self._inside(rest, _ASIDE), velocity)
        away = inside - rest
        if speed < STILL and not away.any():
            return begin, yaw
        drawing = float(np.linalg.norm(away)) / _DRAW_BACK
        clock = self._rig.clock
        start, zero = clock.now(), np.zeros(3)
        calm = braking + drawing + _SETTLED
        while (now := clock.now() - start) < calm or (self._swings() and now < calm + _SWINGS):
            self._must_fly(Phase.RETURN)
            if now < braking:
                left = 1.0 - now / braking
                place = begin + velocity * now * (0.5 + 0.5 * left)
                setpoint = cs.FullState(place, velocity * left, -velocity / braking, yaw, zero)
            else:
                share = min(1.0, (now - braking) / drawing) if drawing > 0.0 else 1.0
                pace = away / drawing if share < 1.0 else zero
                setpoint = cs.FullState(rest + share * away, pace, zero, yaw, zero)
            self._send(setpoint)
            clock.sleep_until(clock.now() + TICK)
        if not self._swings():
            off = float(self._estimate().state.position[2] - inside[2])
            self._off = float(np.clip(off, -_MOST_OFF, _MOST_OFF))
        return inside, yaw

    def _out_of_gates(self, place: Array, velocity: Array) -> Array:
        """``place`` (3,) m, or one before or behind the gate that it is in: the next way is up.

        Runs end at the last gate, and who is slow there comes to rest in its opening. Onward if
        the fence leaves room for that, else back.
        """
        for gate in self._level.track.gates:
            cos, sin = np.cos(gate.yaw), np.sin(gate.yaw)
            offset = place - np.array(gate.centre)
            across = float(offset[0] * cos + offset[1] * sin)
            along = float(offset[1] * cos - offset[0] * sin)
            top = _GATE_HALF + 0.1
            if abs(along) > _GATE_NEAR or abs(across) > _GATE_HALF + 0.15 or offset[2] > top:
                continue
            pace = float(velocity[1] * cos - velocity[0] * sin)
            onward = float(np.copysign(_GATE_CLEAR, pace if abs(pace) > 0.05 else along))
            for wanted in (onward, -onward):
                there = place + (wanted - along) * np.array([-sin, cos, 0.0])
                if np.allclose(self._inside(there, _ASIDE), there):
                    return there
        return place

    def _swings(self) -> bool:
        return float(np.linalg.norm(self._estimate().state.velocity)) > STILL

    def _deceleration(self) -> float:
        """m/s2, gently, and no more than the vehicle is trusted with."""
        guard = self._rig.safeguard
        return _BRAKING if guard is None else min(_BRAKING, _OF_BRAKING * guard.limits.braking)

    def _inside(self, place: Array, margin: float) -> Array:
        """The place (3,) m nearest to ``place`` that is ``margin`` m inside the fence."""
        x, y, z = place.tolist()
        try:
            return np.array(Fence.from_level(self._level).nearest((x, y, z), margin))
        except InputError:
            return place

    def _safe_height(self) -> float:
        tops = [gate.centre[2] + 0.25 for gate in self._level.track.gates]
        tops += [obstacle.z + 0.95 for obstacle in self._level.track.obstacles]
        ceiling = self._level.arena.high[2] - self._level.arena.soft_margin - 0.1
        top = max([*tops, 0.5])
        if top + _ABOVE_TRACK <= ceiling:
            return top + _ABOVE_TRACK
        # A low room: as far from the track as from the ceiling.
        return min(0.5 * (top + ceiling), ceiling)

    def _go(self, place: Array, yaw: float) -> None:
        here = self._estimate().state.position
        away = float(np.linalg.norm(place - here))
        duration = max(1.0, away * _PEAK_OVER_MEAN / _PEAK_SPEED)
        self._send(cs.GoTo(place - (0.0, 0.0, self._off), yaw, duration))
        end = self._rig.clock.now() + duration
        while self._rig.clock.now() < end:
            self._must_fly(Phase.RETURN)
            self._rig.clock.sleep_until(min(end, self._rig.clock.now() + TICK))
        self._until(
            lambda: float(np.linalg.norm(self._estimate().state.position - place)) < 0.25,
            3.0,
            Phase.RETURN,
            lambda: "the vehicle does not get where it is sent",
        )

    def _must_fly(self, phase: Phase) -> None:
        if not self._flyable():
            raise Aborted(phase, "the vehicle tumbled, crashed or was locked")
        if self._estimate().freshness is Freshness.STALE:
            self._send_quietly(cs.Land(0.0, 2.0))
            who = "the cameras lost" if self._rig.onboard is None else "nothing is known of"
            raise Aborted(phase, f"{who} {self._rig.body!r}")

    def _disarm(self) -> None:
        self._send_quietly(cs.CutMotors())
        self._send_quietly(cs.Arm(False))
        self._until(
            lambda: self._at_rest() or not self._flyable(),
            self._timeouts.disarm,
            Phase.DISARM,
            lambda: f"vehicle {self._rig.vehicle} does not disarm; switch it off by hand",
        )
        self._may_let_go()

    def _may_let_go(self) -> None:
        if self.grip is not None:
            self._on_phase(Phase.DISARM, f"you may let go of {self.grip.what}")

    def _at_rest(self) -> bool:
        """Disarmed; or, for firmware that arms by itself again at once, no longer flying."""
        info = self._supervisor()
        return not info & INFO_ARMED or (info & INFO_AUTO_ARM != 0 and not info & INFO_FLYING)
