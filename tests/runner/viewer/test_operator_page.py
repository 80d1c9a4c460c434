"""What the operator reads: all of it text, whatever is missing, and stale news told as such."""

from __future__ import annotations

import io
import math

from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from crazyarena.runner.viewer.operator_page import BAD, FAIR, GOOD, grade, page, rows
from crazyarena.runner.viewer.terminal import picture

FACTS = {
    "phase": "run",
    "time": 3.21,
    "level": "sim2real",
    "episode": 0,
    "episodes": 2,
    "gate": 1,
    "gates": 4,
    "exact": True,
    "room": 0.7,
    "room_at_rest": -0.05,
    "speed": 1.5,
    "battery": 3.2,
    "link": 0.97,
    "heard": 0.012,
    "supervisor": ["flying", "armed"],
    "cameras": {"rate": 120.0, "age": 0.008, "bodies": 9},
    "ladder": "HOLD",
    "taken": "the watchdog has taken over: fence",
    "missed": 3,
    "events": [[1.0, "gate passed", "gate 0"], [None, "arm", "vehicle 1 is armed"]],
    "checklist": [
        ["world axes", True, "fine", "", False],
        ["cf1 battery", False, "3.2 V", "charge it", False],
        ["disk", False, "full", "empty it", True],
    ],
    "question": {"id": "x", "text": "Arm vehicle 1?"},
}


def in_terminal(facts, silent=0.0, over=False, width=80):
    console = Console(file=io.StringIO(), width=width)
    console.print(picture(facts, silent, over))
    return console.file.getvalue()


def test_everything_that_is_known_is_told():
    told, printed = page(FACTS, 0.0, False), in_terminal(FACTS)
    for word in (
        "3.2 s", "1 of 0–3 (exact)", "0.70 m", "-0.05 m", "3.20 V", "97 %", "12 ms ago",
        "flying, armed", "120 Hz", "9 bodies", "hold", "the watchdog has taken over", "gate passed",
        "cf1 battery", "charge it", "Arm vehicle 1?",
    ):  # fmt: skip
        assert word in told, word
        assert word in printed, word


def test_what_is_wrong_has_its_colour():
    cells = dict(rows(FACTS))
    assert BAD in cells["if it stopped now"]
    assert GOOD in cells["to the fence"]
    assert FAIR in cells["battery"]
    assert BAD in cells["watchdog"]
    assert [grade(x, 0.15, 0.0) for x in (0.2, 0.1, -0.1, math.nan, None)] == [
        GOOD,
        FAIR,
        BAD,
        None,
        None,
    ]


def test_red_lines_of_the_checklist_come_first():
    told = page(FACTS, 0.0, False)
    assert told.index("cf1 battery") < told.index("world axes")
    assert "waived disk" in told


def test_old_news_are_not_shown_as_new():
    for told in (page(FACTS, 2.5, False), in_terminal(FACTS, 2.5)):
        assert "NO NEWS for 2.5 s" in told
    assert "NO NEWS" not in page(FACTS, 0.5, False)
    assert "NO NEWS" not in page({**FACTS, "phase": "over"}, 99.0, True)
    assert "ended without a word" in page(FACTS, 99.0, True)


def test_words_of_contestants_stay_words():
    odd = "<script>x</script>\x1b[2J"
    facts = {**FACTS, "why": odd, "events": [[1.0, odd, odd]], "phase": odd, "ladder": odd}
    assert "<script" not in page(facts, 0.0, False)
    assert "\x1b[2J" not in in_terminal({**facts, "why": ""})


values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=5) | st.integers(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=5,
)


@given(st.dictionaries(st.sampled_from(sorted(set(FACTS) - {"checklist", "events"})), values))
def test_no_facts_make_it_fail(facts):
    assert page(facts, 0.0, False)
