"""Where to be when: plans through the track, and plans anew when it turns out to be different."""

from __future__ import annotations

import numpy as np
from route import Limits, Planning, State, bars, first_guess, gates_of

TAKE_OFF = 0.4  # s, straight up, while the rotors begin to turn
LIFT, LIFT_LATE = 4.0, 0.12  # m/s2, s
SWINGS = ((0.35, 0.0), (0.7, 0.0), (0.35, 0.35))  # m, first guesses
ROUGH, FINE = 80, 170  # evaluations of a route, on the ground
AT_ONCE, EVALUATIONS = 14, 9  # in a step, in flight: when something has moved, and afterwards
AHEAD = 0.06  # s, from the thought to the route
ROUNDS = 6  # of that, after something has moved
LOST = 0.3  # s, after which a gate that should have been passed is flown to once more
STRETCH = 1.6  # of the next pieces, where a detour is too sharp
YAW_RATE = 1.5  # rad/s
MOVED = 0.005  # m, of anything in sight, that makes it plan anew
UNSEEN = 0.12  # m, that poles nobody has seen are thought to be thicker


class Navigator:
    """The route of one episode; :meth:`look` at every observation, then :meth:`reference`.

    The first route is planned at leisure. In flight there are a few milliseconds a step: a new
    route begins where the old one will be in a moment, and is taken then, as good as it has become;
    the next begins from it, until nothing gets better.
    """

    def __init__(self, obs, limits: Limits | None = None):
        self.limits = limits or Limits()
        self.told = self._track(obs)
        self.start = np.array(obs["pos"], float)
        self.flies = False
        self.yaw = 0.0
        self.next: Planning | None = None
        self.rounds = 0  # that are left to make the route better
        start = State(*self._lifted(TAKE_OFF))
        self.route = self._best(start, obs, TAKE_OFF)

    def _best(self, start, obs, begin):
        """The best of several first guesses, refined."""
        gates, walls = gates_of(obs), self._walls(obs)
        plans = []
        for swing, lift in SWINGS:
            guess = first_guess(start, gates, swing, lift)
            plans.append(Planning(start, gates, walls, self.limits, begin, guess))
            plans[-1].advance(ROUGH)
        best = min(plans, key=lambda plan: plan.route.cost)
        best.advance(FINE)
        return best.route

    def _track(self, obs):
        return np.concatenate(
            [np.ravel(obs[k]) for k in ("gates_pos", "gates_quat", "obstacles_pos")]
        ).astype(float)

    def _walls(self, obs):
        spread = np.where(obs["obstacles_visited"], 0.0, UNSEEN)
        return bars(obs["gates_pos"], obs["gates_quat"], obs["obstacles_pos"], spread)

    def _lifted(self, t):
        """Reference while it takes off."""
        since = np.array([0.0, 0.0, max(0.0, t - LIFT_LATE)])
        return np.stack([self.start + 0.5 * LIFT * since**2, LIFT * since, LIFT * (since > 0)])

    def look(self, obs, t):
        """Plan anew if something is not where it was said to be, or a gate was missed."""
        gates = gates_of(obs)
        if not gates or t < TAKE_OFF - AHEAD:
            return
        if self.next is not None:
            self.next.advance(EVALUATIONS)
            if t + 1e-9 < self.next.begin:
                return
            self.flies = True
            self.route, self.next = self.next.route, None
            self.rounds -= 1
        if not self.flies:
            # On from where it really is.
            self.told, self.rounds = self._track(obs), ROUNDS
            here = np.array(obs["pos"], float), np.array(obs["vel"], float)
            start = State(here[0] + AHEAD * here[1], here[1], np.zeros(3))
            self._plan(obs, gates, t + AHEAD, start)
            return
        # The route may be past a gate that the drone has not quite reached.
        first = self._legs() - len(gates)  # of the route's gates, the one to be passed next
        due = self.route.gate_times[first] if first >= 0 else self.route.begin
        if t > due + LOST:
            self.told, self.rounds = self._track(obs), ROUNDS
            here = np.array(obs["pos"], float), np.array(obs["vel"], float)
            start = State(here[0] + AHEAD * here[1], here[1], np.zeros(3))
            self._plan(obs, gates, t + AHEAD, start, first_guess(start, gates, *SWINGS[0]))
            return
        track = self._track(obs)
        if np.abs(track - self.told).max() >= MOVED:
            # At once, bent to what is seen as far as a step allows.
            self.told, self.rounds = track, ROUNDS
            ahead, evaluations = 0.0, AT_ONCE
        elif self.rounds > 0:
            ahead, evaluations = AHEAD, EVALUATIONS
        else:
            return
        passed = sum(time <= t + ahead for time in self.route.gate_times)
        gates = gates[max(0, passed - first) :]
        if gates:
            start = State(*self.route.at(t + ahead))
            self._plan(obs, gates, t + ahead, start, evaluations=evaluations)
            if ahead == 0.0:
                self.route, self.next = self.next.route, None

    def _legs(self):
        """How many gates the route passes."""
        return len(self.route.duration) // 2 - 1

    def _plan(self, obs, gates, begin, start, guess=None, evaluations=EVALUATIONS):
        """Begin a route that is taken from ``begin`` on."""
        if guess is None:
            p, v, a, duration = self.route.left_at(begin, len(gates))
            # What costs much more than it lasts breaks a limit: try it slower.
            if self.rounds < ROUNDS and self.route.cost > 1.15 * (self.route.end - begin) + 0.3:
                duration[:3] *= STRETCH
                v[1:3] /= STRETCH
            guess = p, v, a, duration
        self.next = Planning(start, gates, self._walls(obs), self.limits, begin, guess)
        self.next.advance(evaluations)

    def reference(self, t):
        """Position, velocity, acceleration as rows (3, 3) at a time, s since the first step."""
        return self.route.at(t) if self.flies else self._lifted(t)

    def heading(self, obs, period):
        """Yaw (rad) that turns the drone's sides parallel to the frame it flies through next."""
        gates = gates_of(obs)
        if gates:
            quarter = 0.5 * np.pi
            want = np.arctan2(gates[0].normal[1], gates[0].normal[0])
            want = (want + 0.5 * quarter) % quarter - 0.5 * quarter
            self.yaw += np.clip(want - self.yaw, -YAW_RATE * period, YAW_RATE * period)
        return self.yaw
