"""Trajectory files and evaluation, formations, and the firmware bindings' names."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.crazyswarm_compat import uav_trajectory as ut
from crazyarena.crazyswarm_compat import util
from crazyarena.crazyswarm_compat.config import load_crazyflies_1
from crazyarena.errors import InputError

HEADER = "duration," + ",".join(f"{axis}^{k}" for axis in "xyzw" for k in range(8))
SWAPPED = "duration," + ",".join(f"{a}^{k}" for a in ("y", "x", "z", "yaw") for k in range(8))
ROW = ",".join(str(0.1 * k + 0.5) for k in range(33))
coefficients = st.lists(st.floats(-3, 3), min_size=1, max_size=8)


@given(coefficients, st.floats(0, 3))
def test_polynomial(p, t):
    polynomial = ut.Polynomial(p)
    assert polynomial.eval(t) == pytest.approx(np.polynomial.Polynomial(p)(t), abs=1e-9)
    derivative = np.polynomial.Polynomial(p).deriv()(t) if len(p) > 1 else 0.0
    assert polynomial.derivative().eval(t) == pytest.approx(derivative, abs=1e-8)


def test_polynomial_needs_time_of_the_piece():
    with pytest.raises(AssertionError):
        ut.Polynomial([1.0]).eval(-1e-3)


def test_normalize():
    assert np.allclose(ut.normalize(np.array([3.0, 0.0, 4.0])), [0.6, 0, 0.8])


@pytest.mark.parametrize("comma", ["", ","])
def test_load(tmp_path, comma):
    path = tmp_path / "t.csv"
    path.write_text(f"{HEADER}\n{ROW}{comma}\n{ROW}{comma}\n")
    for given_path in (str(path), path):
        trajectory = ut.Trajectory()
        trajectory.loadcsv(given_path)
        assert (trajectory.n_pieces(), trajectory.duration) == (2, 1.0)
        assert np.allclose(trajectory.polynomials[1].pyaw.p, 0.5 + 0.1 * np.arange(25, 33))


@pytest.mark.parametrize("start", ["", "\ufeff", "\n\n", HEADER + "\n", f"\ufeff\n{HEADER}\n"])
def test_no_piece_is_taken_for_a_header(tmp_path, start):
    path = tmp_path / "t.csv"
    path.write_text(f"{start}{ROW}\n{ROW}\n", encoding="utf-8")
    trajectory = ut.Trajectory()
    trajectory.loadcsv(path)
    assert (trajectory.n_pieces(), trajectory.duration) == (2, 1.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{ROW.replace('0.5', '3s', 1)}\n{ROW}", r"t\.csv, line 1: could not convert .*3s"),
        (f"{SWAPPED}\n{ROW}", r"t\.csv, line 1: columns in another order.*duration, x\^0"),
        (HEADER, r"t\.csv: holds no trajectory piece"),
        (f"{HEADER}\n1,2,3", r"t\.csv, line 2: 3 columns; a piece has 33"),
        (f"{HEADER}\n{ROW}\n{ROW.replace('0.5', 'x', 1)}", r"t\.csv, line 3: could not convert"),
        (f"{HEADER}\n{ROW.replace('0.5', '-1', 1)}", r"t\.csv, line 2: duration -1\.0"),
        (f"{HEADER}\n{ROW.replace('0.6', 'nan', 1)}", r"t\.csv, line 2: .*finite"),
    ],
)
def test_load_refuses(tmp_path, text, message):
    path = tmp_path / "t.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        ut.Trajectory().loadcsv(path)


def test_load_missing_file(tmp_path):
    with pytest.raises(InputError, match=r"none\.csv: cannot read"):
        ut.Trajectory().loadcsv(tmp_path / "none.csv")


def test_eval_agrees_with_finite_differences(figure8):
    step = 1e-4
    for t in np.arange(0.15, figure8.duration, 0.3):  # where no seam between pieces is near
        before, now, after = (figure8.eval(t + k * step) for k in (-1, 0, 1))
        assert np.allclose(now.vel, (after.pos - before.pos) / (2 * step), atol=1e-4)
        assert np.allclose(now.acc, (after.vel - before.vel) / (2 * step), atol=1e-3)
        assert now.yaw == 0.0


def test_body_rates_turn_the_thrust(figure8):
    def attitude(out):
        z = ut.normalize(out.acc + ut.GRAVITY)
        y = ut.normalize(np.cross(z, [math.cos(out.yaw), math.sin(out.yaw), 0.0]))
        return np.column_stack([np.cross(y, z), y, z])

    step = 1e-5
    # Inside a piece: the pieces of this trajectory do not join with continuous jerk.
    for t in (0.15, 0.75, 2.55, 4.05):
        a, b = attitude(figure8.eval(t)), attitude(figure8.eval(t + step))
        spin = a.T @ (b - a) / step
        assert np.allclose(figure8.eval(t).omega[:2], [spin[2, 1], spin[0, 2]], atol=1e-2)


@pytest.mark.parametrize("t", [-0.01, 6.01])
def test_eval_outside(figure8, t):
    with pytest.raises(AssertionError):
        figure8.eval(t)


def test_collisions():
    positions = np.array([[0, 0, 0], [0.2, 0, 0], [0, 0, 0.7], [5, 5, 5]])
    assert util.check_ellipsoid_collisions(positions, np.array([0.125, 0.125, 0.375])).tolist() == [
        True, True, True, False,
    ]  # fmt: skip
    for distance, collides in ((1.96, True), (1.98, False)):
        pair = np.array([[0, 0, 0], [0.1 * distance, 0, 0]])
        assert util.check_ellipsoid_collisions(pair, np.full(3, 0.1)).tolist() == [collides] * 2


def test_poisson_disk_sample():
    np.random.seed(4)  # noqa: NPY002
    points = util.poisson_disk_sample(20, 2, 0.5)
    distance = np.linalg.norm(points[:, None] - points[None], axis=2) + 9 * np.eye(20)
    assert points.shape == (20, 2)
    assert distance.min() >= 0.5
    np.random.seed(4)  # noqa: NPY002
    first = (1.25 * 20) ** 0.5 * 0.5 * np.random.uniform(-0.5, 0.5, 2)  # noqa: NPY002
    assert np.array_equal(points[0], first)


def test_grid_yaml():
    vehicles = load_crazyflies_1(util.grid_yaml(2, 3, spacing=0.4)).vehicles
    assert [(v.id, v.channel) for v in vehicles] == [(k, 100) for k in range(6)]
    grid = np.array([v.initial_position for v in vehicles])
    assert np.allclose(grid.mean(axis=0), 0)
    assert np.allclose(np.ptp(grid, axis=0), [0.4, 0.8, 0])


class TestFirmwareNames:
    @pytest.fixture
    def firm(self):
        import pycrazyswarm.cfsim.cffirmware as firm

        return firm

    def test_vectors(self, firm):
        a, b = firm.mkvec(1, 2, 3), firm.mkvec(-1, 0, 2)
        assert firm.vcross(a, b) == firm.mkvec(*np.cross([1, 2, 3], [-1, 0, 2]))
        assert firm.vdot(a, b) == 5
        assert firm.vadd(a, firm.vneg(b)) == firm.vsub(a, b)
        assert firm.vmag(firm.vnormalize(a)) == pytest.approx(1)
        assert np.array_equal(np.array(firm.vscl(2, a)), [2, 4, 6])
        assert firm.vdist(a, firm.vzero()) == pytest.approx(math.sqrt(firm.vmag2(a)))

    def test_planner(self, firm):
        p = firm.planner()
        firm.plan_init(p)
        assert not firm.is_traj_eval_valid(firm.plan_current_goal(p, 0.0))
        assert firm.plan_takeoff(p, firm.mkvec(1, 2, 0), 0.0, 1.5, 2.0, 0.0) == 0
        assert firm.plan_takeoff(p, firm.mkvec(1, 2, 0), 0.0, 1.5, 2.0, 0.0) == 1
        assert firm.plan_current_goal(p, 1.0).pos.z == pytest.approx(0.75)
        firm.plan_go_to(p, True, firm.mkvec(1, 0, 0), 0.5, 1.0, 3.0)
        end = firm.plan_current_goal(p, 4.5)
        assert np.allclose([*end.pos, end.yaw], [2, 2, 1.5, 0.5])
        assert firm.plan_land(p, end.pos, end.yaw, 0.1, 0.0, 1.0, 5.0) == 0
        assert p.state == firm.TRAJECTORY_STATE_LANDING
        assert firm.plan_current_goal(p, 6.0).pos.z == pytest.approx(0.1)
        assert firm.plan_is_stopped(p)

    def test_trajectory(self, firm, figure8):
        trajectory = firm.piecewise_traj()
        trajectory.n_pieces = figure8.n_pieces()
        for source, piece in zip(figure8.polynomials, trajectory.pieces, strict=True):
            piece.duration = source.duration
            for dim, axis in enumerate((source.px, source.py, source.pz, source.pyaw)):
                for k, value in enumerate(axis.p):
                    firm.poly4d_set(piece, dim, k, value)
        expected = figure8.eval(1.3)
        out = firm.piecewise_eval(trajectory, 1.3)
        assert np.allclose(np.array(out.pos), expected.pos, atol=1e-5)
        assert np.allclose(np.array(out.omega), expected.omega, atol=1e-3)
        back = firm.piecewise_eval_reversed(trajectory, figure8.duration - 1.3)
        assert np.allclose(np.array(back.pos), expected.pos, atol=1e-5)
        assert firm.piecewise_is_finished(trajectory, figure8.duration + 0.1)
        p = firm.planner()
        firm.plan_start_trajectory(p, trajectory, False, True, firm.mkvec(1, 1, 1))
        moved = firm.plan_current_goal(p, 1.3)
        assert np.allclose(np.array(moved.pos), expected.pos + 1, atol=1e-5)
