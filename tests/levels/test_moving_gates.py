"""Gates that move: what a level may say of them."""

import math

import pytest

from crazyarena.errors import InputError
from crazyarena.levels import dump_level, load_level

SIM = "track.gates[0]."


def test_gates_stand_unless_a_level_says_otherwise():
    assert load_level("sim2real").track.tracked == ()


def test_a_tracked_gate_may_swing(tmp_path):
    swing = "{x: 0.2, yaw: 0.5, period: 4, phase: 0.1}"
    level = load_level("sim2real", [f"{SIM}tracked=true", f"{SIM}motion={swing}"])
    assert level.track.tracked == (0,)
    motion = level.track.gates[0].motion
    assert motion.offset(0.0) == pytest.approx((0.2 * math.sin(0.1), 0.0, 0.5 * math.sin(0.1)))
    assert motion.offset(4.0) == pytest.approx(motion.offset(0.0))
    quarter = (math.pi / 2 - 0.1) / (2 * math.pi) * 4
    assert motion.offset(quarter) == pytest.approx((0.2, 0.0, 0.5))
    file = tmp_path / "level.yaml"
    file.write_text(dump_level(level))
    assert load_level(str(file)) == level


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ([f"{SIM}motion={{x: 0.1, period: 4}}"], "tracked: true"),
        ([f"{SIM}tracked=true", f"{SIM}motion={{x: 2.6, period: 4}}"], "moves to"),
        ([f"{SIM}tracked=true", f"{SIM}motion={{x: 0.1, period: 0.2}}"], "period"),
        ([f"{SIM}tracked=true", f"{SIM}motion={{x: 0.1}}"], "period"),
        ([f"{SIM}tracked=maybe"], "tracked"),
        ([f"{SIM}tracked=true", "profile=competition"], "profile: arena"),
    ],
)
def test_what_makes_no_sense_is_refused(overrides, words):
    with pytest.raises(InputError, match=words):
        load_level("sim2real", overrides)
