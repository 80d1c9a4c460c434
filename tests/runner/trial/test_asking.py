"""The question before arming: answered in the terminal or on the page, and only this one."""

from __future__ import annotations

import os

import pytest

from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.live import Live, Watched
from crazyarena.runner.trial.asking import ask_operator
from crazyarena.runner.trial.showing import Showing


class Waiting:
    """A clock on which something happens while somebody waits."""

    def __init__(self, *happens):
        self.time = 0.0
        self.happens = list(happens)

    def now(self):
        return self.time

    def sleep_until(self, deadline):
        self.time = deadline
        if self.happens:
            self.happens.pop(0)()
        assert self.time < 60.0, "nobody answered"
        return 0.0


@pytest.fixture
def show(tmp_path):
    live = Live(1, tmp_path)
    yield Showing(live, load_level("sim2real"), 1)
    live.close()


def asked(show):
    return Watched(show.live.file).state().facts["question"]


def ask(clock, show, terminal=None, page=True, interrupted=lambda: False):
    return ask_operator(
        "Arm?",
        clock,
        terminal=terminal,
        show=show,
        page=page,
        say=lambda text: None,
        interrupted=interrupted,
    )


def test_the_page_answers_the_question_it_was_shown(show):
    page = Watched(show.live.file)
    seen = []

    def answer():
        seen.append(asked(show)["text"])
        page.reply({"confirm": asked(show)["id"]})

    assert ask(Waiting(answer), show)
    assert seen == ["Arm?"]
    assert asked(show) is None


def test_an_answer_to_an_earlier_question_is_none(show):
    page = Watched(show.live.file)
    old = []

    def answer():
        old.append(asked(show)["id"])
        page.reply({"confirm": old[-1]})

    assert ask(Waiting(answer), show)
    stop = []
    assert not ask(
        Waiting(*[lambda: None] * 20, lambda: stop.append(1)), show, interrupted=lambda: bool(stop)
    )


@pytest.mark.parametrize(("typed", "yes"), [(b"y\n", True), (b"Yes\n", True), (b"\n", False)])
def test_the_terminal_answers_whether_there_is_a_page_or_not(show, typed, yes):
    for page in (True, False):
        ours, theirs = os.pipe()
        with open(ours) as terminal:
            clock = Waiting(lambda: None, lambda theirs=theirs: os.write(theirs, typed))
            assert ask(clock, show, terminal, page) is yes
        os.close(theirs)


def test_a_closed_terminal_says_no(show):
    ours, theirs = os.pipe()
    os.close(theirs)
    with open(ours) as terminal:
        assert not ask(Waiting(), show, terminal)


def test_where_nobody_can_answer_it_is_not_asked(show):
    with pytest.raises(InputError, match="--yes"):
        ask(Waiting(), None, page=True)
    with pytest.raises(InputError, match="--yes"):
        ask(Waiting(), show, page=False)


def test_ctrl_c_is_a_no(show):
    ours, theirs = os.pipe()
    with open(ours) as terminal:
        assert not ask(Waiting(), show, terminal, interrupted=lambda: True)
    os.close(theirs)
