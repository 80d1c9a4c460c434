"""Test of my controller: python -m pytest"""

from pathlib import Path

from crazyarena.runner.check.submission import check


def test_it_completes_level_0():
    problems = [finding for finding in check(Path(__file__).parent) if finding.works is False]
    assert not problems, problems
