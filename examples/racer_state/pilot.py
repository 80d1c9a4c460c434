"""Where to be when: plans through the track, and plans anew when it turns out to be different."""

from __future__ import annotations

import numpy as np
from route import Limits, State, bars, first_guess, gates_of, plan

TAKE_OFF = 0.22  # s, until the rotors carry the drone
SWINGS = ((0.35, 0.0), (0.7, 0.0), (0.35, 0.35), (0.0, 0.0), (0.7, -0.3))  # m, first guesses
ITERATIONS, ITERATIONS_IN_FLIGHT = 350, 60
MOVED = 0.005  # m, of anything in sight, that makes it plan anew
UNSEEN = 0.06  # m, that poles nobody has seen are thought to be thicker


class Navigator:
    """The route of one episode; :meth:`look` at every observation, then :meth:`reference`."""

    def __init__(self, obs, limits: Limits | None = None):
        self.limits = limits or Limits()
        self.told = self._track(obs)
        self.left = len(gates_of(obs))
        start = State(np.array(obs["pos"], float), np.zeros(3), np.zeros(3))
        gates, walls = gates_of(obs), self._walls(obs)
        routes = [
            plan(
                start, gates, walls, self.limits, TAKE_OFF,
                first_guess(start, gates, swing, lift), ITERATIONS,
            )
            for swing, lift in SWINGS
        ]  # fmt: skip
        self.route = min(routes, key=lambda route: route.cost)

    def _track(self, obs):
        return np.concatenate(
            [np.ravel(obs[k]) for k in ("gates_pos", "gates_quat", "obstacles_pos")]
        ).astype(float)

    def _walls(self, obs):
        spread = np.where(obs["obstacles_visited"], 0.0, UNSEEN)
        return bars(obs["gates_pos"], obs["gates_quat"], obs["obstacles_pos"], spread)

    def look(self, obs, t):
        """Plan anew if something is not where it was said to be."""
        gates = gates_of(obs)
        track = self._track(obs)
        if not gates or t < TAKE_OFF or np.abs(track - self.told).max() < MOVED:
            return
        self.told = track
        now = State(*self.route.at(t))
        # The route may be past a gate that the drone has not quite reached, or the reverse.
        legs = len(self.route.duration) // 2 - 1
        passed = sum(time <= t for time in self.route.gate_times)
        gates = gates_of(obs)[max(0, passed - (legs - len(gates))) :]
        if not gates:
            return
        guess = self.route.left_at(t, len(gates))
        walls = self._walls(obs)
        self.route = plan(now, gates, walls, self.limits, t, guess, ITERATIONS_IN_FLIGHT)

    def reference(self, t):
        """Position, velocity, acceleration as rows (3, 3) at a time, s since the first step."""
        return self.route.at(t)
