"""Where to be when: plans through the track, and plans anew when it turns out to be different."""

from __future__ import annotations

import numpy as np
from route import Limits, State, bars, first_guess, gates_of, plan

TAKE_OFF = 0.4  # s, straight up, while the rotors begin to turn
LIFT, LIFT_LATE = 4.0, 0.12  # m/s2, s
SWINGS = ((0.35, 0.0), (0.7, 0.0), (0.35, 0.35))  # m, first guesses
ROUGH, FINE, IN_FLIGHT = 60, 150, 60  # iterations
LOST = 0.3  # s, after which a gate that should have been passed is flown to once more
STRETCHES = (1.0, 1.6, 2.5)  # of the next pieces, where a detour is too sharp
YAW_RATE = 1.5  # rad/s
MOVED = 0.005  # m, of anything in sight, that makes it plan anew
UNSEEN = 0.12  # m, that poles nobody has seen are thought to be thicker


class Navigator:
    """The route of one episode; :meth:`look` at every observation, then :meth:`reference`."""

    def __init__(self, obs, limits: Limits | None = None):
        self.limits = limits or Limits()
        self.told = self._track(obs)
        self.start = np.array(obs["pos"], float)
        self.flies = False
        self.yaw = 0.0
        start = State(*self._lifted(TAKE_OFF))
        self.route = self._best(start, obs, TAKE_OFF, SWINGS)

    def _best(self, start, obs, begin, swings):
        """The best of several first guesses, refined."""
        gates, walls = gates_of(obs), self._walls(obs)
        routes = [
            plan(
                start, gates, walls, self.limits, begin,
                first_guess(start, gates, swing, lift), ROUGH,
            )
            for swing, lift in swings
        ]  # fmt: skip
        best = min(routes, key=lambda route: route.cost)
        guess = best.position, best.velocity, best.acceleration, best.duration
        return plan(start, gates, walls, self.limits, begin, guess, FINE)

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
        if not gates or t < TAKE_OFF:
            return
        if not self.flies:
            # On from where it really is.
            self.flies = True
            self.told = self._track(obs)
            now = State(*(np.array(obs[k], float) for k in ("pos", "vel")), np.zeros(3))
            guess = self.route.left_at(t, len(gates))
            self.route = plan(now, gates, self._walls(obs), self.limits, t, guess, IN_FLIGHT)
            return
        # The route may be past a gate that the drone has not quite reached.
        legs = len(self.route.duration) // 2 - 1
        first = legs - len(gates)  # of the route's gates, the one that is to be passed next
        due = self.route.gate_times[first] if first >= 0 else self.route.begin
        if t > due + LOST:
            self.told = self._track(obs)
            now = State(np.array(obs["pos"], float), np.array(obs["vel"], float), np.zeros(3))
            self.route = self._best(now, obs, t, SWINGS[:1])
            return
        track = self._track(obs)
        if np.abs(track - self.told).max() < MOVED:
            return
        self.told = track
        passed = sum(time <= t for time in self.route.gate_times)
        gates = gates[max(0, passed - first) :]
        if not gates:
            return
        now, walls = State(*self.route.at(t)), self._walls(obs)
        best = None
        for stretch in STRETCHES:
            p, v, a, duration = self.route.left_at(t, len(gates))
            duration[:3] *= stretch
            v[1:3] /= stretch
            route = plan(now, gates, walls, self.limits, t, (p, v, a, duration), IN_FLIGHT)
            if best is None or route.cost < best.cost:
                best = route
            # What costs much more than it lasts breaks a limit: try it slower.
            if best.cost < 1.15 * (best.end - t) + 0.3:
                break
        self.route = best

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
