"""Random hostile scripts stay inside; and what gets out is shrunk to what it needs."""

from __future__ import annotations

from dataclasses import replace

import pytest

from crazyarena.runner.campaign import gate_fuzz
from crazyarena.runner.campaign.gate_fuzz import Call, Outcome, Script, draw_script, fly, shrink

ALLOWED = 0.10  # m


_UP = Call("takeoff", (1.0, 2.0), 2.5)


def test_a_seed_is_a_script():
    def names(seed):
        return [(call.name, call.wait) for call in draw_script(seed).calls]

    assert names(3) == names(3)
    assert names(3) != names(4)
    assert draw_script(3, "refuse").policy == "refuse"
    drawn = {call.name for seed in range(200) for call in draw_script(seed).calls}
    assert drawn == {row[0] for row in gate_fuzz._CALLS}


def test_without_the_gate_something_gets_out(monkeypatch):
    # What is measured can be more than nothing.
    calls = (
        Call("takeoff", (1.0, 1.5), 2.0),
        Call("goTo", ([2.9, 0.0, 1.0], 0.0, 1.2), 1.0),
        Call("stop", (), 3.0),
    )
    script = Script(0, "box", "clamp", 2, 1, ",link_loss_margin=inf", calls)
    assert fly(script).excursion > -0.5
    assert fly(replace(script, options="")).excursion < ALLOWED


# The last: a go-to that tips it over, and a climb that the watchdog ends below the ceiling.
@pytest.mark.parametrize("seed", [16, 131, 227, 80298])
def test_a_flight_stays_inside(seed):
    outcome = fly(draw_script(seed))
    assert not outcome.is_bad(ALLOWED), outcome.ended
    assert outcome.passed > 0


@pytest.mark.parametrize(
    "way", [(0.2, 0.0, 0.0), (0.45, 0.37, 0.0), (0.1, 0.0, 0.5), (0.27, 0.22, -0.7)]
)
def test_a_hasty_go_to_does_not_tip_a_vehicle_over(way):
    calls = (Call("takeoff", (1.0, 2.0), 2.5), Call("relative", (way, 0.0, 0.0), 2.0))
    outcome = fly(Script(0, "box", "clamp", 2, 2, "", calls))
    assert (outcome.ended, outcome.passed) == ("", 2)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [80188, 50010])
@pytest.mark.parametrize("wait", [0.0, 0.05, 0.08, 0.11])
def test_sharp_turns_near_a_notch_stay_inside(seed, wait):
    script = draw_script(seed)
    flown = [c for c in script.calls if c.name in ("takeoff", "goTo", "fullState", "relative")]
    if seed == 50010:
        flown = [c for c in flown if c.name in ("fullState", "relative")]
        flown.append(Call("cmdHover", (0.0, 0.0, 0.0, 0.25), 0.078))
    calls = tuple(replace(c, wait=wait) if c.name == "relative" else c for c in flown)
    assert not fly(replace(script, calls=calls)).is_bad(ALLOWED)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [90418, 90603])
def test_what_the_watchdog_takes_falling_or_spinning_stays_inside(seed):
    assert not fly(draw_script(seed)).is_bad(ALLOWED)


def test_avoidance_on_board_does_not_throw_about_what_the_watchdog_lands():
    box = ([-2.3, -2.0, 1.11], [1.6, 3.1, 2.5])
    calls = (
        Call("goTo", ([1.8, 0.9, 1.98], 0.1, 2.7), 1.7),
        Call("enableCollisionAvoidance", box, 3.0),
        Call("goTo", ([2.7, -0.8, 0.3], 1.0, 2.9), 2.6),
    )
    assert not fly(Script(0, "box", "refuse", 2, 1, "", calls)).is_bad(ALLOWED)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["clamp", "refuse"])
@pytest.mark.parametrize("seed", range(3000, 3030))
def test_more_flights_stay_inside(seed, policy):
    outcome = fly(draw_script(seed, policy))
    assert not outcome.is_bad(ALLOWED), outcome.ended


def test_shrinking_keeps_what_it_needs(monkeypatch):
    def flown(script):
        names = [call.name for call in script.calls]
        bad = "b" in names and "e" in names and names.index("b") < names.index("e")
        return Outcome(script, excursion=1.0 if bad else -1.0)

    monkeypatch.setattr(gate_fuzz, "fly", flown)
    calls = tuple(Call(name, (), 0.0) for name in "abcdefgh")
    script = Script(0, "box", "clamp", 2, 1, "", calls)
    small = shrink(script, lambda outcome: outcome.is_bad(ALLOWED))
    assert [call.name for call in small.calls] == ["b", "e"]


@pytest.mark.parametrize("controller", [1, 2])
@pytest.mark.parametrize(
    "calls",
    [
        [Call("notifySetpointsStop", (), 1.0)],
        [Call("notifySetpointsStop", (), 0.2), Call("goTo", ([0.0, 0.0, 1.0], 0.0, 2.0), 2.5)],
        [Call("notifySetpointsStop", (), 0.0), Call("takeoff", (1.5, 1.5), 2.0)],
        [Call("goTo", ([0.0, 0.0, 1.0], 0.0, 2.0, False, 4), 1.0)],
        [Call("land", (0.8, 1.0), 2.0)],
    ],
    ids=["released", "paused", "taken off", "another group", "landed high up"],
)
def test_no_vehicle_in_the_air_is_left_without_motors(monkeypatch, calls, controller):
    stream = Call("fullState", (0.5, [0.4, 0.0, 1.0], [0.4, 0.0, 0.0], [0.0, 0.0, 0.0]), 0.0)
    assert _highest_without_motors(monkeypatch, controller, 2, [stream, *calls]) < 0.25


def test_velocities_that_mellingers_controller_does_not_follow_drop_no_vehicle(monkeypatch):
    calls = [Call("cmdVelocityWorld", ([0.3, 0.0, 0.0], 0.0), 0.05)] * 20
    assert _highest_without_motors(monkeypatch, 2, 1, calls) < 0.25


def _highest_without_motors(monkeypatch, controller, api, calls):
    """m; 1.0 of a vehicle that is dropped, some centimetres of one that is behind its landing."""
    heights = [0.0]
    see = gate_fuzz._Watch.see

    def look(self, state, off):
        see(self, state, off)
        heights.append(float(state.position[2]) if off else 0.0)

    monkeypatch.setattr(gate_fuzz._Watch, "see", look)
    fly(Script(0, "box", "clamp", controller, api, "", (_UP, *calls)))
    return max(heights)
