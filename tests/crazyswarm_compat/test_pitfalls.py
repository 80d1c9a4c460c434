"""What the firmware silently takes otherwise than it reads is said, in simulation too."""

from __future__ import annotations

import warnings

import pytest

from crazyarena.crazyswarm_compat.crazyswarm1 import Crazyswarm

ONE = "crazyflies: [{id: 1, initialPosition: [0, 0, 0]%s}]"


@pytest.fixture
def flying():
    def make(params="", yaml=ONE):
        text = yaml % params if "%s" in yaml else yaml
        swarm = Crazyswarm(text, args="--backend sim --vis null")
        swarm.allcfs.takeoff(0.5, 1.0)
        swarm.timeHelper.sleep(1.5)
        made.append(swarm)
        return swarm.timeHelper, swarm.allcfs, swarm.allcfs.crazyflies[0]

    made = []
    yield make
    for swarm in made:
        swarm.allcfs.close()


def silently(call):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        call()


def test_velocities_for_the_mellinger_controller(flying):
    time_helper, _, cf = flying()  # Crazyswarm's launch file selects it
    with pytest.warns(UserWarning, match="cf1: cmdVelocityWorld: velocities are not followed"):
        cf.cmdVelocityWorld([0.1, 0, 0], 0)
    time_helper.sleep(0.1)
    silently(lambda: cf.cmdVelocityWorld([0.1, 0, 0], 0))  # said once a stream
    cf.cmdPosition([0, 0, 0.5])
    with pytest.warns(UserWarning, match="velocities"):
        cf.cmdVelocityWorld([0.1, 0, 0], 0)


def test_velocities_for_the_pid_controller(flying):
    time_helper, _, cf = flying(", firmwareParams: {stabilizer: {controller: 1}}")

    def stream():
        for _ in range(30):
            cf.cmdVelocityWorld([0.2, 0, 0], 0)
            time_helper.sleep(0.1)

    silently(stream)
    assert cf.position()[0] > 0.3


@pytest.mark.parametrize("name", ["takeoff", "land", "goTo"])  # startTrajectory goes the same way
def test_a_command_after_a_stream_that_was_not_declared_over(flying, name):
    time_helper, _, cf = flying()
    arguments = {"takeoff": (1.0, 1.0), "land": (0.0, 1.0), "goTo": ([0, 0, 1], 0, 1.0)}[name]
    cf.cmdPosition([0, 0, 0.5])
    time_helper.sleep(0.05)
    with pytest.warns(UserWarning, match=f"cf1: {name}: follows streamed setpoints without"):
        getattr(cf, name)(*arguments)
    cf.notifySetpointsStop()
    if name != "takeoff":
        silently(lambda: getattr(cf, name)(*arguments))


def test_vehicles_that_touch_before_the_script_begins():
    text = (
        "crazyflies: [{id: 1, initialPosition: [0, 0, 0]}, {id: 2, initialPosition: [0, 0.05, 0]}]"
    )
    with pytest.warns(UserWarning, match="cf1 and cf2 touched before the script began"):
        swarm = Crazyswarm(text, args="--backend sim --vis null")
    assert swarm.allcfs.contacts
    assert all(contact.time >= 0.0 for contact in swarm.allcfs.contacts)
    swarm.allcfs.close()
