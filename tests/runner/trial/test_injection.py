"""What goes out about the track and about what the contestant is told."""

import json
import socket
import threading

import numpy as np

from crazyarena.levels import load_level
from crazyarena.mocap.zenoh_session import open_session
from crazyarena.runner.judging.referee import Referee
from crazyarena.runner.trial.injection import Injection, ZenohOutlet
from crazyarena.runner.trial.phase import MeasuredTrack
from tests.runner.fakes import rows


class Kept:
    def __init__(self):
        self.values = []

    def put(self, key, value):
        self.values.append((key, value))

    def close(self):
        pass


def judged(injection):
    """Fly past gate 0 of level0, displaced by 0.1 m; tells the injection of every verdict."""
    level = load_level("level0")
    gates = np.array([gate.row for gate in level.track.gates], dtype=float)
    gates[:, 2] = [gate.centre[2] for gate in level.track.gates]
    gates[0, 0] += 0.1
    obstacles = np.array([o.row for o in level.track.obstacles], dtype=float)
    referee = Referee(level)
    referee.begin(gates, obstacles)
    injection.begin(MeasuredTrack(gates, obstacles, "measured"), level, None)
    for k, x in enumerate((-0.9, 0.0, 0.15, 0.2, 0.0, -0.9)):
        verdict = referee.judge(rows([[x, -2.5, 1.0]] * 16, first_tick=1 + 16 * k))
        injection.judged(verdict, (k + 1) / 30.0)
    return gates


def test_every_change_is_told_once():
    outlet = Kept()
    injection = Injection(outlet)
    gates = judged(injection)
    keys = [key for key, _ in outlet.values]
    assert keys == ["track", "gates/0", "gates/0", "gates/0"]
    np.testing.assert_array_equal(outlet.values[0][1]["gates"], gates)
    nominal, exact, again = (value for _, value in outlet.values[1:])
    assert (nominal["in_range"], exact["in_range"], again["in_range"]) == (False, True, False)
    assert nominal["pose"][2] == 0.0
    assert exact["pose"] == gates[0, :6].tolist()
    assert again["pose"] == nominal["pose"]
    assert injection.reveals == [nominal, exact, again]


def test_it_arrives_over_zenoh():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    received, complete = {}, threading.Event()

    def take(sample):
        received.setdefault(str(sample.key_expr), []).append(json.loads(sample.payload.to_bytes()))
        if len(received.get("crazyarena/trial/gates/0", [])) == 3:
            complete.set()

    session = open_session(listen=[endpoint])
    try:
        subscriber = session.declare_subscriber("crazyarena/trial/**", take)
        outlet = ZenohOutlet(connect=[endpoint])
        # The subscription has to be known on the other side.
        known = threading.Event()
        waiting = session.declare_subscriber("crazyarena/trial/hello", lambda s: known.set())
        for _ in range(100):
            outlet.put("hello", {})
            if known.wait(0.05):
                break
        waiting.undeclare()
        judged(Injection(outlet))
        assert complete.wait(10.0)
        outlet.close()
        subscriber.undeclare()
    finally:
        session.close()
    assert received["crazyarena/trial/track"][0]["source"] == "measured"
