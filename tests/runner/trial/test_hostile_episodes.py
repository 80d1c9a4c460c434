"""Endings of every kind, one after the other in one run: each episode begins clean."""

from __future__ import annotations

import builtins
from dataclasses import dataclass
from typing import Any

import pytest

from crazyarena.runner.contestant.sandbox.limits import Limits
from crazyarena.runner.contestant.sandbox.process import Sandboxed
from crazyarena.safety.events import Action
from tests.runner.hostile import FATAL, IMPORTS
from tests.runner.trial.test_episodes import RISE, fly, take, tumble

LIMITS = Limits(make_timeout=20.0, hook_timeout=5.0, disk=64 * 2**20, files=2000)
COMPLETE, LATE = "TASK COMPLETION", "MAX EPISODE DURATION"
HARMED = ("CONTROLLER ERROR", "CONTROLLER TIMEOUT", "SAFETY")
WHEN = 1.5  # s, in flight


@dataclass(frozen=True)
class Ending:
    """code: what the contestant does from WHEN on; on_step: what happens to it; ends: how the
    episode may end; flown: whether it surely was in the air until then."""

    ends: tuple[str, ...]
    code: str = "pass"
    on_step: Any = None
    flown: bool = True


def hostile(name, *ends):
    # Written for the body of a method; further lines are indented for it.
    return Ending(ends or HARMED, FATAL[name][0].replace("\n        ", "\n"))


def asks(command, *ends):
    return Ending(ends, f"return {command}")


NAN = "float('nan')"
ENDINGS = {
    "complete": Ending((COMPLETE,)),
    "finished": asks("Command.FINISHED, []", "FINISHED"),
    "nothing": asks("Command.NONE, []", *HARMED, LATE),
    "hold": Ending(("SAFETY",), on_step=take(Action.HOLD)),
    "land": Ending(("SAFETY",), on_step=take(Action.LAND)),
    "cut": Ending(("SAFETY",), on_step=take(Action.CUT)),
    "tumble": Ending(("SAFETY", "COLLISION", "CRASH", LATE), on_step=tumble),
    "exception": hostile("raise"),
    "base exception": hostile("base_exception"),
    "interrupt": hostile("keyboard_interrupt"),
    "wrong type": hostile("wrong_type"),
    "not a number": hostile("not_finite"),
    "lies": hostile("numbers_that_lie"),
    "out of the fence": asks(
        "Command.FULLSTATE, [[9.0, 9.0, 9.0], [9.0] * 3, [9.0] * 3, 0.0, [0.0] * 3]",
        *HARMED,
        LATE,
    ),
    "into the ground": asks(
        "Command.FULLSTATE, [[self.x, self.y, -1.0], [0, 0, -3.0], [0, 0, -9.0], 0.0, [0] * 3]",
        *HARMED,
        LATE,
        "COLLISION",
    ),
    "stop in flight": asks("Command.STOP, []", *HARMED, LATE, "COLLISION"),
    "recursion": hostile("recursion"),
    "system exit": hostile("sys_exit"),
}
# Only behind walls: in this process they would end the runner.
WALLED = {
    "exit": hostile("os_exit"),
    "segfault": hostile("segfault"),
    "hang": hostile("infinite_loop"),
    "sleep": hostile("sleep"),
    "garbage": hostile("garbage"),
    "closed channel": hostile("close_channel", *HARMED, LATE, ""),
    "forged answer": hostile("forged_answer"),
}
COUNTED = (
    """
import builtins
"""
    + IMPORTS
)


def many(order):
    """A submission whose n-th episode has the n-th ending of ``order``."""
    lines = [
        "index, last = builtins._episode",
        "index += time < last",
        "builtins._episode = index, time",
        "if time > 1.5:",
    ]
    for index, name in enumerate(order):
        lines.append(f"    if index == {index}:")
        lines += [f"        {line}" for line in ENDINGS[name].code.split("\n")]
    return COUNTED + RISE.format(trouble="\n        ".join(lines))


def fits(ending, episode):
    assert any(episode.termination.startswith(end) if end else True for end in ending.ends), (
        episode.termination
    )
    assert episode.flight_time > 1.4


def run(tmp_path, monkeypatch, order):
    # Kept outside of the controller, which may be made anew: (episode, time of its last step).
    monkeypatch.setattr(builtins, "_episode", (-1, 1e9), raising=False)
    entry = tmp_path / "many.py"
    entry.write_text(many(order))

    def on_step(rig, arena, index, time):
        happens = ENDINGS[order[index]].on_step
        if happens is not None:
            happens(rig, arena, index, time)

    result = fly(
        tmp_path,
        overrides=["episode_length=6"],
        on_step=on_step,
        episodes=len(order),
        entry=entry,
    )
    assert len(result.episodes) == len(order), result.error
    for name, episode in zip(order, result.episodes, strict=True):
        try:
            fits(ENDINGS[name], episode)
        except AssertionError as error:
            raise AssertionError(f"{name}, episode {episode.index}: {error}") from None
        if name in ("complete", "finished"):
            assert not episode.error, (name, episode.index, episode.error)
            rules = [event.name for event in episode.events if event.name.startswith("safety")]
            assert rules == [], (name, episode.index)


def test_after_each_ending_of_a_kind_the_next_episode_is_completed(tmp_path, monkeypatch):
    order = [
        *("cut", "complete", "tumble", "complete", "not a number", "complete"),
        *("into the ground", "complete", "hold", "complete"),
    ]
    run(tmp_path, monkeypatch, order)


@pytest.mark.slow
def test_every_ending_three_times_in_one_run(tmp_path, monkeypatch):
    names = [name for name in ENDINGS if name != "complete"]
    order = []
    for turn in range(3):
        # Each follows another than in the turn before.
        for name in names[turn:] + names[:turn] if turn < 2 else reversed(names):
            order += [name] if turn < 2 else [name, "complete"]
    run(tmp_path, monkeypatch, order)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [*WALLED, "complete", "cut", "tumble", "exception", "not a number"]
)
def test_three_episodes_behind_walls(tmp_path, name):
    ending = {**ENDINGS, **WALLED}[name]
    entry = tmp_path / "walled.py"
    lines = [f"if time > {WHEN}:", *(f"    {line}" for line in ending.code.split("\n"))]
    trouble = "\n        ".join(lines)
    entry.write_text(IMPORTS + RISE.format(trouble=trouble))
    result = fly(
        tmp_path,
        overrides=["episode_length=6"],
        on_step=ending.on_step,
        entry=entry,
        contestant=Sandboxed(entry, LIMITS),
    )
    assert len(result.episodes) == 3, result.error
    for episode in result.episodes:
        fits(ending, episode)
