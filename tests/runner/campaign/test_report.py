"""What became of the flights, counted, drawn and written down."""

from __future__ import annotations

import json

from crazyarena.runner.campaign import report
from crazyarena.runner.campaign.outcome import failures, summarise
from crazyarena.runner.campaign.run import run_campaign


def test_table_figure_and_file(tmp_path):
    outcomes = run_campaign(["nan"], 2)
    (row,) = summarise(outcomes)
    assert (row["fault"], row["flights"], row["safe"]) == ("nan", 2, 2)
    report.write_json(tmp_path / "c.json", outcomes)
    document = json.loads((tmp_path / "c.json").read_text())
    assert len(document["flights"]) == 2
    assert document["flights"][0]["events"][0]["rule"]
    report.save_figure(tmp_path / "c.png", outcomes)
    assert (tmp_path / "c.png").stat().st_size > 1000
    assert report.table(outcomes).row_count == 1
    assert failures(outcomes, 1.0) == []
    bad = outcomes[0]
    bad.excursion = 0.2
    assert failures(outcomes, 1.0) == [bad]
    bad.excursion, bad.end = -0.2, "flying"
    assert failures(outcomes, 1.0) == [bad]
