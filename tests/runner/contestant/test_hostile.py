"""Submissions that mean harm: each ends safely, and none gets at what is not its own."""

import contextlib
import os
import re
import signal
import socket
import struct
import tempfile
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.runner.contestant.compute import Budget, Compute, parse_compute
from crazyarena.runner.contestant.in_process import InProcess
from crazyarena.runner.contestant.sandbox import bubblewrap, process
from crazyarena.runner.contestant.sandbox.limits import Limits
from crazyarena.runner.contestant.sandbox.process import Sandboxed
from crazyarena.runner.contestant.submission import Submission
from crazyarena.runner.trial.control_loop import Deadlines
from crazyarena.runner.trial.trial import Trial
from tests.runner.fakes import PathWorld, controller
from tests.runner.hostile import DENIED, FATAL, FILLERS, IMPORTS
from tests.waiting import eventually

PLACE = (-0.5, 2.9, 0.75)
QUICK = ("raise", "os_exit", "segfault", "garbage", "infinite_loop", "answers_in_advance")
LIMITS = Limits(make_timeout=20.0, hook_timeout=5.0, disk=64 * 2**20, files=2000)
# One gate, out of range for ever; what stands for it in memory nobody but the referee may have.
LEVEL = load_level(
    "sim2real",
    [
        "episode_length=2.0",
        "track.obstacles=[]",
        "track.gates=[{x: 1.7, y: -2.2, type: tall, tracked: true,"
        " motion: {x: 0.123456, period: 9}}]",
    ],
)
HIDDEN = float(LevelRandom(LEVEL).reset().gates[0, 0])
ENDS_WELL = "MAX EPISODE DURATION"
HARMED = ("CONTROLLER ERROR", "CONTROLLER TIMEOUT")


class Overheard(Sandboxed):
    """A contestant whose every question is kept."""

    def __init__(self, *arguments, **options):
        self.told = []
        super().__init__(*arguments, **options)

    def ask(self, question):
        self.told.append(question.info)
        super().ask(question)


def fly(file, out=None, compute="free"):
    """Fly a submission in a sandbox; returns the episode and what it printed."""
    contestant = Overheard(file, LIMITS)
    try:
        # A busy machine must not turn a slow answer into a missing one.
        deadlines = Deadlines(max_misses=45, compute=parse_compute(compute))
        world = PathWorld(lambda t: PLACE)
        trial = Trial(LEVEL, contestant, world, deadlines=deadlines, episodes=1, out=out)
        episode = trial.run().episodes[0]
        assert all(
            HIDDEN not in info.get("current_target_gate_pos", ()) for info in contestant.told
        )
        return episode, contestant._box.last_output(1 << 20)
    finally:
        contestant.close()
        assert not contestant._box.root.exists()


def write(folder, step):
    folder.mkdir(exist_ok=True)
    file = folder / "pilot.py"
    file.write_text(IMPORTS + controller(step=step))
    return file


def handles():
    return sorted(os.listdir("/proc/self/fd"))


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


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A submission that does nothing wrong, flown once: everything is loaded now."""
    file = write(tmp_path_factory.mktemp("good"), "return Command.NONE, []")
    fly(file)
    return file


@pytest.fixture(autouse=True)
def nothing_is_left_behind(good):
    """Memory, open files and processes are back to where they were, and flying still works."""
    files, used, others = handles(), memory(), set(children())
    yield
    episode, _ = fly(good)
    assert episode.termination == ENDS_WELL
    assert episode.error is None
    assert handles() == files
    assert set(children()) <= others
    assert memory() < used + 32 * 2**20


@pytest.fixture
def outside(tmp_path):
    """A results folder with a secret in it."""
    folder = tmp_path / "results"
    folder.mkdir()
    (folder / "level.yaml").write_text("seed: 4711\n")
    return folder


@pytest.fixture
def server():
    """A port of this machine; nobody has called when the test ends."""
    with socket.create_server(("127.0.0.1", 0)) as made:
        yield made
        made.settimeout(0.0)
        with pytest.raises(BlockingIOError):
            made.accept()


def filled_in(code, outside, server=None):
    key = struct.unpack("<Q", struct.pack("<d", HIDDEN))[0] ^ 0xFFFFFFFFFFFFFFFF
    for name, value in (
        ("secret", outside / "level.yaml"),
        ("outside", outside),
        ("runner", os.getpid()),
        ("port", server.getsockname()[1] if server else 0),
        ("key", key),
    ):
        code = code.replace("{" + name + "}", str(value))
    return code


def check_untouched(outside, entry):
    """Nothing but the recording was written."""
    assert sorted(f.name for f in outside.iterdir()) == ["episode_000.mcap", "level.yaml"]
    assert (outside / "level.yaml").read_text() == "seed: 4711\n"
    assert [f.name for f in entry.iterdir()] == ["pilot.py"]


def check_fatal(tmp_path, outside, code, *reasons, compute="measured"):
    before = set(os.listdir(tempfile.gettempdir()))
    file = write(tmp_path / "entry", "print('so far so good', flush=True)\n        " + code)
    episode, printed = fly(file, outside, compute)
    assert episode.termination in HARMED
    assert episode.error
    assert any(reason in episode.error for reason in reasons)
    # A traceback, or what it said last.
    assert "Traceback" in episode.error or "so far so good" in printed + episode.error
    assert any(event.name == "controller error" for event in recorded(outside)) or (
        episode.termination == "CONTROLLER TIMEOUT"
    )
    check_untouched(outside, tmp_path / "entry")
    new = set(os.listdir(tempfile.gettempdir())) - before
    assert not [name for name in new if name in ("mine", "pickled")]
    return episode


def recorded(folder):
    from crazyarena.runner.judging.referee import Event
    from crazyarena.runner.records import export

    events = export.read(folder / "episode_000.mcap").events
    return [Event(e["event"], e["tick"], e["time"], e["detail"]) for e in events]


@pytest.mark.parametrize("name", QUICK)
def test_ends_its_own_trial_and_nothing_else(tmp_path, outside, name):
    code, reason = FATAL[name]
    check_fatal(tmp_path, outside, filled_in(code, outside), reason)


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in FATAL if n not in QUICK])
def test_ends_its_own_trial_and_nothing_else_at_length(tmp_path, outside, name):
    code, reason = FATAL[name]
    check_fatal(tmp_path, outside, filled_in(code, outside), reason)


# Disk

KINDS = ("bubblewrap", "bubblewrap that cannot limit", "mount namespace", "none")


@pytest.fixture
def kind(request, monkeypatch):
    """Fly as on machines that allow less than this one; skips what this one does not allow."""
    if request.param == KINDS[1]:
        monkeypatch.setattr(bubblewrap, "can_limit", lambda bwrap: False)
    elif request.param in KINDS[2:]:
        monkeypatch.setattr(bubblewrap, "program", lambda: None)
        monkeypatch.setattr(process, "MOUNT", request.param == KINDS[2])
    if request.param in KINDS[:2] and bubblewrap.program() is None:
        pytest.skip("no bubblewrap here")
    return request.param


def check_filler(tmp_path, outside, name):
    code, reasons = FILLERS[name]
    # Patience enough to see what ends it, on whatever machine.
    check_fatal(tmp_path, outside, code, *reasons, compute="free")


@pytest.mark.parametrize("name", ["many_big_files"])
def test_the_disk_is_not_filled(tmp_path, outside, name):
    check_filler(tmp_path, outside, name)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, indirect=True)
@pytest.mark.parametrize("name", FILLERS)
def test_the_disk_is_not_filled_on_any_machine(tmp_path, outside, name, kind):
    check_filler(tmp_path, outside, name)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, indirect=True)
def test_what_is_in_force_is_said_and_the_copy_is_whole(tmp_path, kind):
    folder = tmp_path / "entry"
    (folder / "data" / "deep").mkdir(parents=True)
    (folder / "data" / "deep" / "numbers.txt").write_text("1 2 3\n")
    step = (
        "here = os.path.dirname(os.path.abspath(__file__))\n"
        "        words = open(here + '/data/deep/numbers.txt').read()\n"
        "        open(here + '/data/deep/more.txt', 'w').write(words * 3)\n"
        "        open(os.environ['HOME'] + '/h', 'w').close()\n"
        "        open(os.environ['TMPDIR'] + '/t', 'w').close()\n"
        "        open('in_work', 'w').close()\n"
        "        print('copy is', repr(words), os.getcwd(), flush=True)\n"
        "        return Command.NONE, []"
    )
    (folder / "edit_this.py").write_text(IMPORTS + controller(step=step))
    contestant = Sandboxed(folder, LIMITS)
    announced = contestant.announcement
    watched = "watched" in announced
    contestant.close()
    assert "disk 64 MiB" in announced
    assert watched == (kind in (KINDS[1], KINDS[3]))
    episode, printed = fly(folder)
    assert episode.error is None
    assert "copy is '1 2 3\\n'" in printed
    assert (folder / "data" / "deep" / "numbers.txt").read_text() == "1 2 3\n"
    assert sorted(p.name for p in (folder / "data" / "deep").iterdir()) == ["numbers.txt"]


@pytest.mark.parametrize("kind", [KINDS[3]], indirect=True)
def test_nobody_flies_on_when_the_watch_is_gone(tmp_path, good, kind):
    contestant = Sandboxed(good, LIMITS)
    try:
        contestant._quota.kill()
        contestant._quota.wait()
        with pytest.raises(InputError, match="nobody watches"):
            contestant.make([0.0] * 12, LEVEL, np.zeros(12))
    finally:
        contestant.close()


# What is denied


def check_denied(tmp_path, outside, server):
    """One submission, one attack a step; each must fail, and the trial must go on."""
    attacks = [(name, filled_in(code, outside, server)) for name, code in DENIED.items()]
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
    episode, printed = fly(
        write(tmp_path / "entry", textwrap.indent(step, " " * 8).strip()), out=outside
    )
    assert episode.termination == ENDS_WELL, episode.error
    lines = printed.splitlines()
    assert [line for line in lines if line.startswith("BREACH")] == []
    assert sum(line.startswith("denied") for line in lines) == len(DENIED)
    check_untouched(outside, tmp_path / "entry")


def test_is_denied_what_is_not_its_own(tmp_path, outside, server):
    check_denied(tmp_path, outside, server)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS[1:], indirect=True)
def test_is_denied_what_is_not_its_own_on_any_machine(tmp_path, outside, server, kind):
    check_denied(tmp_path, outside, server)


def test_who_looks_through_memory_finds_what_is_there(tmp_path, outside):
    """The search for the hidden pose does find numbers that the contestant was told."""
    code = filled_in(DENIED["pose_in_memory"], outside)
    hidden = struct.unpack("<Q", struct.pack("<d", HIDDEN))[0] ^ 0xFFFFFFFFFFFFFFFF
    known = struct.unpack("<Q", struct.pack("<d", 1.7))[0] ^ 0xFFFFFFFFFFFFFFFF
    code = code.replace(str(hidden), str(known)).strip()
    once = "if len(self.calls) > 1:\n    return Command.NONE, []\n" + code
    step = textwrap.indent(once, " " * 8).strip() + (
        "\n        print('found', found, flush=True)\n        return Command.NONE, []"
    )
    episode, printed = fly(write(tmp_path / "entry", step))
    assert episode.error is None
    assert "found" in printed


def test_there_are_enough_attacks():
    assert len(FATAL) + len(FILLERS) + len(DENIED) >= 50


def test_a_fork_bomb_dies_with_its_trial(tmp_path):
    code = "while True:\n            os.fork()"
    before = set(children())
    episode, _ = fly(write(tmp_path / "entry", code), compute="measured")
    assert episode.termination in HARMED
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
    contestant = Sandboxed(write(tmp_path / "entry", code), LIMITS)
    Trial(LEVEL, contestant, PathWorld(lambda t: PLACE), episodes=1).run()
    contestant.close()
    # The kernel ends a killed group process by process.
    eventually(lambda: not _started_in(str(contestant._box.root)))


def _started_in(folder):
    """Processes that name a folder in their command line."""
    found = []
    for name in os.listdir("/proc"):
        if name.isdigit():
            with contextlib.suppress(OSError), open(f"/proc/{name}/cmdline") as stream:
                if folder in stream.read():
                    found.append(name)
    return found


@pytest.mark.parametrize(
    ("init", "words"),
    [
        ("os._exit(4)", "exit code 4"),
        ("raise OSError('gone')", "OSError: gone"),
        ("sys.exit('bye')", "bye"),
        ("ctypes.string_at(0)", "SIGSEGV"),
        ("[open(f'{k}', 'wb').write(b'x' * (10 << 20)) for k in range(99)]", "No space left"),
        ("[open(f'{k}', 'w').close() for k in range(10**6)]", "files"),
    ],
)
def test_a_constructor_that_fails_is_bad_input(tmp_path, init, words):
    file = tmp_path / "pilot.py"
    file.write_text(IMPORTS + controller(init=init))
    contestant = Sandboxed(file, LIMITS)
    try:
        if bubblewrap.program() is None and "open(" in init:
            pytest.skip("other words without bubblewrap")
        with pytest.raises(InputError, match=words):
            contestant.make([0.0] * 12, load_level("level0"), np.zeros(12))
    finally:
        contestant.close()


def test_a_constructor_that_hangs_is_bad_input(tmp_path):
    file = tmp_path / "pilot.py"
    file.write_text(IMPORTS + controller(init="clock.sleep(100)"))
    contestant = Sandboxed(file, Limits(make_timeout=1.0))
    try:
        with pytest.raises(InputError, match="within 1 s"):
            contestant.make([0.0] * 12, load_level("level0"), np.zeros(12))
    finally:
        contestant.close()


def test_the_traceback_and_the_last_output_are_kept(tmp_path):
    code = "print('nearly there', flush=True)\n        os._exit(7)"
    episode, _ = fly(write(tmp_path / "entry", code))
    assert "exit code 7" in episode.error
    assert "nearly there" in episode.error
    episode, _ = fly(write(tmp_path / "other", "return self.no_such_thing"))
    assert "AttributeError" in episode.error
    assert "pilot.py" in episode.error
    assert Path(episode.error.split('File "')[1].split('"')[0]).name == "pilot.py"


@pytest.mark.parametrize("kind", [KINDS[2]], indirect=True)
def test_a_root_of_its_own_needs_no_bubblewrap(tmp_path, good, kind):
    contestant = Sandboxed(good, LIMITS)
    try:
        if "watched" in contestant.announcement:
            pytest.skip("no mounts here")
        assert "root of its own" in contestant.announcement
        assert contestant.description["missing"] == []
        assert contestant.description["isolated"]
    finally:
        contestant.close()


def test_a_single_file_brings_only_itself(tmp_path):
    (tmp_path / "entry").mkdir()
    (tmp_path / "entry" / "two.py").write_text("TRICK = 42\n")
    step = (
        "print('beside me:', sorted(os.listdir(os.path.dirname(__file__))), flush=True)\n"
        "        return Command.NONE, []"
    )
    _, printed = fly(write(tmp_path / "entry", step))
    assert "beside me: ['pilot.py']" in printed


def test_a_sparse_terabyte_is_refused_by_its_size(tmp_path):
    write(tmp_path, "return Command.NONE, []").rename(tmp_path / "edit_this.py")
    with open(tmp_path / "data.bin", "wb") as stream:
        stream.truncate(1 << 40)
    for load in (lambda: Sandboxed(tmp_path), lambda: Submission(tmp_path, tmp_path / "work")):
        with pytest.raises(InputError, match=r"data\.bin: 1 TiB; .* 1 GiB\. Leave out"):
            load()
    os.unlink(tmp_path / "data.bin")
    with open(tmp_path / "edit_this.py", "ab") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(InputError, match=r"edit_this\.py: 1 TiB; .* 16 MiB"):
        Sandboxed(tmp_path)


def test_times_are_the_judges(tmp_path):
    """A contestant that claims to have learned in no time is timed all the same."""
    file = tmp_path / "pilot.py"
    file.write_text(
        IMPORTS
        + controller(step="clock.sleep(0.02)\n        return Command.NONE, []")
        + "    def interStepLearn(self, *arguments):\n        clock.sleep(0.05)\n"
        + "clock.perf_counter = lambda: 0.0\n"
    )
    episode, _ = fly(file)
    assert episode.error is None
    # Where between learning and commanding a busy machine puts the word that it has learned is
    # its own affair; together they cannot have been shorter.
    command, learning = episode.compute_ms["p50"] / 1e3, episode.interstep_learning_average
    assert command + learning >= 0.07
    assert min(command, learning) >= 0.01


def test_a_contestant_may_not_use_up_everybodys_day(tmp_path):
    file = write(tmp_path, "clock.sleep(0.1)\n        return Command.NONE, []")
    for budget, words in (
        (Budget(step=0.05), r"step 0: no answer within 0.05 s of wall time"),
        (Budget(episode=0.25), r"in this episode; 0.25 s are allowed"),
        (Budget(trial=0.25), r"in this trial; 0.25 s are allowed"),
    ):
        contestant = Sandboxed(file, LIMITS)
        try:
            deadlines = Deadlines(compute=Compute("free", budget=budget))
            trial = Trial(
                LEVEL, contestant, PathWorld(lambda t: PLACE), deadlines=deadlines, episodes=1
            )
            episode = trial.run().episodes[0]
        finally:
            contestant.close()
        assert episode.termination == "CONTROLLER TIMEOUT"
        assert re.search(words, episode.error)


@pytest.mark.parametrize(
    "hang",
    [
        "while True:\n            pass",
        "clock.sleep(1000)",
        "while True:\n            try:\n                clock.sleep(1000)\n"
        "            except BaseException:\n                if self.calls.append(0) or"
        " len(self.calls) > 3:\n                    raise",
    ],
)
def test_what_hangs_in_this_process_is_interrupted(tmp_path, hang):
    """Without a sandbox; even if it catches what interrupts it, once or twice."""
    # Somebody else's, as of a limit for this test.
    alarm = signal.getsignal(signal.SIGALRM), signal.getitimer(signal.ITIMER_REAL)[0] > 0
    contestant = InProcess(Submission(write(tmp_path / "entry", hang), tmp_path / "work"))
    try:
        deadlines = Deadlines(compute=Compute("free", budget=Budget(step=0.2)))
        trial = Trial(
            LEVEL, contestant, PathWorld(lambda t: PLACE), deadlines=deadlines, episodes=1
        )
        episode = trial.run().episodes[0]
    finally:
        contestant.close()
    assert episode.termination == "CONTROLLER TIMEOUT"
    assert "step 0: no answer within 0.2 s" in episode.error
    assert "pilot.py" in episode.error
    assert (signal.getsignal(signal.SIGALRM), signal.getitimer(signal.ITIMER_REAL)[0] > 0) == alarm


@pytest.mark.parametrize("where", ["in process", "sandbox"])
def test_what_it_says_is_shown_and_not_obeyed(tmp_path, where):
    code = r"raise RuntimeError('\x1b[2J\x1b]0;owned\x07 [bold red]markup[/] \ud800 \u202e \x9b')"
    file = write(tmp_path / "entry", code)
    if where == "sandbox":
        episode, _ = fly(file)
    else:
        contestant = InProcess(Submission(file, tmp_path / "work"))
        trial = Trial(LEVEL, contestant, PathWorld(lambda t: PLACE), episodes=1)
        episode = trial.run().episodes[0]
        contestant.close()
    assert episode.error.isprintable() or "\n" in episode.error
    assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e\ud800]", episode.error)
    assert r"\x1b[2J" in episode.error
    episode.error.encode()


@pytest.mark.parametrize(
    "hoard",
    [
        # Too much for all of them together, for none alone.
        "for _ in range(6):\n            if os.fork() == 0:\n"
        "                hog = np.ones(6 << 20)\n                clock.sleep(60)\n"
        "        clock.sleep(60)",
        # What is shared counts once, but it counts.
        "import mmap\n        hog = mmap.mmap(-1, 300 << 20)\n"
        "        hog.write(bytes(300 << 20))\n        clock.sleep(60)",
        # Files in its own file system, and as much beside them.
        "for k in range(3):\n            open(f'{k}', 'wb').write(bytes(20 << 20))\n"
        "        hog = np.ones(23 << 20)\n        clock.sleep(60)",
    ],
)
def test_memory_is_limited_in_all(tmp_path, hoard):
    file = write(tmp_path / "entry", hoard)
    contestant = Sandboxed(file, replace(LIMITS, memory=230 << 20))
    try:
        deadlines = Deadlines(compute=Compute("free"))
        trial = Trial(
            LEVEL, contestant, PathWorld(lambda t: PLACE), deadlines=deadlines, episodes=1
        )
        episode = trial.run().episodes[0]
    finally:
        contestant.close()
    if "watched" in contestant.announcement and "open(" in hoard:
        pytest.skip("no file system in memory here")
    assert "more than 230 MiB of memory in all" in episode.error
