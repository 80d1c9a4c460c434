"""A child process that is spoken to in lines of JSON."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from crazyarena.errors import BackendError
from crazyarena.runner.campaign.udp.json_child import JsonChild

PREAMBLE = """
import sys, time
from crazyarena.runner.campaign.udp.json_child import converse
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
PARENT = """
import subprocess
def talk(heard, tell):
    tell({"pid": subprocess.Popen(["sleep", "60"]).pid})
    time.sleep(60)
converse(talk)
"""
DEAF = """
def talk(heard, tell):
    tell({"ready": True})
    time.sleep(60)
converse(talk)
"""


def gone(pid: int) -> bool:
    """Whether a process ends, or only waits to be reaped."""
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            return True
        if state == "Z":
            return True
        time.sleep(0.02)
    return False


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
    assert echo.take(20.0) == {"told": {"n": 2}}
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


def test_a_killed_child_takes_its_own_children_along(child):
    parent = child(PARENT)
    grandchild = parent.take(20.0)["pid"]
    os.kill(grandchild, 0)
    parent.kill()
    with pytest.raises(BackendError, match="ended"):
        parent.take(20.0)
    parent.tell({"n": 2})  # nobody hears it
    assert gone(grandchild)


def test_a_child_hears_of_its_parents_end(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (tmp_path / "spoken_to.py").write_text(PREAMBLE + ECHO)
    (tmp_path / "log").touch()
    text = (
        "import os, pathlib, sys\n"
        "from crazyarena.runner.campaign.udp.json_child import JsonChild\n"
        "child = JsonChild('spoken_to', {}, pathlib.Path(sys.argv[1]))\n"
        "child.take(20.0)\n"
        "print(child._process.pid, flush=True)\n"
        "os._exit(0)\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", text, str(tmp_path / "log")],
        stdout=subprocess.PIPE,
        check=True,
        timeout=60,
    )
    assert gone(int(run.stdout))
