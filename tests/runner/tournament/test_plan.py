"""What is to be flown."""

import pytest

from crazyarena.levels.document import MAX_BYTES
from crazyarena.levels.draw_file import read_draw
from crazyarena.runner.tournament import plan
from crazyarena.runner.tournament.rules import Lives


@pytest.mark.parametrize("name", ["level3", "sim2real", "lsy/level1"])
def test_the_draw_file_of_most_seeds_can_be_read_again(tmp_path, name):
    seeds = tuple(2**128 - 1 - number for number in range(plan.MOST_SEEDS))
    level = plan.plan_level(name, seeds, Lives.LEVEL)
    whole = plan.Plan((), (level,), plan.Options(plan.MOST_SEEDS), "iros2022", "", "")
    whole.options.check()
    text = whole.draw_text(level, 0)
    assert len(text) < MAX_BYTES
    (tmp_path / "draw.yaml").write_text(text)
    if level.toml is not None:
        (tmp_path / level.toml[0]).write_text(level.toml[1])
    read = read_draw(tmp_path / "draw.yaml")
    assert tuple(read.seeds) == tuple(seeds[number] for number in level.blocks[0])
