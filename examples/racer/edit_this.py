"""The example controller: plan a fast path through the gates, fly it with full-state setpoints.

Worth copying for: planning once in the constructor, keeping every control step cheap (0.1 ms),
re-planning only the next leg when a gate's exact pose is revealed, correcting the unknown mass
with one integrator per axis, and expecting the stale observation that opens later episodes.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from competition_utils import Command, timing_ep, timing_step
from path import Gate, Limits, Path, fly_through, oriented

ARENA = (np.array([-3.0, -3.0, -0.1]), np.array([3.0, 3.0, 2.0]))
LIFT_OFF = 4.0  # m/s2: off the ground at once, whatever the mass
STIFFNESS = 0.3
INTEGRAL = (1.0, 1.0, 8.0)  # 1/s2, from position error to acceleration
# Of the simulated vehicle of 2022, whose rotors follow at once and which the air does not brake.
SIMULATED_INERTIA = 1.4e-5  # kg m2
REAL_DRAG = 0.4  # 1/s, acceleration that a real one loses per m/s
REAL_LEAD = 0.06  # s by which it is behind what it is told
JOIN_TIME = 1.0  # s, to get from the true start onto the path
REROUTE_LIMIT = 5.0  # m/s2, for the detour to a gate that is not where it was said to be
INSIDE = 0.15  # m from the walls, where to come down if the link is lost, and to wait at the goal
# m for each rad/s of the last body rates: a vehicle without a link keeps a tilt against them.
CARRIED = 1.0


class Controller:
    """Contract: Safe Robot Learning Competition (IROS 2022), ``edit_this.py``."""

    def __init__(
        self, initial_obs, initial_info, use_firmware=False, buffer_size=100, verbose=False
    ):
        if not use_firmware:
            raise ValueError("this controller flies with firmware commands only")
        self.CTRL_TIMESTEP = initial_info["ctrl_timestep"]
        self.CTRL_FREQ = initial_info["ctrl_freq"]
        self.VERBOSE = verbose
        self.BUFFER_SIZE = buffer_size

        heights = [initial_info["gate_dimensions"][k]["height"] for k in ("tall", "low")]
        self.heights = heights
        nominal = initial_info["nominal_gates_pos_and_type"]
        poses = [(np.array([g[0], g[1], heights[g[6]]]), g[5]) for g in nominal]
        self.nominal = [(g[0], g[1], g[5]) for g in nominal]
        start = np.array(initial_obs[0:5:2], dtype=float)
        goal = np.array(initial_info["x_reference"], dtype=float)[0:5:2]
        # Anywhere within the tolerance will do.
        goal[:2] = np.clip(goal[:2], ARENA[0][:2] + INSIDE, ARENA[1][:2] - INSIDE)
        obstacles = np.array(initial_info["nominal_obstacles_pos"], dtype=float).reshape(-1, 6)

        spread = initial_info["gates_and_obs_randomization"]
        limits = Limits()
        if spread:
            # Gates move: leave time to react. Obstacles move and are never shown.
            limits = Limits(acceleration=3.0, speed=2.0, gate_speed=1.15, obstacle_uncertainty=0.17)
        physical = initial_info["nominal_physical_parameters"]
        self.real = abs(physical["quadrotor_ixx_inertia"] - SIMULATED_INERTIA) > 1e-7
        if self.real:
            # Rotors take 0.1 s to follow: slower, and wider around everything.
            limits = replace(
                limits, acceleration=1.5, braking=1.0, speed=1.1, gate_speed=0.8, coasting=0.9
            )
        self.limits = limits
        self.gates = oriented(poses, start, goal)
        self.plan: Path = fly_through(start, self.gates, goal, obstacles, limits, ARENA)

        self.reset()
        self.interEpisodeReset()

    def reset(self):
        """Forget the flight; the plan of the nominal track stays."""
        self.path = self.plan
        self.revealed = -1
        self.shift = None
        self.stiffen = [0.0, 0.0, 0.0]
        self.bias = [0.0, 0.0, 0.0]
        self.interstep_counter = 0
        self.interepisode_counter = 0

    def cmdFirmware(self, time, obs, reward=None, done=None, info=None):
        """Return ``(Command, args)`` for this control step; see the contract for the inputs."""
        if time == 0.0:
            self.reset()
        # The first observation of later episodes is the end of the one before.
        position = obs[0:5:2] if time > 0.0 else None
        if info:
            self._look(time, info)

        # Plain floats from here on: arrays of three cost ten times as much.
        where, velocity, push, jerk = self.path.at(time).tolist()
        planned = where
        ahead = self.path.at(time + REAL_LEAD).tolist() if self.real else None
        if position is not None:
            if self.shift is None:  # the start is not quite where it was said to be
                self.shift = [p - w for p, w in zip(position, where, strict=True)]
            if time < JOIN_TIME:
                fade = _fade(time, JOIN_TIME)
                where = [w + fade * s for w, s in zip(where, self.shift, strict=True)]
            self._correct([w - p for w, p in zip(where, position, strict=True)])
        if ahead is not None:
            where = [w + a - p for w, a, p in zip(where, ahead[0], planned, strict=True)]
            velocity, push, jerk = ahead[1:]
            push = [a + REAL_DRAG * v for a, v in zip(push, velocity, strict=True)]
        push = [a + b for a, b in zip(push, self.bias, strict=True)]
        if time < 0.15:
            push[2] = max(push[2], LIFT_OFF)
        target = [w + s for w, s in zip(where, self.stiffen, strict=True)]
        rates = _body_rates(push, jerk)
        share = self._share_that_stays_in(where, velocity, push, (rates[1], -rates[0]))
        return Command.FULLSTATE, [target, velocity, push, 0.0, [share * r for r in rates]]

    def _share_that_stays_in(self, place, velocity, push, carried):
        """Of body rates, which push along x and y: what there is room for if the link is lost."""
        share = 1.0
        for axis, rate in enumerate(carried):
            lost = place[axis] + self.limits.coasting * velocity[axis]
            lost += self.limits.coasting_push * push[axis]
            wall = ARENA[1][axis] - INSIDE if rate > 0.0 else ARENA[0][axis] + INSIDE
            room = max((wall - lost) * math.copysign(1.0, rate), 0.0)
            if room < CARRIED * abs(rate):
                share = min(share, room / (CARRIED * abs(rate)))
        return share

    def _look(self, time, info):
        """Re-route through the next gate as soon as its exact pose is shown."""
        gate = info["current_target_gate_id"]
        if gate < 0 or gate == self.revealed or not info["current_target_gate_in_range"]:
            return
        self.revealed = gate
        x, y, z, _, _, yaw = info["current_target_gate_pos"]
        if (x, y, yaw) == self.nominal[gate]:
            return
        normal = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
        if normal @ self.gates[gate].normal < 0:
            normal = -normal
        if time >= self.path.knot_time(self.path.gate_knots[gate]) - 0.05:
            return
        self.path = self.path.rerouted(
            time, gate, Gate(np.array([x, y, z]), normal), REROUTE_LIMIT, self.limits, ARENA
        )

    def _correct(self, error):
        """Stiffen the vehicle's own position loop a little and integrate what stays.

        More stiffness, or damping from these 30 Hz positions, makes a light vehicle oscillate:
        its attitude loop is not fast enough for it.
        """
        self.stiffen = [_clip(STIFFNESS * e, 0.1) for e in error]
        self.bias = [
            _clip(b + gain * self.CTRL_TIMESTEP * e, 3.0)
            for b, gain, e in zip(self.bias, INTEGRAL, error, strict=True)
        ]

    def cmdSimOnly(self, time, obs, reward=None, done=None, info=None):
        raise NotImplementedError("this controller flies with firmware commands only")

    @timing_step
    def interStepLearn(self, action, obs, reward, done, info):
        """Nothing is learnt from a step."""
        self.interstep_counter += 1

    @timing_ep
    def interEpisodeLearn(self):
        """Nothing is learnt from an episode."""
        self.interepisode_counter += 1

    def interEpisodeReset(self):
        """Start the timing of the next episode."""
        self.interstep_learning_time = 0
        self.interstep_learning_occurrences = 0
        self.interepisode_learning_time = 0


def _clip(value, limit):
    return min(max(value, -limit), limit)


def _fade(time, duration):
    """1 at time 0, 0 from ``duration`` on, smooth in between."""
    x = min(time / duration, 1.0)
    return 1.0 - x * x * x * (10.0 - x * (15.0 - 6.0 * x))


def _body_rates(acceleration, jerk):
    """Roll, pitch and yaw rate (rad/s) of a quadrotor following this jerk at yaw 0.

    Mellinger and Kumar, "Minimum snap trajectory generation and control", ICRA 2011.
    """
    ax, ay, az = acceleration[0], acceleration[1], acceleration[2] + 9.81
    norm = math.sqrt(ax * ax + ay * ay + az * az)
    zx, zy, zz = ax / norm, ay / norm, az / norm
    across = math.hypot(zy, zz)
    yy, yz = zz / across, -zy / across  # body y axis; its x component is 0 at yaw 0
    xx, xy, xz = yy * zz - yz * zy, yz * zx, -yy * zx
    jx, jy, jz = jerk
    along = jx * zx + jy * zy + jz * zz
    hx, hy, hz = ((j - along * z) / norm for j, z in ((jx, zx), (jy, zy), (jz, zz)))
    return [-(hy * yy + hz * yz), hx * xx + hy * xy + hz * xz, 0.0]
