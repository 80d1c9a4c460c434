"""Margins: where a submission turns from completing to failing."""

from __future__ import annotations

import pytest

from crazyarena.errors import InputError
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.runner import margins as mg
from crazyarena.sim_backend.vehicles import load_vehicle


@pytest.mark.parametrize("edge", [0.1, 0.17, 0.4, 0.83])
def test_the_edge_is_found(edge):
    asked = []

    def end_of(value):
        asked.append(value)
        return None if value <= edge else f"ended at {value:g}"

    value, end = mg.largest(end_of, 0.0, 1.0)
    # How it ends is told of the value next to the edge.
    assert end == f"ended at {min(v for v in asked if v > edge):g}"
    assert edge - 1.0 / 32.0 <= value <= edge
    assert len(asked) == 6


def test_what_fails_nowhere_is_said_to_go_beyond():
    assert mg.largest(lambda value: None, 0.0, 1.0) == (1.0, None)


def test_conditions_are_fields_of_the_vehicle_and_of_the_cameras():
    vehicle = load_vehicle()
    worse = mg.Conditions(lag=0.1, drag=2.0, strength=0.9, latency=0.02, noise=0.003)
    flown = load_vehicle(overrides=worse.overrides(vehicle))
    assert flown.rotors.lag_up.value == flown.rotors.lag_down.value == 0.1
    assert flown.body.drag.value == pytest.approx([2 * v for v in vehicle.body.drag.value])
    assert flown.rotors.strength.value == pytest.approx([0.9] * 4)
    assert worse.cameras() == CameraModel(latency=0.02, position_noise=0.003)
    assert mg.Conditions().overrides(vehicle) == []
    assert mg.Conditions().cameras() is None


def test_levels_of_the_competition_have_no_vehicle_to_vary():
    with pytest.raises(InputError, match="profile=arena"):
        mg.MarginRun(None, "level0")


def test_each_number_is_varied_alone_and_all_verdicts_are_told(monkeypatch):
    def end(self, conditions, vehicle):
        lag = conditions.lag or 0.08
        return "collision" if lag > 0.11 or conditions.drag > 2.0 else None

    monkeypatch.setattr(mg.MarginRun, "_end", end)
    result = mg.MarginRun(None, "sim2real").run()
    found = {m.axis.name: m for m in result.margins}
    assert found["rotor lag"].value == pytest.approx(0.11, abs=0.01)
    assert found["drag"].value == pytest.approx(2.0, abs=0.15)
    assert found["rotor lag"].end == "collision"
    assert found["weakness"].end is None
    assert found["camera noise"].end is None
    assert result.verdicts[0.12, 1.0] == "collision"
    assert result.verdicts[0.10, 1.5] == "completed"
    assert len(result.verdicts) == 18
    assert result.completed
    assert len(mg.tables(result)) == 2


def test_a_nominal_failure_has_no_margins(monkeypatch):
    def end(self, conditions, vehicle):
        self._why = "SAFETY: lost"
        return "safety"

    monkeypatch.setattr(mg.MarginRun, "_end", end)
    result = mg.MarginRun(None, "sim2real").run()
    assert not result.completed
    assert not result.margins
    assert result.nominal == "safety"
    assert result.why == "SAFETY: lost"
    assert len(mg.tables(result)) == 1
