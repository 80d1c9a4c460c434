"""Where to be when: plans through the track, and plans anew when it turns out to be different.

Planning in flight is spread over the steps, a few milliseconds each: the new route leaves the one
that is flown a little later on, at the very place, speed and acceleration it has there. Where no
sound way is known through what is not seen yet, it flies slowly; where what it then sees is in the
way and no plan is round it, it stands still as late as it can, thinks longer, and goes on slowly.
"""

from __future__ import annotations

from dataclasses import replace

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
YAW_RATE = 1.5  # rad/s
MOVED = 0.005  # m, of anything in sight, that makes it plan anew
BRAKES = (0.4, 0.3, 0.5, 0.65)  # s, that it may take to stand still
AHEAD, EVERY = 1.0, 0.04  # s, how far along the route it looks at what is in sight, how often
NEAR = 0.1  # m, from the drone's centre to a surface, that is taken for a touch
CLEAR = 0.13  # m, that is enough to stop in, and to go on from there
THINK = 8  # steps for each plan from a standstill
CAREFUL = {"clearance": 0.14, "speed": 1.0, "gate_speed": 0.9}  # from there on to the next gate


class Navigator:
    """The route of one episode; :meth:`look` at every observation, then :meth:`reference`.

    lead: s, that who follows it looks ahead. A new route begins so much later than it is decided.
    """

    def __init__(self, obs, period, lead=0.0, limits=None):
        self.limits = limits or Limits()
        self.careful = replace(self.limits, **CAREFUL)
        self.period, self.lead = period, lead
        self.told, self.known = self._track(obs), None
        self.start = np.array(obs["pos"], float)
        self.yaw = 0.0
        self.plan, self.round = None, 0
        self.rest, self.tried = None, []
        self.slowly = None  # gates left, as long as it flies slowly to the next of them
        self.routes = []
        best = self._best(self._lifted(TAKE_OFF), obs, TAKE_OFF)
        best.improve(FINE)
        for way in range(WAYS):
            if best.excess.max() < SOUND:
                break
            guess = swung((best.route.knots, best.route.duration), int(best.excess.argmax()), way)
            other = Plan(gates_of(obs), self._walls(obs), self.limits, TAKE_OFF, guess)
            other.improve(FINE // 2)
            best = min(best, other, key=lambda plan: plan.cost)
        if best.excess.max() > SOUND:
            guess, slow = (best.route.knots, best.route.duration), best.excess > SOUND
            walls = self._walls(obs)
            best = Plan(gates_of(obs), walls, self.limits, TAKE_OFF, guess, best.curvature, slow)
            best.improve(FINE // 2)
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

    @property
    def route(self):
        """The newest route."""
        return self.routes[-1]

    def _track(self, obs):
        return np.concatenate(
            [np.ravel(obs[k]) for k in ("gates_pos", "gates_quat", "obstacles_pos")]
        ).astype(float)

    def _walls(self, obs):
        keys = "gates_pos", "gates_quat", "obstacles_pos", "gates_visited", "obstacles_visited"
        return Walls(*bars(*(obs[key] for key in keys)))

    def _solid(self, obs):
        """What is in sight or was, at its true size."""
        gates, poles = np.asarray(obs["gates_visited"]), np.asarray(obs["obstacles_visited"])
        known = np.concatenate([gates, poles]).tolist()
        if self.known != known:
            self.known = known
            self.solid = Walls(
                *bars(
                    obs["gates_pos"][gates],
                    obs["gates_quat"][gates],
                    obs["obstacles_pos"][poles],
                    gates[gates],
                    poles[poles],
                )
            )
        return self.solid

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
            self.told, self.known = track, None
            self._anew(obs, t, gates)
        elif self.slowly is not None and len(gates) < self.slowly:
            self._anew(obs, t, gates)
        elif self.plan is None and self.rest is None and self._is_lost(t, gates):
            here = np.stack([obs["pos"], obs["vel"], np.zeros(3)]).astype(float)
            self._brake(obs, t, gates, here)
        if self.plan is not None:
            self.plan.improve(A_STEP)
            if t > self.plan.begin - self.lead - 0.5 * self.period:
                self._adopt(obs, t, gates)
        if self.rest is None and self.slowly is None and t > TAKE_OFF:
            self._stop_before(obs, t, gates)

    def _next(self, gates):
        """Which of the route's gates is to be passed next."""
        return len(self.route.gate_times) - len(gates)

    def _is_lost(self, t, gates):
        due = self._next(gates)
        return t > (self.route.gate_times[due] if due >= 0 else self.route.begin) + LOST

    def _anew(self, obs, t, gates):
        """Plan for what was just seen."""
        if self.rest is not None:
            self.tried = []
            self._think(obs, t, gates)
        else:
            self.slowly = None
            self._begin(obs, t, gates, 0)

    def _begin(self, obs, t, gates, number):
        """Begin a plan that leaves the route some steps on."""
        begin = max(t + STEPS * self.period + self.lead, self.route.begin)
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
        slow = self.excess[-len(gates) - 1 :] > SOUND
        plan = Plan(gates, walls, self.limits, begin, guess, self.curvature, slow)
        self.price = np.inf
        if number and plan.excess.max() > SOUND:
            # Round by round another way round what is in the way.
            self.price = plan.cost - GAIN
            guess = swung(guess, int(plan.excess.argmax()), number - 1)
            plan = Plan(gates, walls, self.limits, begin, guess, self.curvature, slow)
        self.plan, self.round = plan, number

    def _adopt(self, obs, t, gates):
        if self.rest is not None:
            self._thought(obs, t, gates)
            return
        plan, self.plan = self.plan, None
        if plan.cost >= self.price:
            # The other way round is no better.
            if self.round < WAYS:
                self._begin(obs, t, gates, self.round + 1)
            return
        self._fly(plan)
        better = plan.at_first - plan.cost > GAIN and self.round < ROUNDS
        unsound = self.excess > SOUND
        relieved = plan.slow is not None and bool((plan.slow & ~unsound).any())
        if better or ((unsound.any() or relieved) and self.round < WAYS):
            self._begin(obs, t, gates, self.round + 1)

    def _fly(self, plan):
        self.routes.append(plan.route)
        self.curvature, self.excess = plan.curvature, plan.excess

    def _stop_before(self, obs, t, gates):
        """Brake when what is in sight is in the way, if a plan cannot still be waited for."""
        now = t + self.lead
        times = np.arange(now, min(now + AHEAD, self.route.end), EVERY)
        if len(times) == 0 or self._gap(obs, self.reference, times) > NEAR:
            return
        if self.plan is not None:
            later = now + self.period
            if self._halt(obs, self.reference(later), later)[0] > CLEAR:
                return
            if self._halt(obs, self.reference(now), now)[0] < NEAR:
                return  # Too late to stop: to swerve is what is left.
        self._brake(obs, now, gates, self.reference(now))

    def _gap(self, obs, at, times):
        """Distance of the places ``at`` some times from what is in sight, m."""
        places = np.array([at(time)[0] for time in times])
        return float(self._solid(obs).distance(places).min())

    def _halt(self, obs, here, t):
        """How far from what is in sight one can come to a stand from a state, m, and how."""
        best = -np.inf, None
        for last in BRAKES:
            rest = np.zeros((3, 3))
            rest[0] = here[0] + 0.5 * last * here[1] + last * last / 12 * here[2]
            route = Route(np.stack([here, rest]), np.array([last]), t)
            gap = self._gap(obs, route.at, t + np.arange(0.0, last + EVERY, EVERY))
            best = max(best, (gap, route), key=lambda pair: pair[0])
            if gap > CLEAR:
                break
        return best

    def _brake(self, obs, t, gates, here):
        """Come to rest, and plan from there."""
        route = self._halt(obs, here, t)[1]
        self.rest = np.zeros((3, 3))
        self.rest[0] = route.knots[-1, 0]
        self.routes.append(route)
        self.tried = []
        self._think(obs, t, gates)

    def _think(self, obs, t, gates):
        """Begin one more plan from the standstill."""
        number = len(self.tried)
        if number < len(SWINGS):
            guess = first_guess(self.rest, gates, *SWINGS[number])
        else:
            best = min(self.tried, key=lambda plan: plan.cost)
            guess = best.route.knots, best.route.duration
            guess = swung(guess, int(best.excess[:2].argmax()), number - len(SWINGS))
        begin = max(self.route.end, t + THINK * self.period + self.lead)
        self.plan = Plan(gates, self._walls(obs), self.careful, begin, guess)
        self.slowly = len(gates)

    def _thought(self, obs, t, gates):
        """Fly the best plan, or think once more."""
        self.tried.append(self.plan)
        self.plan = None
        best = min(self.tried, key=lambda plan: plan.excess[:2].max())
        if best.excess[:2].max() > SOUND and len(self.tried) < len(SWINGS) + WAYS:
            route = best.route
            times = np.arange(route.begin, min(route.end, route.gate_times[0] + AHEAD), EVERY)
            if self._gap(obs, route.at, times) < CLEAR:
                self._think(obs, t, gates)
                return
        knots, duration = best.route.knots, best.route.duration
        self.routes.append(Route(knots, duration, t + self.lead))
        self.curvature, self.excess = best.curvature, best.excess
        self.rest = None

    def reference(self, t):
        """Position, velocity, acceleration as rows (3, 3) at a time, s since the first step."""
        if t < TAKE_OFF:
            return self._lifted(t)
        for route in reversed(self.routes):
            if route.begin <= t:
                return route.at(t)
        return self.routes[0].at(t)

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
