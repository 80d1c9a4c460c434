"""A child process that is spoken to in lines of JSON."""

import pytest

from crazyarena.errors import BackendError
from crazyarena.runner.json_child import JsonChild

PREAMBLE = """
import sys, time
from crazyarena.runner.json_child import converse
"""
ECHO = """
def talk(heard, tell):
    print("this is not for the parent")
    while (message := heard.get()) is not None:
        tell({"told": message})
    tell({"told": "nothing more"})
converse(talk)
"""
BROKEN = """
def talk(heard, tell):
    tell({"first": heard.get()})
    raise RuntimeError("no such luck")
converse(talk)
"""
DEAF = """
def talk(heard, tell):
    tell({"ready": True})
    time.sleep(60)
converse(talk)
"""


@pytest.fixture
def child(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    children = []

    def make(text):
        (tmp_path / "spoken_to.py").write_text(PREAMBLE + text)
        children.append(JsonChild("spoken_to", {"n": 1}, tmp_path / "child.log"))
        return children[-1]

    yield make
    for each in children:
        each.close()
        each.close()


def test_talk(child, tmp_path):
    echo = child(ECHO)
    assert echo.take(20.0) == {"told": {"n": 1}}
    echo.tell({"n": 2})
    assert echo.rest(20.0) == [{"told": {"n": 2}}, {"told": "nothing more"}]
    with pytest.raises(BackendError):
        echo.take(1.0)
    assert "not for the parent" in (tmp_path / "child.log").read_text()


def test_a_childs_last_words_are_told(child):
    broken = child(BROKEN)
    assert broken.take(20.0) == {"first": {"n": 1}}
    for _ in range(2):
        with pytest.raises(BackendError, match="no such luck"):
            broken.take(20.0)


def test_a_silent_child_is_not_waited_for(child):
    deaf = child(DEAF)
    deaf.take(20.0)
    with pytest.raises(BackendError, match="silent"):
        deaf.take(0.05)
    assert deaf.rest(0.05) == []


def test_what_a_killed_child_said_is_kept(child):
    echo = child(ECHO)
    echo.take(20.0)
    echo.tell({"n": 2})
    heard = echo.take(20.0)
    echo.tell({"n": 3})
    echo.kill()
    echo.tell({"n": 4})
    assert heard == {"told": {"n": 2}}
    assert echo.rest(20.0) in ([], [{"told": {"n": 3}}])
