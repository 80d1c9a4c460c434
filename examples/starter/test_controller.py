"""Tests of my controller: python -m pytest"""

import sys
from pathlib import Path

import numpy as np

from crazyarena.runner.check.submission import check

FOLDER = Path(__file__).resolve().parent
sys.path.insert(0, str(FOLDER))

from route import Route, way_points  # noqa: E402


def test_the_route_leads_through_a_gate():
    gate = (1.0, 0.0, 1.0, -np.pi / 2)
    route = Route(way_points([0.0, 0.0, 0.0], [gate], [], [2.0, 0.0, 1.0]))
    times = np.linspace(0.0, route.times[-1], 200)
    nearest = min(np.linalg.norm(route.at(t)[0] - gate[:3]) for t in times)
    assert nearest < 0.02


def test_it_completes_level_0():
    problems = [finding for finding in check(FOLDER) if finding.works is False]
    assert not problems, problems
