"""The planner and vector functions of the firmware under the names of its Python bindings.

``pycrazyswarm.cfsim.cffirmware`` re-exports this module, so that scripts which plan with the
firmware's own functions keep working. Same argument orders as the C functions of 2022; SI
units, yaw in rad. Collision avoidance and controllers are not part of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from crazyarena.sim_backend.firmware import planner as pl
from crazyarena.sim_backend.firmware import polynomial as poly

TRAJECTORY_STATE_IDLE = int(pl.IDLE)
TRAJECTORY_STATE_FLYING = int(pl.FLYING)
TRAJECTORY_STATE_LANDING = int(pl.LANDING)
PP_SIZE = 8


@dataclass(slots=True)
class vec:
    """Vector of three numbers."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0

    def __iter__(self) -> Iterator[float]:
        return iter((self.x, self.y, self.z))

    def __add__(self, other: vec) -> vec:
        return vec(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: vec) -> vec:
        return vec(self.x - other.x, self.y - other.y, self.z - other.z)

    def __neg__(self) -> vec:
        return vec(-self.x, -self.y, -self.z)

    def __mul__(self, scale: float) -> vec:
        return vec(scale * self.x, scale * self.y, scale * self.z)

    __rmul__ = __mul__

    def __array__(self, dtype: object = None, copy: bool | None = None) -> np.ndarray:
        return np.array(tuple(self), dtype=dtype)  # type: ignore[call-overload]


def mkvec(x: float, y: float, z: float) -> vec:
    """Vector from its components."""
    return vec(float(x), float(y), float(z))


def vzero() -> vec:
    """Zero vector."""
    return vec()


def vadd(a: vec, b: vec) -> vec:
    """Sum."""
    return a + b


def vsub(a: vec, b: vec) -> vec:
    """Difference a - b."""
    return a - b


def vneg(a: vec) -> vec:
    """Opposite vector."""
    return -a


def vscl(scale: float, a: vec) -> vec:
    """Multiple."""
    return a * scale


def vdot(a: vec, b: vec) -> float:
    """Scalar product."""
    return a.x * b.x + a.y * b.y + a.z * b.z


def vcross(a: vec, b: vec) -> vec:
    """Vector product."""
    return vec(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


def vmag2(a: vec) -> float:
    """Squared length."""
    return vdot(a, a)


def vmag(a: vec) -> float:
    """Length."""
    return math.sqrt(vdot(a, a))


def vdist(a: vec, b: vec) -> float:
    """Distance."""
    return vmag(a - b)


def vnormalize(a: vec) -> vec:
    """Vector of length 1 in the same direction."""
    return a * (1.0 / vmag(a))


@dataclass(slots=True)
class traj_eval:
    """Evaluated trajectory: pos m, vel m/s, acc m/s², omega rad/s, yaw rad."""

    pos: vec = field(default_factory=vec)
    vel: vec = field(default_factory=vec)
    acc: vec = field(default_factory=vec)
    omega: vec = field(default_factory=vec)
    yaw: float = 0.0


def traj_eval_zero() -> traj_eval:
    """At the origin, at rest."""
    return traj_eval()


def traj_eval_invalid() -> traj_eval:
    """What an idle planner returns."""
    nan = math.nan
    return traj_eval(vec(nan, nan, nan), vec(nan, nan, nan), vec(nan, nan, nan))


def is_traj_eval_valid(ev: traj_eval) -> bool:
    """False for what an idle planner returns."""
    return not math.isnan(ev.pos.x)


class poly4d:
    """One piece: ``duration`` s and ``p`` (4, 8), ascending coefficients of x, y, z, yaw."""

    def __init__(self, duration: float = 0.0) -> None:
        self.duration = duration
        self.p = np.zeros((4, PP_SIZE))


def poly4d_set(piece: poly4d, dim: int, coef: int, value: float) -> None:
    """Set one coefficient."""
    piece.p[dim, coef] = value


def poly4d_get(piece: poly4d, dim: int, coef: int) -> float:
    """One coefficient."""
    return float(piece.p[dim, coef])


def malloc_poly4d(count: int) -> list[poly4d]:
    """``count`` empty pieces."""
    return [poly4d() for _ in range(count)]


def poly4d_eval(piece: poly4d, t: float) -> traj_eval:
    """Evaluate one piece at local time ``t`` s."""
    row = np.append(piece.p.ravel(), piece.duration)
    out = np.zeros(poly.EVAL_SIZE)
    poly.evaluate(row, 0, float(t), 1.0, out, 0)
    return _eval(out)


class piecewise_traj:
    """Trajectory of ``pieces``, begun at ``t_begin`` s, stretched by ``timescale``."""

    def __init__(self) -> None:
        self.pieces: list[poly4d] = []
        self.t_begin = 0.0
        self.timescale = 1.0
        self.shift = vec()

    @property
    def n_pieces(self) -> int:
        return len(self.pieces)

    @n_pieces.setter
    def n_pieces(self, count: int) -> None:
        del self.pieces[count:]
        self.pieces += malloc_poly4d(count - len(self.pieces))


def pp_get_piece(trajectory: piecewise_traj, index: int) -> poly4d:
    """One piece."""
    return trajectory.pieces[index]


def piecewise_duration(trajectory: piecewise_traj) -> float:
    """Stretched duration, s."""
    return trajectory.timescale * sum(piece.duration for piece in trajectory.pieces)


def piecewise_is_finished(trajectory: piecewise_traj, t: float) -> bool:
    """Whether the trajectory has come to its end."""
    return t - trajectory.t_begin >= piecewise_duration(trajectory)


def piecewise_eval(trajectory: piecewise_traj, t: float) -> traj_eval:
    """Evaluate at time ``t`` s; past the end it stands at the last point."""
    return _piecewise_eval(trajectory, t, reverse=False)


def piecewise_eval_reversed(trajectory: piecewise_traj, t: float) -> traj_eval:
    """Evaluate, flown backwards, at time ``t`` s."""
    return _piecewise_eval(trajectory, t, reverse=True)


def _piecewise_eval(trajectory: piecewise_traj, t: float, reverse: bool) -> traj_eval:
    p = planner()
    _load(p, trajectory, reverse)
    p.row[pl.PL_SHIFT : pl.PL_SHIFT + 3] = tuple(trajectory.shift)
    pl.evaluate_plan(p.row, p.memory, float(t))
    return _eval(p.row[pl.PL_EVAL :])


class planner:
    """State of the high-level planner: its row and the trajectory memory, given or new."""

    def __init__(self, row: np.ndarray | None = None, memory: np.ndarray | None = None) -> None:
        self.row = np.zeros(pl.PLANNER_SIZE) if row is None else row
        if memory is None:
            memory = np.zeros(pl.TRAJECTORY_MEMORY_SIZE, dtype=np.uint8)
        self.memory = memory

    @property
    def state(self) -> int:
        """One of the ``TRAJECTORY_STATE_`` constants."""
        return int(self.row[pl.PL_STATE])

    @property
    def reversed(self) -> bool:
        """Whether the trajectory is flown backwards."""
        return bool(self.row[pl.PL_REVERSED])


def plan_init(p: planner) -> None:
    """Make a planner idle, with nothing planned."""
    p.row[:] = 0.0


def plan_stop(p: planner) -> None:
    """Make a planner idle."""
    p.row[pl.PL_STATE] = pl.IDLE


def plan_is_stopped(p: planner) -> bool:
    """Whether a planner is idle."""
    return p.state == TRAJECTORY_STATE_IDLE


def plan_is_finished(p: planner, t: float) -> bool:
    """Whether what was planned has come to its end."""
    return bool(pl.is_finished(p.row, p.memory, float(t)))


def plan_current_goal(p: planner, t: float) -> traj_eval:
    """Setpoint at time ``t`` s; invalid while idle. A finished landing makes the planner idle."""
    if plan_is_stopped(p):
        return traj_eval_invalid()
    pl.evaluate_plan(p.row, p.memory, float(t))
    if p.state == TRAJECTORY_STATE_LANDING and plan_is_finished(p, t):
        plan_stop(p)
    return _eval(p.row[pl.PL_EVAL :])


def _from_rest(p: planner, pos: vec, yaw: float) -> None:
    p.row[pl.PL_EVAL :] = 0.0
    p.row[pl.PL_EVAL + poly.EV_POS : pl.PL_EVAL + poly.EV_POS + 3] = tuple(pos)
    p.row[pl.PL_EVAL + poly.EV_YAW] = yaw


def _vertical(p: planner, pos: vec, yaw: float, args: tuple[float, ...], state: float) -> int:
    # Older bindings have no goal yaw between height and duration.
    height, goal_yaw, duration, t = args if len(args) == 4 else (args[0], 0.0, *args[1:])
    _from_rest(p, pos, float(yaw))
    goal = (float(pos.x), float(pos.y), float(height))
    pl.plan_point_to_point(
        p.row, float(t), float(duration), goal, float(goal_yaw), (0.0, 0.0, 0.0), 0.0
    )
    p.row[pl.PL_STATE] = state
    return 0


def plan_takeoff(p: planner, pos: vec, yaw: float, *args: float) -> int:
    """``(p, pos, yaw, height, goal yaw, duration, t)``; without goal yaw it is 0. 1 in flight."""
    if not plan_is_stopped(p):
        return 1
    return _vertical(p, pos, yaw, args, pl.FLYING)


def plan_land(p: planner, pos: vec, yaw: float, *args: float) -> int:
    """``(p, pos, yaw, height, goal yaw, duration, t)``; without goal yaw it is 0. 1 if landing."""
    if p.state == TRAJECTORY_STATE_LANDING:
        return 1
    return _vertical(p, pos, yaw, args, pl.LANDING)


def plan_go_to_from(
    p: planner,
    start: traj_eval,
    relative: bool,
    pos: vec,
    yaw: float,
    duration: float,
    t: float,
) -> int:
    """Plan from ``start`` to a goal at rest."""
    for offset, value in (
        (poly.EV_POS, start.pos),
        (poly.EV_VEL, start.vel),
        (poly.EV_ACC, start.acc),
        (poly.EV_OMEGA, start.omega),
    ):
        p.row[pl.PL_EVAL + offset : pl.PL_EVAL + offset + 3] = tuple(value)
    p.row[pl.PL_EVAL + poly.EV_YAW] = start.yaw
    if relative:
        pos, yaw = pos + start.pos, yaw + start.yaw
    pl.plan_point_to_point(
        p.row,
        float(t),
        float(duration),
        (float(pos.x), float(pos.y), float(pos.z)),
        float(yaw),
        (0.0, 0.0, 0.0),
        0.0,
    )
    p.row[pl.PL_STATE] = pl.FLYING
    return 0


def plan_go_to(p: planner, relative: bool, pos: vec, yaw: float, duration: float, t: float) -> int:
    """Plan from the present setpoint to a goal at rest."""
    return plan_go_to_from(p, plan_current_goal(p, t), relative, pos, yaw, duration, t)


def plan_start_trajectory(
    p: planner,
    trajectory: piecewise_traj,
    reverse: bool,
    relative: bool = False,
    start_from: vec | None = None,
) -> int:
    """Follow a trajectory, begun at its ``t_begin``; ``relative`` shifts it to ``start_from``."""
    _load(p, trajectory, bool(reverse))
    if relative:
        pos = tuple(float(value) for value in (start_from or vec()))
        pl.make_relative(p.row, p.memory, pos, False, 0.0)
    else:
        p.row[pl.PL_SHIFT : pl.PL_SHIFT + 3] = tuple(trajectory.shift)
    p.row[pl.PL_STATE] = pl.FLYING
    return 0


def _load(p: planner, trajectory: piecewise_traj, reverse: bool) -> None:
    rows = np.array([np.append(piece.p.ravel(), piece.duration) for piece in trajectory.pieces])
    data = np.frombuffer(rows.astype("<f4").tobytes(), dtype=np.uint8)
    if not 0 < len(data) <= len(p.memory):
        raise ValueError(
            f"trajectory of {trajectory.n_pieces} pieces; the memory holds 1..31 of them"
        )
    p.memory[: len(data)] = data
    pl.start_pieces(
        p.row,
        p.memory,
        float(trajectory.t_begin),
        0,
        trajectory.n_pieces,
        float(trajectory.timescale),
        reverse,
    )


def _eval(row: np.ndarray) -> traj_eval:
    def at(offset: int) -> vec:
        return vec(*(float(value) for value in row[offset : offset + 3]))

    return traj_eval(
        at(poly.EV_POS),
        at(poly.EV_VEL),
        at(poly.EV_ACC),
        at(poly.EV_OMEGA),
        float(row[poly.EV_YAW]),
    )
