"""The two examples for lsy_drone_racing's contract."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from crazyarena.runner.lsy_run import LsyRun

EXAMPLES = Path(__file__).parents[2] / "examples"
PERIOD = 0.02


@pytest.mark.parametrize("mode", ["state", "attitude"])
def test_examples_pass_the_gates_of_a_level_that_moves(mode):
    """One episode here; what share of many they pass is in docs/lsy.md."""
    overrides = [f"env.control_mode={mode}"]
    run = LsyRun(EXAMPLES / f"racer_{mode}", "lsy/level2", overrides, seed=2)
    result = run.run()
    assert result.clean, result.episodes[0]
    assert result.mean_time < 6.5


def test_both_plan_by_the_same_files():
    """A controller is copied with its folder alone, so each has its own."""
    for name in ("pilot.py", "route.py"):
        one, two = (EXAMPLES / f"racer_{mode}" / name for mode in ("state", "attitude"))
        assert one.read_bytes() == two.read_bytes()


@pytest.fixture
def planning(monkeypatch):
    """The modules ``route`` and ``pilot`` of an example."""
    monkeypatch.syspath_prepend(str(EXAMPLES / "racer_state"))
    for name in ("route", "pilot"):
        sys.modules.pop(name, None)
    yield importlib.import_module("route"), importlib.import_module("pilot")
    for name in ("route", "pilot"):
        sys.modules.pop(name, None)


def told():
    """What a controller is told at first on level 2."""
    half = np.array([-0.78, 2.35, 3.14, 0.0]) / 2
    quat = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1)
    gates = [[0.5, 0.25, 0.7], [1.05, 0.75, 1.2], [-1.0, -0.25, 0.7], [0.0, -0.75, 1.2]]
    poles = [[0.0, 0.75, 1.55], [1.0, 0.25, 1.55], [-1.5, -0.25, 1.55], [-0.5, -0.75, 1.55]]
    return {
        "pos": np.array([-1.5, 0.75, 0.01]),
        "vel": np.zeros(3),
        "gates_pos": np.array(gates),
        "gates_quat": quat,
        "gates_visited": np.zeros(4, bool),
        "obstacles_pos": np.array(poles),
        "obstacles_visited": np.zeros(4, bool),
        "n_gates_passed": np.array(0),
    }


def test_a_plan_knows_the_slope_of_its_cost(planning):
    route, _ = planning
    obs = told()
    gates = route.gates_of(obs)
    keys = "gates_pos", "gates_quat", "obstacles_pos", "gates_visited", "obstacles_visited"
    bars = route.bars(*(obs[key] for key in keys))
    start = np.array([[-1.5, 0.75, 0.2], [0.0, 0.0, 1.0], [0.0, 0.0, 4.0]])
    guess = route.first_guess(start, gates, 0.35, 0.0)
    plan = route.Plan(gates, route.Walls(*bars), route.Limits(), 0.4, guess)
    plan.improve(30)
    x, step = plan._x.copy(), 1e-6
    _, slope = plan._cost(x)
    for k in range(len(x)):
        there = np.zeros(len(x))
        there[k] = step
        steep = (plan._cost(x + there)[0] - plan._cost(x - there)[0]) / (2 * step)
        assert slope[k] == pytest.approx(steep, rel=1e-4, abs=1e-4)


def test_distances_to_walls_are_those_to_the_nearest_place_of_each(planning):
    route, _ = planning
    start = np.array([[0.0, 0.0, 0.0]])
    walls = route.Walls(start, start + [0.0, 0.0, 1.0], np.array([0.1]))
    points = np.array([[0.2, 0.0, 0.5], [0.0, 0.0, 1.3], [1.0, 0.0, 0.0]])
    cost, push = walls.push(points, 0.25)
    assert cost == pytest.approx([0.15**2, 0.05**2, 0.0])
    assert push[0] == pytest.approx([-0.3, 0.0, 0.0])
    assert push[1] == pytest.approx([0.0, 0.0, -0.1])


def test_what_turns_out_elsewhere_is_flown_to_smoothly(planning, monkeypatch):
    """No step plans longer than its share, and the reference never jumps."""
    route, pilot = planning
    looked = []
    cost = route.Plan._cost
    monkeypatch.setattr(route.Plan, "_cost", lambda plan, x: looked.append(1) or cost(plan, x))
    obs = told()
    navigator = pilot.Navigator(obs, PERIOD)
    first = obs["gates_pos"][0].copy()
    before, most, jump = None, 0, 0.0
    t = 0.0
    while t < navigator.route.gate_times[1] - 0.1:
        if before is not None and np.hypot(*(before[0][:2] - first[:2])) < 0.7:
            obs["gates_visited"][0] = True
            obs["gates_pos"][0] = first + [0.1, -0.12, 0.08]
        if before is not None and not obs["n_gates_passed"] and before[0][0] > first[0] + 0.15:
            obs["n_gates_passed"] = np.array(1)
        looked.clear()
        navigator.look(obs, t)
        most = max(most, len(looked))
        now = navigator.reference(t)
        if before is not None and t > pilot.TAKE_OFF + PERIOD:
            steps = PERIOD * (before[1] + now[1]) / 2
            jump = max(jump, float(np.abs(now[0] - before[0] - steps).max()))
        before, t = now, t + PERIOD
    assert most <= pilot.A_STEP + 4
    assert jump < 2e-3
    # It went through where the gate really was.
    assert obs["n_gates_passed"] == 1
    assert navigator.route.gate_times


@pytest.mark.parametrize("across", [-0.12, -0.05, 0.05, 0.12])
def test_a_gate_with_a_pole_in_it_is_passed_beside_the_pole(planning, across):
    route, _ = planning
    obs = told()
    gate = obs["gates_pos"][0]
    axes = route.Rotation.from_quat(obs["gates_quat"][0]).as_matrix()
    obs["obstacles_pos"][0] = [*(gate + across * axes[:, 1])[:2], 1.55]
    offset = route.gates_of(obs)[0].centre - gate
    aside = offset @ axes[:, 1]
    assert np.abs(offset - aside * axes[:, 1]).max() < 1e-9
    assert aside * across < 0.0
    assert abs(aside) <= 0.1
    # As far from the pole as from the frame, or nearly.
    assert abs(aside - across) > 0.1
    # Elsewhere the middle is taken.
    obs["obstacles_pos"][0] = [0.0, 0.75, 1.55]
    assert route.gates_of(obs)[0].centre == pytest.approx(gate)


def test_it_stands_still_before_what_no_plan_leads_round(planning):
    """The gate turns out to be full of poles: nothing is touched, and the reference never jumps."""
    route, pilot = planning
    obs = told()
    obs["obstacles_pos"] = np.vstack([obs["obstacles_pos"], np.full((5, 3), [9.0, 9.0, 1.55])])
    obs["obstacles_visited"] = np.zeros(9, bool)
    navigator = pilot.Navigator(obs, PERIOD, 0.1)
    gate = obs["gates_pos"][0]
    axes = route.Rotation.from_quat(obs["gates_quat"][0]).as_matrix()
    fence = [gate + (0.1 * k - 0.2) * axes[:, 1] for k in range(5)]
    before, jump, near, t, stood = None, 0.0, 9.0, 0.0, None
    while t < 6.0 and stood is None:
        if before is not None and np.hypot(*(before[0] - gate)[:2]) < 0.7:
            obs["gates_visited"][0] = True
            obs["obstacles_visited"][4:] = True
            obs["obstacles_pos"][4:, :2] = np.array(fence)[:, :2]
        if before is not None:
            obs["pos"], obs["vel"] = before[0], before[1]
        navigator.look(obs, t)
        now = navigator.reference(t)
        if before is not None and t > pilot.TAKE_OFF + PERIOD:
            steps = PERIOD * (before[1] + now[1]) / 2
            jump = max(jump, float(np.abs(now[0] - before[0] - steps).max()))
            near = min(near, *(float(np.hypot(*(now[0] - pole)[:2])) for pole in fence))
        if navigator.rest is not None and np.linalg.norm(now[1]) < 0.01:
            stood = t
        before, t = now, t + PERIOD
    assert stood is not None
    assert near > 0.1 + 0.015
    assert jump < 3e-3


def test_speed_alone_does_not_make_a_way_unsound(planning):
    """Only what is too close, or too sharp a turn, has another way looked for."""
    route, _ = planning
    obs = told()
    obs["obstacles_pos"] = np.full((1, 3), [0.0, 0.0, 9.0])
    obs["obstacles_visited"] = np.ones(1, bool)
    gates = route.gates_of(obs)[:1]
    walls = route.Walls(np.array([[9.0, 9, 9]]), np.array([[9.0, 9, 8]]), np.zeros(1))
    start = np.array([[-1.5, 0.75, 0.7], [2.0, -0.5, 0.0], [0.0, 0.0, 0.0]])
    guess = route.first_guess(start, gates, 0.35, 0.0)
    slow = np.ones(2, bool)
    free, strict = (
        route.Plan(gates, walls, route.Limits(), 0.4, guess, None, which) for which in (None, slow)
    )
    assert strict.cost > free.cost + 1.0
    assert strict.excess == pytest.approx(free.excess)
    strict.improve(300)
    free.improve(300)
    assert strict.route.end > free.route.end
