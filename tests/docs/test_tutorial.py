"""The tutorial, executed from its first block to its last, exactly as written."""

import json

import pytest

from tests.docs.blocks import ROOT, blocks, shell

PAGE = ROOT / "docs" / "tutorial.md"


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.timeout(1500)
def test_every_block_does_what_the_page_says(tmp_path):
    flown = 0
    for block in blocks(PAGE):
        if block.language == "python":
            (tmp_path / block.options["title"]).write_text(block.text)
            continue
        assert block.language == "sh", block
        done = shell(block.text, tmp_path)
        report = f"{block}\n{block.text}\n{done.stdout}\n{done.stderr}"
        assert done.returncode == int(block.options.get("exit", 0)), report
        flown += 1
    assert flown == 9
    assert len(list((tmp_path / "first" / "tables").glob("*.csv"))) >= 4
    level3 = json.loads((tmp_path / "level3" / "result.json").read_text())
    assert [e["clean"] for e in level3["episodes"]] == [True] * 20
    comparison = json.loads((tmp_path / "bench" / "compare.json").read_text())
    assert comparison["mean_distance"] < 0.1


def test_its_controller_is_checked_as_code():
    (code,) = (block for block in blocks(PAGE) if block.language == "python")
    compile(code.text, str(PAGE), "exec")
    assert code.options == {"title": "my_controller/edit_this.py"}
