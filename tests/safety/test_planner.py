"""The gate's idea of the vehicle's planner, held against the firmware's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyarena.safety.planner import Flown, Motion, Planner, to_rest, uploaded
from crazyarena.sim_backend.firmware import high_level
from crazyarena.sim_backend.firmware import layout as la

MEMORY_SIZE = 4096


class Firmware:
    """The high-level commander alone."""

    def __init__(self, position=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0)):
        self.mem = high_level.new_memory(2026)
        self.memory = np.zeros(MEMORY_SIZE, np.uint8)
        self.state = np.zeros(la.STATE_SIZE)
        self.state[la.ST_POS : la.ST_POS + 3] = position
        self.state[la.ST_VEL : la.ST_VEL + 3] = velocity
        self.at(0.0)

    def at(self, t):
        row = np.zeros(la.SETPOINT_SIZE)
        high_level.get_setpoint(self.mem, self.memory, t, self.state, row)
        return row[la.SP_POS : la.SP_POS + 3], row[la.SP_VEL : la.SP_VEL + 3]

    def go_to(self, x, y, z, duration, t, relative=False):
        high_level.go_to(self.mem, self.memory, x, y, z, 0.0, duration, relative, False, t)

    def upload(self, ident, offset, pieces):
        data = np.frombuffer(np.roll(pieces, -1, axis=1).astype("<f4").tobytes(), np.uint8)
        self.memory[132 * offset : 132 * offset + len(data)] = data
        high_level.define_trajectory(self.mem, ident, 0, 132 * offset, len(pieces))


number = st.floats(-2.0, 2.0)
point = st.tuples(number, number, number)


@settings(max_examples=60, deadline=None)
@given(point, point, point, point, st.floats(0.3, 5.0), st.floats(0.05, 1.0), st.booleans())
def test_go_to_in_the_middle_of_another(place, speed, first, second, duration, share, relative):
    firmware = Firmware(place, speed)
    planner = Planner()
    origin = planner.origin(0.0, Motion(place, speed))
    planner.follow(to_rest(origin, first, duration), 0.0)
    firmware.go_to(*first, duration, 0.0)
    then = share * duration
    origin = planner.origin(then, Motion(place, speed))
    assert firmware.at(then)[0] == pytest.approx(origin.position, abs=1e-4)
    goal = tuple(np.add(second, origin.position)) if relative else second
    planner.follow(to_rest(origin, goal, duration), then)
    firmware.go_to(*second, duration, then, relative)
    for later in (0.0, 0.3 * duration, duration, 2.0 * duration):
        position, velocity = firmware.at(then + later)
        found = planner.origin(then + later, None)
        assert position == pytest.approx(found.position, abs=1e-3)
        assert velocity == pytest.approx(found.velocity, abs=1e-2)


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("scale", [0.5, 1.0, 3.0])
def test_trajectories_as_the_firmware_flies_them(reverse, relative, scale):
    rng = np.random.default_rng(3)
    pieces = np.zeros((3, 33))
    pieces[:, 0] = (1.0, 0.5, 2.0)
    pieces[:, 1:25] = rng.normal(0, 1, (3, 24)) / 2.0 ** np.tile(np.arange(8), 3)
    firmware = Firmware((0.5, 0.2, 1.0))
    firmware.upload(4, 7, pieces)
    high_level.start_trajectory(
        firmware.mem, firmware.memory, 4, scale, relative, False, reverse, 0.0
    )
    plan = uploaded(pieces.astype(np.float32).astype(float), scale, reverse)
    if relative:
        plan = plan.moved(np.array([0.5, 0.2, 1.0]) - np.array(plan.at(0.0).position))
    for t in np.linspace(0.01, plan.duration - 0.01, 37):
        position, velocity = firmware.at(t)
        assert position == pytest.approx(plan.at(t).position, abs=2e-3)
        assert velocity == pytest.approx(plan.at(t).velocity, abs=2e-2)


def test_what_it_follows():
    planner = Planner()
    seen = Motion((1.0, 1.0, 1.0), (0.5, 0.0, 0.0))
    assert planner.origin(0.0, None) is None
    assert planner.origin(0.0, seen) == seen
    down = to_rest(Motion((1.0, 1.0, 1.0)), (1.0, 1.0, 0.0), 2.0)
    planner.follow(down, 0.0, landing=True, slots=range(2, 5))
    assert planner.last_known(1.0, seen) == pytest.approx((1.0, 1.0, 0.5))
    assert planner.last_known(2.0, seen) == seen.position  # idle again, once it is down
    assert planner.flown is Flown.NOTHING
    assert planner.slots == range(0)
    planner.stream()
    assert planner.flown is Flown.STREAM
    assert planner.origin(3.0, seen) == seen


@given(st.lists(st.floats(-2.0, 2.0), min_size=9, max_size=9), st.floats(0.3, 4.0))
def test_jerk_is_how_the_acceleration_changes(numbers, duration):
    begin = Motion(tuple(numbers[:3]), tuple(numbers[3:6]))
    plan = to_rest(begin, tuple(numbers[6:]), duration)
    jerks = plan.jerks(9, 10.0)
    assert jerks.shape == (9, 3)
    h = 1e-5 * duration
    for time, jerk in zip(np.linspace(0.0, duration, 9)[1:-1], jerks[1:-1], strict=True):
        before, after = (np.array(plan.at(time + s * h).acceleration) for s in (-1, 1))
        np.testing.assert_allclose(
            jerk, (after - before) / (2 * h), atol=1e-3 * np.abs(jerks).max() + 1e-6
        )
