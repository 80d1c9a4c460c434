"""How far a vehicle may be behind what it was told, and why that is no reason to stop it."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.safety.limits import Limits
from crazyarena.safety.monitors import RULES, Monitor
from crazyarena.safety.observation import Observation
from tests.safety.scenes import fence
from tests.safety.test_gate import Rig

FOLLOWING = next(rule for rule in RULES if rule.name == "following")


def found(position, velocity, setpoint, told=(0.0, 0.0, 0.0)):
    monitor = Monitor(FOLLOWING, fence(), Limits())
    result = None
    for time in (1.0, 1.2, 1.4):
        obs = Observation(
            time=time, active=True, airborne=True, position=position, velocity=velocity,
            setpoint=setpoint, setpoint_velocity=told,
        )  # fmt: skip
        result = monitor.update(obs, overriding=False)
    return result


def test_places_without_a_velocity_are_followed_late():
    assert found((0.0, 0.0, 1.0), (1.3, 0.0, 0.0), (0.65, 0.0, 1.0)) is None
    # Not as far as that, nor with a velocity, nor another way.
    assert found((0.0, 0.0, 1.0), (1.3, 0.0, 0.0), (1.3, 0.0, 1.0)) is not None
    assert found((0.0, 0.0, 1.0), (1.3, 0.0, 0.0), (0.65, 0.0, 1.0), (1.3, 0.0, 0.0)) is not None
    assert found((0.0, 0.0, 1.0), (-1.3, 0.0, 0.0), (0.65, 0.0, 1.0)) is not None
    assert found((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.65, 0.0, 1.0)) is not None


def told(rig, x, velocity=(0.0, 0.0, 0.0)):
    zero = np.zeros(3)
    return rig.send(c.FullState((x, 0.0, 1.0), velocity, zero, 0.0, zero)).position[0]


def test_the_lead_grows_with_the_speed_towards_it_and_no_further():
    limits = Limits(link_loss_margin=np.inf, setpoint_step=5.0)
    assert told(Rig(limits=limits), 1.2) == pytest.approx(0.6)
    assert told(Rig(velocity=(0.5, 0.0, 0.0), limits=limits), 1.2) == pytest.approx(0.85)
    assert told(Rig(velocity=(3.0, 0.0, 0.0), limits=limits), 1.2) == pytest.approx(1.0)
    assert told(Rig(velocity=(-3.0, 0.0, 0.0), limits=limits), 1.2) == pytest.approx(0.6)
    fed = Rig(velocity=(0.5, 0.0, 0.0), limits=limits)
    assert told(fed, 1.2, (0.5, 0.0, 0.0)) == pytest.approx(0.6)
