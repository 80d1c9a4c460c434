"""The high-level commander: what must hold for every plan, and its answers."""

from __future__ import annotations

import itertools
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyarena.sim_backend.firmware import high_level as hl
from crazyarena.sim_backend.firmware.layout import (
    SETPOINT_SIZE,
    SP_ACC,
    SP_ATT,
    SP_POS,
    SP_RATE,
    SP_VEL,
    ST_ATT,
    ST_POS,
    STATE_SIZE,
)
from crazyarena.sim_backend.firmware.parameters import default_row
from crazyarena.sim_backend.firmware.planner import (
    FLYING,
    IDLE,
    LANDING,
    PL_STATE,
    TRAJECTORY_MEMORY_SIZE,
    is_finished,
)

generations = pytest.mark.parametrize("generation", [2022, 2026])
coordinate = st.floats(-3.0, 3.0, width=32)
angle = st.floats(-10.0, 10.0, width=32)


class Vehicle:
    def __init__(self, generation: int = 2026) -> None:
        self.mem = hl.new_memory(generation)
        self.params = default_row(hl.PARAMS, generation)
        self.memory = np.zeros(TRAJECTORY_MEMORY_SIZE, dtype=np.uint8)
        self.state = np.zeros(STATE_SIZE)
        self.sp = np.zeros(SETPOINT_SIZE)

    def setpoint(self, t: float) -> np.ndarray:
        self.result = hl.get_setpoint(self.mem, self.memory, t, self.state, self.sp)
        return self.sp.copy()

    def fly(self, t: float = 0.0) -> None:
        assert hl.takeoff(self.mem, 1.0, 1.0, 0.0, True, t) == hl.OK
        self.setpoint(t + 1.5)

    def go_to(self, goal, t, *, yaw=0.0, duration=2.0, relative=False, linear=False):
        return hl.go_to(self.mem, self.memory, *goal, yaw, duration, relative, linear, t)

    def start(self, t, *, scale=1.0, relative=False, turned=False, reverse=False, id=0):
        return hl.start_trajectory(self.mem, self.memory, id, scale, relative, turned, reverse, t)

    def upload(self, data: bytes, offset: int = 0) -> None:
        self.memory[offset : offset + len(data)] = np.frombuffer(data, dtype=np.uint8)


def _wiggle(pieces: int, seed: int) -> np.ndarray:
    """Random pieces (n, 33): x, y, z, yaw coefficients and a duration of about a second."""
    rng = np.random.default_rng(seed)
    trajectory = 0.3 * rng.normal(size=(pieces, 33))
    trajectory[:, 32] = rng.uniform(0.6, 1.4, size=pieces)
    return trajectory.astype("<f4")


def _with_trajectory(trajectory: np.ndarray, generation: int = 2026) -> Vehicle:
    vehicle = Vehicle(generation)
    vehicle.upload(trajectory.tobytes())
    assert hl.define_trajectory(vehicle.mem, 0, hl.TYPE_POLYNOMIAL, 0, len(trajectory)) == hl.OK
    return vehicle


@generations
@given(goal=st.tuples(coordinate, coordinate, coordinate), replan=st.floats(0.1, 1.9))
def test_go_to_continues_the_running_plan_and_stops_at_the_goal(generation, goal, replan):
    vehicle = Vehicle(generation)
    vehicle.fly()
    vehicle.go_to((1.0, -1.0, 1.5), 2.0, yaw=1.0)
    t = 2.0 + replan
    before = vehicle.setpoint(t)
    assert vehicle.go_to(goal, t, duration=1.5) == hl.OK
    after = vehicle.setpoint(t)
    np.testing.assert_allclose(after[: SP_ACC + 3], before[: SP_ACC + 3], atol=1e-6)
    np.testing.assert_allclose(after[SP_ATT + 2], before[SP_ATT + 2], atol=1e-6)
    for later in (t + 1.51, t + 100.0):
        end = vehicle.setpoint(later)
        np.testing.assert_allclose(end[SP_POS : SP_POS + 3], goal, atol=1e-6)
        assert not end[SP_VEL : SP_ACC + 3].any()
        assert not end[SP_RATE : SP_RATE + 3].any()


@given(first=angle, second=angle)
def test_yaw_turns_the_short_way_in_2026_only(first, second):
    ends = {}
    for generation in (2022, 2026):
        vehicle = Vehicle(generation)
        vehicle.fly()
        vehicle.go_to((0.0, 0.0, 1.0), 2.0, yaw=first, duration=1.0)
        vehicle.setpoint(3.5)
        vehicle.go_to((0.0, 0.0, 1.0), 4.0, yaw=second, duration=1.0)
        ends[generation] = [np.radians(vehicle.setpoint(t)[SP_ATT + 2]) for t in (4.0, 5.5)]
    np.testing.assert_allclose(ends[2022], [first, second], atol=1e-9)
    # The new plan may count the same heading from another turn.
    for got, wanted in zip(ends[2026], (first, second), strict=True):
        np.testing.assert_allclose(np.exp(1j * got), np.exp(1j * wanted), atol=1e-6)
    assert abs(ends[2026][1] - ends[2026][0]) <= np.pi + 1e-6


@settings(max_examples=40)
@given(
    seed=st.integers(0, 10_000),
    scale=st.floats(0.25, 3.0, width=32),
    piece=st.integers(0, 3),
    u=st.floats(0.02, 0.98),
)
def test_timescale_stretches_time(seed, scale, piece, u):
    trajectory = _wiggle(3, seed)
    plain, stretched = _with_trajectory(trajectory), _with_trajectory(trajectory)
    plain.start(0.0)
    stretched.start(0.0, scale=scale)
    # Inside a piece, where rounding cannot choose another one; piece 3 is past the end.
    durations = [*trajectory[:, 32].astype(float), 1.0]
    t = sum(durations[:piece]) + durations[piece] * u
    a, b = plain.setpoint(t), stretched.setpoint(t * scale)
    tolerance = {"atol": 1e-4, "rtol": 1e-4}
    np.testing.assert_allclose(b[SP_POS : SP_POS + 3], a[SP_POS : SP_POS + 3], **tolerance)
    np.testing.assert_allclose(b[SP_VEL : SP_VEL + 3] * scale, a[SP_VEL : SP_VEL + 3], **tolerance)
    np.testing.assert_allclose(
        b[SP_ACC : SP_ACC + 3] * scale**2, a[SP_ACC : SP_ACC + 3], **tolerance
    )


@settings(max_examples=40)
@given(seed=st.integers(0, 10_000), piece=st.integers(0, 2), u=st.floats(0.02, 0.98))
def test_reversed_flies_the_same_path_backwards(seed, piece, u):
    trajectory = _wiggle(3, seed)
    forward, backward = _with_trajectory(trajectory), _with_trajectory(trajectory)
    forward.start(0.0)
    backward.start(0.0, reverse=True)
    durations = trajectory[:, 32].astype(float)
    t = durations[:piece].sum() + durations[piece] * u
    a, b = forward.setpoint(t), backward.setpoint(durations.sum() - t)
    np.testing.assert_allclose(b[SP_POS : SP_POS + 3], a[SP_POS : SP_POS + 3], atol=1e-4)
    np.testing.assert_allclose(b[SP_VEL : SP_VEL + 3], -a[SP_VEL : SP_VEL + 3], atol=1e-4)
    np.testing.assert_allclose(b[SP_ACC : SP_ACC + 3], a[SP_ACC : SP_ACC + 3], atol=1e-3)
    end = backward.setpoint(durations.sum() + 1.0)
    np.testing.assert_allclose(end[SP_POS : SP_POS + 3], trajectory[0, [0, 8, 16]], atol=1e-6)


@given(seed=st.integers(0, 10_000), reverse=st.booleans())
def test_relative_trajectory_begins_where_the_vehicle_is(seed, reverse):
    vehicle = _with_trajectory(_wiggle(2, seed))
    vehicle.fly()
    vehicle.go_to((1.0, 2.0, 1.5), 2.0, duration=1.0)
    here = vehicle.setpoint(4.0)
    vehicle.start(4.0, relative=True, reverse=reverse)
    np.testing.assert_allclose(vehicle.setpoint(4.0)[:3], here[:3], atol=1e-6)


def test_time_may_run_backwards_over_piece_borders():
    vehicle = _with_trajectory(_wiggle(4, 5))
    vehicle.start(0.0)
    times = np.linspace(0.03, 4.5, 40)
    upward = [vehicle.setpoint(t) for t in times]
    downward = [vehicle.setpoint(t) for t in times[::-1]][::-1]
    np.testing.assert_allclose(downward, upward, atol=1e-5)


def _de_casteljau(points: list[float], u: float) -> float:
    while len(points) > 1:
        points = [(1.0 - u) * a + u * b for a, b in itertools.pairwise(points)]
    return points[0]


@settings(max_examples=60)
@given(
    start=st.lists(st.integers(-2000, 2000), min_size=4, max_size=4),
    segments=st.lists(
        st.tuples(st.lists(st.integers(0, 3), min_size=4, max_size=4), st.integers(100, 3000)),
        min_size=1,
        max_size=5,
    ),
    seed=st.integers(0, 10_000),
    u=st.floats(0.01, 0.99),
)
def test_compressed_trajectory_is_a_chain_of_bezier_curves(start, segments, seed, u):
    rng = np.random.default_rng(seed)
    data = struct.pack("<hhhh", *start)
    chains, last = [], list(start)
    for kinds, milliseconds in segments:
        further = [rng.integers(-2000, 2000, size=(1 << kind) - 1).tolist() for kind in kinds]
        types = sum(kind << (2 * axis) for axis, kind in enumerate(kinds))
        data += struct.pack("<BH", types, milliseconds)
        data += b"".join(struct.pack(f"<{len(x)}h", *x) for x in further)
        chains.append([[a, *b] for a, b in zip(last, further, strict=True)])
        last = [chain[-1] for chain in chains[-1]]
    vehicle = Vehicle()
    vehicle.upload(data + bytes(3), offset=77)
    assert hl.define_trajectory(vehicle.mem, 4, hl.TYPE_COMPRESSED, 77, 0) == hl.OK
    assert vehicle.start(0.0, id=4) == hl.OK
    t = 0.0
    for chain, (_, milliseconds) in zip(chains, segments, strict=True):
        sp = vehicle.setpoint(t + u * milliseconds / 1000.0)
        expected = [_de_casteljau(list(points), u) for points in chain]
        np.testing.assert_allclose(sp[:3] * 1000.0, expected[:3], atol=0.2)
        np.testing.assert_allclose(sp[SP_ATT + 2] * 10.0, expected[3], atol=0.2)
        t += milliseconds / 1000.0
    sp = vehicle.setpoint(t + 1.0)
    np.testing.assert_allclose(sp[:3] * 1000.0, last[:3], atol=1e-6)
    assert not sp[SP_VEL : SP_ACC + 3].any()
    assert is_finished(vehicle.mem, vehicle.memory, t + 1.0)


def test_compressed_trajectory_without_end_stops_at_the_end_of_memory():
    vehicle = Vehicle()
    # Segments that stand still for 1 ms each, to the last byte.
    vehicle.memory[:8] = np.frombuffer(struct.pack("<hhhh", 100, 200, 300, 0), dtype=np.uint8)
    vehicle.memory[9::3] = 1
    hl.define_trajectory(vehicle.mem, 0, hl.TYPE_COMPRESSED, 0, 0)
    vehicle.start(0.0)
    np.testing.assert_allclose(vehicle.setpoint(60.0)[:3], [0.1, 0.2, 0.3])
    assert is_finished(vehicle.mem, vehicle.memory, 60.0)


@generations
def test_states_and_answers(generation):
    vehicle = Vehicle(generation)
    mem = vehicle.mem
    assert hl.is_stopped(mem)
    vehicle.fly()
    assert mem[PL_STATE] == FLYING
    assert hl.takeoff(mem, 2.0, 1.0, 0.0, True, 2.0) == hl.REFUSED
    assert hl.land(mem, 0.0, 1.0, 0.0, True, 3.0) == hl.OK
    assert mem[PL_STATE] == LANDING
    assert hl.land(mem, 0.0, 1.0, 0.0, True, 3.5) == hl.REFUSED
    vehicle.setpoint(3.9)
    assert not is_finished(mem, vehicle.memory, 3.9)
    sp = vehicle.setpoint(4.1)
    assert mem[PL_STATE] == IDLE
    assert is_finished(mem, vehicle.memory, 4.1)
    if generation == 2022:
        assert vehicle.result == hl.SETPOINT_TRAJECTORY
        np.testing.assert_allclose(sp[:3], 0.0, atol=1e-9)
        np.testing.assert_array_equal(vehicle.setpoint(5.0), sp)
        assert vehicle.result == hl.SETPOINT_UNTOUCHED
    else:
        assert vehicle.result == hl.SETPOINT_NULL
        assert not sp.any()


@generations
@given(height=st.floats(0.1, 3.0), speed=st.floats(-1.0, 2.0), relative=st.booleans())
def test_takeoff_with_velocity_takes_distance_over_velocity(generation, height, speed, relative):
    vehicle = Vehicle(generation)
    vehicle.state[ST_POS : ST_POS + 3] = (0.3, 0.4, 0.5)
    hl.tell_state(vehicle.mem, vehicle.state)
    vehicle.params[hl.P_TAKEOFF_SPEED] = 0.25
    target = 0.5 + height if relative else height
    duration = abs(target - 0.5) / (speed if speed > 0.0 else 0.25)
    if not 0.05 < duration < 1000.0:
        return
    hl.takeoff_with_velocity(vehicle.mem, vehicle.params, height, relative, speed, 0.0, True, 0.0)
    assert not is_finished(vehicle.mem, vehicle.memory, 0.999 * duration)
    assert is_finished(vehicle.mem, vehicle.memory, 1.001 * duration)
    sp = vehicle.setpoint(1.001 * duration)
    np.testing.assert_allclose(sp[:3], (0.3, 0.4, target), atol=1e-6)


@generations
def test_trajectory_definitions_are_checked(generation):
    mem = hl.new_memory(generation)
    last = 9 if generation == 2022 else 30
    assert hl.define_trajectory(mem, last, hl.TYPE_POLYNOMIAL, 0, 31) == hl.OK
    assert hl.define_trajectory(mem, last + 1, hl.TYPE_POLYNOMIAL, 0, 1) == hl.ENOEXEC
    assert hl.define_trajectory(mem, 0, hl.TYPE_POLYNOMIAL, 5, 31) == hl.ENOEXEC
    assert hl.define_trajectory(mem, 0, hl.TYPE_POLYNOMIAL, 0, 0) == hl.ENOEXEC
    assert hl.define_trajectory(mem, 0, 7, 0, 1) == hl.ENOEXEC
    assert hl.define_trajectory(mem, 0, hl.TYPE_COMPRESSED, 4095, 1) == hl.ENOEXEC


def test_an_undefined_trajectory_is_ignored_and_a_bad_timescale_refused():
    vehicle = _with_trajectory(_wiggle(1, 1))
    vehicle.fly()
    for unknown in (1, 30, 200):
        assert vehicle.start(2.0, id=unknown) == hl.OK
    np.testing.assert_allclose(vehicle.setpoint(2.5)[:3], (0.0, 0.0, 1.0), atol=1e-6)
    for scale in (0.0, -1.0, np.nan, np.inf):
        assert vehicle.start(2.0, scale=scale) == hl.ENOEXEC


def test_blocking_ends_the_plan_and_refuses_motion():
    vehicle = _with_trajectory(_wiggle(1, 1))
    vehicle.fly()
    hl.block(vehicle.mem, True)
    vehicle.setpoint(2.0)
    assert vehicle.result == hl.SETPOINT_NULL
    assert hl.takeoff(vehicle.mem, 1.0, 1.0, 0.0, True, 2.0) == hl.EBUSY
    assert hl.land(vehicle.mem, 0.0, 1.0, 0.0, True, 2.0) == hl.EBUSY
    assert vehicle.go_to((0.0, 0.0, 1.0), 2.0) == hl.EBUSY
    assert vehicle.start(2.0) == hl.EBUSY
    assert hl.spiral(vehicle.mem, False, False, 1.0, 1.0, 1.0, 0.0, 2.0, 2.0) == hl.EBUSY
    assert hl.stop(vehicle.mem) == hl.OK
    hl.block(vehicle.mem, False)
    assert hl.takeoff(vehicle.mem, 1.0, 1.0, 0.0, True, 3.0) == hl.OK


@given(mask=st.integers(0, 255), group=st.integers(0, 255))
def test_groups(mask, group):
    vehicle = Vehicle()
    hl.set_group_mask(vehicle.params, mask)
    assert hl.in_group(vehicle.params, group) == (group == 0 or bool(mask & group))


@given(
    angle=st.floats(-6.0, 6.0), r0=st.floats(0.1, 1.0), r1=st.floats(0.1, 1.0), way=st.booleans()
)
def test_spiral_turns_by_its_angle_about_one_centre(angle, r0, r1, way):
    vehicle = Vehicle()
    vehicle.state[ST_ATT + 2] = 30.0
    hl.tell_state(vehicle.mem, vehicle.state)
    hl.spiral(vehicle.mem, False, way, angle, r0, r1, 0.5, 3.0, 0.0)
    start, end = vehicle.setpoint(0.0), vehicle.setpoint(3.0)
    turned = np.radians(end[SP_ATT + 2] - start[SP_ATT + 2])
    np.testing.assert_allclose(turned, -angle if way else angle, atol=1e-6)
    # Clockwise the centre is to the right, otherwise to the left.
    side = -1.0 if way else 1.0

    def centre(sp: np.ndarray, radius: float) -> np.ndarray:
        yaw = np.radians(sp[SP_ATT + 2])
        return sp[:2] + side * radius * np.array([-np.sin(yaw), np.cos(yaw)])

    np.testing.assert_allclose(centre(start, r0), centre(end, r1), atol=1e-5)
    np.testing.assert_allclose(end[2] - start[2], 0.5, atol=1e-6)


def test_unknown_generation():
    with pytest.raises(ValueError, match="2021"):
        hl.new_memory(2021)
