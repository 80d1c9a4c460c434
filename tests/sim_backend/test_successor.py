"""lsy_drone_racing's simulation: against recorded flights of it, contacts against a point cloud."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from crazyarena.errors import InputError
from crazyarena.levels.lsy import load_lsy_level
from crazyarena.levels.lsy.draw import LsyRandom
from crazyarena.sim_backend.physics import successor_scene as scene
from crazyarena.sim_backend.physics.successor_plant import SS_ROTOR
from crazyarena.sim_backend.successor import SuccessorWorld, nominal
from crazyarena.sim_backend.successor_models import load_params, model
from crazyarena.sim_backend.trace import TR_CONTACT, TR_POS, TR_SETPOINT

FLIGHTS = json.loads((Path(__file__).parent / "successor_flights.json").read_text())


def world_of(*overrides, level="lsy/level0", seed=3):
    chosen = load_lsy_level(level, overrides)
    world = SuccessorWorld(chosen)
    return world, LsyRandom(chosen, nominal(chosen), seed).reset()


@pytest.mark.parametrize("name", [name for name in FLIGHTS if name != "source"])
def test_flights_are_those_of_the_original(name):
    drone, mode = name.split()
    flight = FLIGHTS[name]
    world, draw = world_of(
        f"sim.drone_model={drone}", f"env.control_mode={mode}", "env.disturbances={}"
    )
    draw.start[:] = flight["start"]
    draw.gates = draw.gates[:0]
    draw.obstacles = draw.obstacles[:0]
    world.reset(draw)
    world._vehicle[SS_ROTOR : SS_ROTOR + 4] = flight["rotor"]
    states = []
    for command in flight["commands"]:
        world.step(np.array(command))
        states.append(world.state)
    error = np.abs(np.array(states[5::6]) - np.array(flight["states"])).max(axis=0)
    # It computes in single precision.
    assert error[:10].max() < 1e-5
    assert error[10:].max() < 1e-4


def test_the_published_state_example_takes_as_long_as_there():
    """Its waypoints, positions only: the last gate is passed in the step that ends at 13.86 s."""
    points = [
        [-1.5, 0.75, 0.05], [-1.0, 0.55, 0.4], [0.3, 0.35, 0.7], [1.3, -0.15, 0.9],
        [0.85, 0.85, 1.2], [-0.5, -0.05, 0.7], [-1.2, -0.2, 0.8], [-1.2, -0.2, 1.2],
        [0.0, -0.7, 1.2], [0.5, -0.75, 1.2],
    ]  # fmt: skip
    world, draw = world_of()
    world.reset(draw)
    path = CubicSpline(np.linspace(0, 15, len(points)), points)
    before, passed = 0.0, None
    for step in range(720):
        rows = world.step(np.concatenate([path(step / 50), np.zeros(10)]))
        assert (rows[:, TR_CONTACT] == scene.NO_CONTACT).all()
        x = rows[-1, TR_POS]
        if step > 600 and before < 0.0 < x:
            passed = (step + 1) / 50
        before = x
    assert passed == pytest.approx(13.86, abs=0.02)


def test_attitudes_are_traced_as_no_place():
    world, draw = world_of("env.control_mode=attitude")
    world.reset(draw)
    rows = world.step(np.array([0.1, -0.2, 0.3, 0.4]))
    assert np.isnan(rows[:, TR_SETPOINT : TR_SETPOINT + 10]).all()
    world, draw = world_of("env.disturbances={}")
    world.reset(draw)
    rows = world.step(np.arange(13.0))
    np.testing.assert_array_equal(rows[-1, TR_SETPOINT : TR_SETPOINT + 10], np.arange(10.0))


def test_motors_off_stay_on_the_floor_and_nothing_breaks_what_it_is_told():
    world, draw = world_of("env.control_mode=attitude", "env.disturbances={}")
    world.reset(draw)
    for _ in range(50):
        world.step(np.zeros(4))
    assert world.state[2] == pytest.approx(-0.001, abs=1e-6)
    for command in ([9, -9, 9, 1e9], [0, 0, 0, -5], [1e300, 0, 0, 0.4]):
        world.step(np.array(command, float))
        assert np.isfinite(world.state).all()
    state, draw = world_of("env.disturbances={}")
    state.reset(draw)
    state.step(np.zeros(13))
    free_fall = np.zeros(13)
    free_fall[:3] = state.state[:3]
    free_fall[8] = -9.81
    for _ in range(5):
        state.step(free_fall)
        assert np.isfinite(state.state).all()


def cloud(half, count=9):
    axes = [np.linspace(-h, h, count) for h in half]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)


angles = st.floats(-3.2, 3.2)
near = st.floats(-0.6, 0.6)


@settings(max_examples=300)
@given(st.tuples(near, near, near), st.tuples(angles, angles, angles), st.tuples(angles, angles))
def test_box_contacts_agree_with_a_cloud_of_points(offset, turn, tilt):
    """A point of one box in the other means contact; a plane between all corners means none."""
    rotation = Rotation.from_euler("xyz", [0.1 * tilt[0], 0.1 * tilt[1], 0.7])
    gate = np.array([[0.3, -0.2, 1.0, *rotation.as_quat()]])
    solids = scene.build_solids(gate, np.zeros((0, 3)))
    place = np.array([0.3, -0.2, 1.0]) + offset
    body = Rotation.from_euler("xyz", turn)
    drone = np.zeros(scene.SOLID_SIZE)
    scene.place_drone(drone, *place, *body.as_quat())
    found = scene.touched(solids, drone) == 0.0
    points = place + body.apply(cloud(scene.DRONE_HALF))
    inside = False
    for centre, half in scene.gate_boxes():
        local = rotation.inv().apply(points - gate[0, :3]) - centre
        inside |= bool((np.abs(local) < np.array(half) - 1e-9).all(axis=1).any())
        box = gate[0, :3] + rotation.apply(cloud(half) + centre)
        back = body.inv().apply(box - place)
        inside |= bool((np.abs(back) < np.array(scene.DRONE_HALF) - 1e-9).all(axis=1).any())
    if inside:
        assert found
    if found and not inside:
        # Edges may cross between the points of both clouds: then they are close at least.
        assert _gap(points, gate[0], rotation) < 0.05


def _gap(points, gate, rotation):
    local = rotation.inv().apply(points - gate[:3])
    gaps = []
    for centre, half in scene.gate_boxes():
        out = np.maximum(np.abs(local - centre) - half, 0.0)
        gaps.append(np.linalg.norm(out, axis=1).min())
    return min(gaps)


@pytest.mark.parametrize(
    ("place", "code"),
    [
        ((0.0, 0.0, 1.2), -1.0),  # in the middle of the opening
        ((0.0, 0.12, 1.2), -1.0),
        ((0.0, 0.14, 1.2), 0.0),  # a corner at 0.21 is in the frame
        ((0.0, 0.0, 1.39), 0.0),
        ((0.09, 0.0, 1.5), -1.0),  # before the frame
        ((0.07, 0.0, 1.5), 0.0),
        ((0.0, 0.0, 0.5), 0.0),  # the stand
        ((0.0, 0.4, 0.5), -1.0),
        ((1.0, 0.0, 1.0), 1.0),  # a pole
        ((1.0, 0.086, 1.0), -1.0),
        ((1.0, 0.084, 1.0), 1.0),
        ((1.0, 0.0, 1.58), 1.0),  # its cap
        ((1.0, 0.0, 1.59), -1.0),
    ],
)
def test_sizes_of_gates_and_poles(place, code):
    gate = np.array([[0.0, 0.0, 1.2, 0, 0, 0, 1]])
    solids = scene.build_solids(gate, np.array([[1.0, 0.0, 1.55]]))
    drone = np.zeros(scene.SOLID_SIZE)
    scene.place_drone(drone, *place, 0.0, 0.0, 0.0, 1.0)
    assert scene.touched(solids, drone) == code


def test_parameters_are_the_published_ones():
    params = load_params("first_principles", "cf21B_500")
    assert params["mass"] == 0.04338
    assert params["thrust_max"] == 0.2
    np.testing.assert_allclose(params["J"] @ params["J_inv"], np.eye(3), atol=1e-12)
    assert params["gravity_vec"][2] == -9.81
    assert params["mixing_matrix"].shape == (3, 4)
    assert load_params("so_rpy", "cf2x_T350")["cmd_f_coef"] == 0.86214912
    with pytest.raises(KeyError):
        load_params("so_rpy", "cf3")
    with pytest.raises(KeyError):
        load_params("magic", "cf2x_L250")
    with pytest.raises(InputError, match="cf2x_P250"):
        model("cf3")
    weights = {m: model(m) for m in ("cf21B_500", "cf2x_L250", "cf2x_P250", "cf2x_T350")}
    for name, ratio in zip(weights, (1.88, 1.53, 1.54, 1.94), strict=True):
        m = weights[name]
        assert 4 * m.thrust_max / (m.mass * 9.81) == pytest.approx(ratio, abs=0.006)
