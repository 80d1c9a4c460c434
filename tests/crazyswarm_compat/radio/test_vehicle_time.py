"""What comes late was not made late."""

import random

import pytest

from crazyarena.crazyswarm_compat.radio.vehicle_time import VehicleTime


@pytest.mark.parametrize("drift", [0.0, 5e-5, -5e-5])
@pytest.mark.parametrize("first", [0, 5000, (1 << 24) - 700])
def test_delays_of_a_busy_computer_move_nothing(drift, first):
    rng, time = random.Random(3), VehicleTime()
    for k in range(3000):
        made = 100.0 + 0.02 * k * (1.0 + drift)
        delay = 0.004 + rng.choice((0.0, 0.0, rng.uniform(0.0, 0.15)))
        found = time.made_at((first + 20 * k) % (1 << 24), made + delay)
        if k > 50:
            assert found == pytest.approx(made + 0.004, abs=0.003)
        assert found <= made + delay


def test_overtaken_packets_keep_their_own_time():
    time = VehicleTime()
    assert time.made_at(1000, 5.0) == 5.0
    assert time.made_at(1040, 5.05) == pytest.approx(5.04, abs=1e-3)
    assert time.made_at(1020, 5.06) == pytest.approx(5.02, abs=1e-3)


def test_a_vehicle_that_began_anew_is_begun_anew():
    time = VehicleTime()
    time.made_at(9_000_000, 50.0)
    assert time.made_at(20, 60.0) == 60.0
    assert time.made_at(40, 60.1) == pytest.approx(60.02, abs=1e-3)
