"""Submissions that mean harm: each ends safely, and none gets at what is not its own."""

import os
import socket
import textwrap

import numpy as np
import pytest

from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.runner.compute import parse_compute
from crazyarena.runner.control_loop import Deadlines
from crazyarena.runner.flight import FlightTrial
from crazyarena.runner.sandbox.limits import Limits
from crazyarena.runner.sandbox.process import Sandboxed
from tests.runner.fakes import PathWorld, controller
from tests.runner.hostile import DENIED, FATAL, IMPORTS

GOAL = (-0.5, 2.9, 0.75)
QUICK = ("raise", "os_exit", "segfault", "garbage", "infinite_loop")
LIMITS = Limits(make_timeout=20.0, hook_timeout=5.0)


def fly(file, out=None):
    """Fly a submission in a sandbox; returns the episode and what it printed."""
    level = load_level("level0", ["track.gates=[]", "track.obstacles=[]"])
    contender = Sandboxed(file, LIMITS)
    try:
        # A busy machine must not turn a slow answer into a missing one.
        deadlines = Deadlines(max_misses=45, compute=parse_compute("measured"))
        world = PathWorld(lambda t: GOAL)
        trial = FlightTrial(level, contender, world, deadlines=deadlines, episodes=1, out=out)
        return trial.run().episodes[0], contender._box.last_output(1 << 20)
    finally:
        contender.close()
        assert not contender._box.root.exists()


def write(folder, step):
    folder.mkdir(exist_ok=True)
    file = folder / "pilot.py"
    file.write_text(IMPORTS + controller(step=step))
    return file


def handles():
    return len(os.listdir("/proc/self/fd"))


def memory():
    with open("/proc/self/statm") as stream:
        return int(stream.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def children():
    found = []
    for name in os.listdir("/proc"):
        if name.isdigit():
            try:
                with open(f"/proc/{name}/stat") as stream:
                    fields = stream.read().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[1]) == os.getpid() and fields[0] != "Z":
                found.append(int(name))
    return found


@pytest.fixture(scope="module", autouse=True)
def nothing_is_left_behind(tmp_path_factory):
    """Memory, open files and processes are back to where they were, and flying still works."""
    good = write(tmp_path_factory.mktemp("good"), "return Command.NONE, []")
    fly(good)
    files, used, others = handles(), memory(), set(children())
    yield
    episode, _ = fly(good)
    assert episode.termination == "TASK COMPLETION"
    assert handles() == files
    assert set(children()) <= others
    assert memory() < used + 64 * 2**20


def check_fatal(tmp_path, name):
    code, reason = FATAL[name]
    outside = tmp_path / "results"
    outside.mkdir()
    file = write(tmp_path / "entry", code.replace("{outside}", str(outside)))
    episode, _ = fly(file, out=outside)
    assert episode.termination in ("CONTROLLER ERROR", "CONTROLLER TIMEOUT")
    assert episode.error
    assert reason in episode.error
    # Nothing but the recording was written.
    assert [f.name for f in outside.iterdir()] == ["episode_000.mcap"]
    assert [f.name for f in (tmp_path / "entry").iterdir()] == ["pilot.py"]


@pytest.mark.parametrize("name", QUICK)
def test_ends_its_own_trial_and_nothing_else(tmp_path, name):
    check_fatal(tmp_path, name)


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in FATAL if n not in QUICK])
def test_ends_its_own_trial_and_nothing_else_at_length(tmp_path, name):
    check_fatal(tmp_path, name)


def test_is_denied_what_is_not_its_own(tmp_path):
    """One submission, one attack a step; each must fail, and the trial must go on."""
    outside = tmp_path / "results"
    outside.mkdir()
    secret = outside / "level.yaml"
    secret.write_text("seed: 4711\n")
    server = socket.create_server(("127.0.0.1", 0))
    attacks = []
    for name, code in DENIED.items():
        code = (
            code.replace("{secret}", str(secret))
            .replace("{outside}", str(outside))
            .replace("{port}", str(server.getsockname()[1]))
            .replace("{runner}", str(os.getpid()))
        )
        attacks.append((name, code))
    step = f"""
attacks = {attacks!r}
k = len(self.calls) - 1
if k < len(attacks):
    name, code = attacks[k]
    try:
        exec(code, dict(globals()))
        print("BREACH", name, flush=True)
    except Exception as error:
        print("denied", name, repr(error), flush=True)
return Command.NONE, []
"""
    with server:
        episode, printed = fly(
            write(tmp_path / "entry", textwrap.indent(step, " " * 8).strip()), out=outside
        )
    assert episode.termination == "TASK COMPLETION", episode.error
    lines = printed.splitlines()
    assert [line for line in lines if line.startswith("BREACH")] == []
    assert sum(line.startswith("denied") for line in lines) == len(DENIED)
    assert secret.read_text() == "seed: 4711\n"
    assert sorted(f.name for f in outside.iterdir()) == ["episode_000.mcap", "level.yaml"]


def test_a_fork_bomb_dies_with_its_trial(tmp_path):
    code = "while True:\n            os.fork()"
    before = set(children())
    episode, _ = fly(write(tmp_path / "entry", code))
    assert episode.termination in ("CONTROLLER ERROR", "CONTROLLER TIMEOUT")
    assert set(children()) <= before


def test_what_stays_behind_in_the_background_dies_with_the_trial(tmp_path):
    code = """\
if len(self.calls) == 1 and os.fork() == 0:
            os.setsid()
            if os.fork() == 0:
                while True:
                    clock.sleep(0.05)
            os._exit(0)
        return Command.NONE, []"""
    level = load_level("level0", ["track.gates=[]", "track.obstacles=[]"])
    contender = Sandboxed(write(tmp_path / "entry", code), LIMITS)
    FlightTrial(level, contender, PathWorld(lambda t: GOAL), episodes=1).run()
    contender.close()
    left = []
    for name in os.listdir("/proc"):
        if name.isdigit():
            try:
                with open(f"/proc/{name}/cmdline") as stream:
                    if str(contender._box.root) in stream.read():
                        left.append(name)
            except OSError:
                continue
    assert left == []


@pytest.mark.parametrize(
    ("init", "words"),
    [
        ("os._exit(4)", "exit code 4"),
        ("raise OSError('gone')", "OSError: gone"),
        ("sys.exit('bye')", "bye"),
        ("ctypes.string_at(0)", "SIGSEGV"),
    ],
)
def test_a_constructor_that_fails_is_bad_input(tmp_path, init, words):
    file = tmp_path / "pilot.py"
    file.write_text(IMPORTS + controller(init=init))
    contender = Sandboxed(file, LIMITS)
    try:
        with pytest.raises(InputError, match=words):
            contender.make([0.0] * 12, load_level("level0"), np.zeros(12))
    finally:
        contender.close()


def test_a_constructor_that_hangs_is_bad_input(tmp_path):
    file = tmp_path / "pilot.py"
    file.write_text(IMPORTS + controller(init="clock.sleep(100)"))
    contender = Sandboxed(file, Limits(make_timeout=1.0))
    try:
        with pytest.raises(InputError, match="within 1 s"):
            contender.make([0.0] * 12, load_level("level0"), np.zeros(12))
    finally:
        contender.close()


def test_the_traceback_and_the_last_output_are_kept(tmp_path):
    code = "print('nearly there', flush=True)\n        os._exit(7)"
    episode, _ = fly(write(tmp_path / "entry", code))
    assert "exit code 7" in episode.error
    assert "nearly there" in episode.error
    episode, _ = fly(write(tmp_path / "other", "return self.no_such_thing"))
    assert "AttributeError" in episode.error
    assert "pilot.py" in episode.error
