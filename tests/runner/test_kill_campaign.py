"""The kill campaign, a little of it; all of it: python benchmarks/kill_campaign.py"""

import json
import random

import pytest

from benchmarks import kill_campaign as kill


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", ["dry-run", "evaluate", "tournament"])
def test_what_is_left_can_be_read(tmp_path, name):
    tally = kill.campaign(name, 4, random.Random(3), tmp_path)
    assert tally.runs == tally.readable == 4, tally.troubles
    assert tally.recordings + tally.parts > 0


def test_it_sees_what_cannot_be_read(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (run / "episode_000.mcap").write_bytes(b"no recording")
    (run / "result.json").write_text('{"episodes": [')
    troubles = kill.check(tmp_path, kill.Tally())
    assert len(troubles) == 2
    (run / "result.json").write_text(
        json.dumps({"episodes": [{"files": {"recording": "episode_001.mcap"}}]})
    )
    assert "told of and not there" in kill.check(tmp_path, kill.Tally())[0]
