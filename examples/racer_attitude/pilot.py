"""Where to be when: plans through the track, and plans anew when it turns out to be different.

Planning in flight is spread over the steps, a few milliseconds each: the new route leaves the one
that is flown a little later on, at the very place, speed and acceleration it has there.
"""

from __future__ import annotations

import numpy as np
from route import Limits, Plan, Route, Walls, bars, first_guess, gates_of, swung

TAKE_OFF = 0.4  # s, straight up, while the rotors begin to turn
LIFT, LIFT_LATE = 4.0, 0.12  # m/s2, s
SWINGS = ((0.35, 0.0), (0.7, 0.0), (0.35, 0.35))  # m, first guesses
ROUGH, FINE = 100, 600  # routes looked at before the start: for each guess, for the best
A_STEP = 12  # routes looked at in a step
STEPS = 4  # that a plan is worked on before it is flown
CLOSE = 0.14  # s, before a gate, in which the route stays as it is
ROUNDS = 2  # further plans, each from where the last begins
SOUND, WAYS = 0.5, 5  # s, that a leg may cost more than it lasts; other ways round it to try
GAIN = 0.02  # s, that make one more of them worth while
LOST = 0.3  # s, after which a gate that should have been passed is flown to once more
BRAKES = 0.6  # s, that it takes to stand still then
YAW_RATE = 1.5  # rad/s
MOVED = 0.005  # m, of anything in sight, that makes it plan anew


class Navigator:
    """The route of one episode; :meth:`look` at every observation, then :meth:`reference`."""

    def __init__(self, obs, period, limits: Limits | None = None):
        self.limits = limits or Limits()
        self.period = period
        self.told = self._track(obs)
        self.start = np.array(obs["pos"], float)
        self.yaw = 0.0
        self.plan, self.round, self.rest = None, 0, None
        best = self._best(self._lifted(TAKE_OFF), obs, TAKE_OFF)
        best.improve(FINE)
        for way in range(WAYS):
            if best.excess.max() < SOUND:
                break
            guess = swung((best.route.knots, best.route.duration), int(best.excess.argmax()), way)
            other = Plan(gates_of(obs), self._walls(obs), self.limits, TAKE_OFF, guess)
            other.improve(FINE // 2)
            best = min(best, other, key=lambda plan: plan.cost)
        self._fly(best)

    def _best(self, start, obs, begin):
        """The best of several first guesses."""
        gates, walls = gates_of(obs), self._walls(obs)
        plans = [
            Plan(gates, walls, self.limits, begin, first_guess(start, gates, swing, lift))
            for swing, lift in SWINGS
        ]
        for plan in plans:
            plan.improve(ROUGH)
        return min(plans, key=lambda plan: plan.cost)

    def _track(self, obs):
        return np.concatenate(
            [np.ravel(obs[k]) for k in ("gates_pos", "gates_quat", "obstacles_pos")]
        ).astype(float)

    def _walls(self, obs):
        keys = "gates_pos", "gates_quat", "obstacles_pos", "gates_visited", "obstacles_visited"
        return Walls(*bars(*(obs[key] for key in keys)))

    def _lifted(self, t):
        """Reference while it takes off."""
        since = np.array([0.0, 0.0, max(0.0, t - LIFT_LATE)])
        return np.stack([self.start + 0.5 * LIFT * since**2, LIFT * since, LIFT * (since > 0)])

    def look(self, obs, t):
        """Go on with the plan in hand; begin one if something is not where it was said to be, or
        a gate was missed."""
        gates = gates_of(obs)
        if not gates:
            return
        track = self._track(obs)
        if np.abs(track - self.told).max() > MOVED:
            self.told = track
            self._begin(obs, t, gates, 0)
        elif self.plan is None and self._is_lost(t, gates):
            self._brake(obs, t, gates)
        if self.plan is not None:
            self.plan.improve(A_STEP)
            if t > self.plan.begin - 0.5 * self.period:
                self._adopt(obs, t, gates)

    def _next(self, gates):
        """Which of the route's gates is to be passed next."""
        return len(self.route.gate_times) - len(gates)

    def _is_lost(self, t, gates):
        due = self._next(gates)
        return t > (self.route.gate_times[due] if due >= 0 else self.route.begin) + LOST

    def _begin(self, obs, t, gates, number):
        """Begin a plan that leaves the route some steps on."""
        if self.rest is not None:
            guess = first_guess(self.rest, gates, *SWINGS[0])
            self.plan = Plan(gates, self._walls(obs), self.limits, self.route.end, guess)
            self.price = np.inf
            return
        begin = max(t + STEPS * self.period, self.route.begin)
        # The route may be past a gate that the drone has not quite reached.
        passed = 0
        for time in self.route.gate_times:
            if time < begin + CLOSE:
                # Not in the last moment before a gate.
                passed, begin = passed + 1, max(begin, time + self.period)
        gates = gates[max(0, passed - self._next(gates)) :]
        self.plan = None
        if not gates:
            return
        guess, walls = self.route.left_at(begin, len(gates)), self._walls(obs)
        plan = Plan(gates, walls, self.limits, begin, guess, self.curvature)
        self.price = np.inf
        if number and plan.excess.max() > SOUND:
            # Round by round another way round what is in the way.
            self.price = plan.cost - GAIN
            guess = swung(guess, int(plan.excess.argmax()), number - 1)
            plan = Plan(gates, walls, self.limits, begin, guess, self.curvature)
        self.plan, self.round = plan, number

    def _adopt(self, obs, t, gates):
        plan, self.plan, self.rest = self.plan, None, None
        if plan.cost >= self.price:
            # The other way round is no better.
            if self.round < WAYS:
                self._begin(obs, t, gates, self.round + 1)
            return
        self._fly(plan)
        better = plan.at_first - plan.cost > GAIN and self.round < ROUNDS
        if better or (self.excess.max() > SOUND and self.round < WAYS):
            self._begin(obs, t, gates, self.round + 1)

    def _fly(self, plan):
        self.route, self.curvature, self.excess = plan.route, plan.curvature, plan.excess

    def _brake(self, obs, t, gates):
        """Come to rest, and plan from there."""
        here = np.stack([obs["pos"], obs["vel"], np.zeros(3)]).astype(float)
        self.rest = np.zeros((3, 3))
        self.rest[0] = here[0] + 0.5 * BRAKES * here[1]
        self.route = Route(np.stack([here, self.rest]), np.array([BRAKES]), t)
        self._begin(obs, t, gates, 0)

    def reference(self, t):
        """Position, velocity, acceleration as rows (3, 3) at a time, s since the first step."""
        return self.route.at(t) if t >= TAKE_OFF else self._lifted(t)

    def heading(self, obs):
        """Yaw (rad) that turns the drone's sides parallel to the frame it flies through next."""
        gates = gates_of(obs)
        if gates:
            quarter = 0.5 * np.pi
            want = np.arctan2(gates[0].normal[1], gates[0].normal[0])
            want = (want + 0.5 * quarter) % quarter - 0.5 * quarter
            most = YAW_RATE * self.period
            self.yaw += np.clip(want - self.yaw, -most, most)
        return self.yaw
