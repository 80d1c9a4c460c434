"""The runner's side of a contestant in a process of its own."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import secrets
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import CrazyarenaError, InputError
from crazyarena.levels.schema import Level
from crazyarena.plain_text import shown
from crazyarena.runner.contestant.dialogue import Answer, Question
from crazyarena.runner.contestant.interrupt import Interrupt
from crazyarena.runner.contestant.sandbox import bubblewrap, quota, wire
from crazyarena.runner.contestant.sandbox.announcement import announcement
from crazyarena.runner.contestant.sandbox.box import Box
from crazyarena.runner.contestant.sandbox.confine import may_mount, open_to_others, readable
from crazyarena.runner.contestant.sandbox.environment import environment
from crazyarena.runner.contestant.sandbox.limits import Limits
from crazyarena.runner.contestant.sandbox.own_user import own_user
from crazyarena.runner.contestant.submission import check_size, entry_file, submission_hash

_START_TIMEOUT = 60.0  # s, for the interpreter to come up
_SENDING = 1.0  # s, for a question to find room in the channel
_LOOK = 0.25  # s, between looks at how many files there are, while nothing else happens
_MIB = 2**20
# Tests of what happens on machines that allow no mounts set this to False.
MOUNT = True


class SandboxError(CrazyarenaError):
    """The contestant's process could not be confined as asked for, or not started."""


class Sandboxed:
    """A :class:`~crazyarena.runner.contestant.dialogue.Contestant` behind walls.

    Parameters
    ----------
    submission: folder or .py file; it is copied, nothing is ever written to it.
    limits: resources of the process.
    require: refuse to go on unless files, network and other processes are shut off.
    parameters: plain data that the contestant is told, as JSON in the environment variable
        ``CRAZYARENA_PARAMETERS`` and as ``parameters`` of what its constructor is given.

    Raises
    ------
    InputError: no submission there, or importing it failed (with its traceback).
    SandboxError: ``require`` and a wall is missing, or the process does not start.
    """

    def __init__(
        self,
        submission: Path,
        limits: Limits | None = None,
        *,
        require: bool = False,
        parameters: Mapping[str, object] | None = None,
    ) -> None:
        self._parameters = dict(parameters or {})
        self.path = submission.expanduser().resolve()
        self._limits = limits or Limits()
        self._require = require
        self._begin()

    def _begin(self) -> None:
        self._step: int | None = None
        self._ticket = 0
        self._asked_at = 0.0
        self._learned_at: float | None = None
        self._inner: int | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: socket.socket | None = None
        self._files: int | None = None
        self._quota: subprocess.Popen[str] | None = None
        self._shown, self.digest, self._box = self._copied()
        try:
            self._start()
            self.description = self._await_ready(self._require)
            self._prefer()
            self._request(
                "load", self._loading(), self._limits.make_timeout, "importing the submission"
            )
        except BaseException:
            self.close()
            raise

    def _renew(self) -> None:
        """A process that has ended, or was ended, is followed by one that knows nothing of it."""
        flown = self.digest
        self.close()
        self._begin()
        if self.digest != flown:
            raise InputError(f"{self._shown}: changed while it was flown; fly it again")

    def _copied(self) -> tuple[Path, str, Box]:
        """File to name in messages, digest, and the box with a copy of the submission."""
        shown = entry_file(self.path)
        check_size(self.path, self._limits.copy_size, self._limits.files)
        return shown, submission_hash(self.path), Box(self.path, self._limits.copy_size)

    def _loading(self) -> object:
        """What its process has to know to load it."""
        return None

    @property
    def announcement(self) -> str:
        """What is in force, for the terminal."""
        return announcement(self.description)

    # Contestant

    learns = True

    def heed(self, interrupt: Interrupt) -> None:
        """Nothing to interrupt: its code runs elsewhere."""

    def make(self, obs: list[Any], level: Level, start: NDArray[np.float64]) -> None:
        # Both would tell where gates are that nobody has seen yet.
        still = tuple(gate.model_copy(update={"motion": None}) for gate in level.track.gates)
        track = level.track.model_copy(update={"gates": still})
        public = level.model_copy(update={"seed": 0, "track": track})
        payload = (obs, public, start)
        if self._step is not None and self.wait(self._limits.make_timeout) is None:
            self.kill()  # it still thinks about the last question of an earlier episode
        if self._process is None or self._process.poll() is not None:
            self._renew()
        self._request("make", payload, self._limits.make_timeout, "Controller(...)")

    def ask(self, question: Question) -> None:
        self._step = question.step
        # Told to nobody but in the question: an answer that bears it was made to this one.
        self._ticket = secrets.randbits(62)
        self._learned_at = None
        self._asked_at = time.perf_counter()
        self._send("ask", (self._ticket, question))

    def wait(self, timeout: float) -> Answer | None:
        if self._step is None:
            return None
        left = timeout
        while True:
            began = time.perf_counter()
            try:
                message = self._receive(left)
            except _Dead as error:
                return self._failure(str(error))
            except wire.ChannelError as error:
                self.kill()
                return self._failure(f"its process wrote garbage to the runner: {error}")
            if message is None:
                return None
            now = time.perf_counter()
            if not self._is_asked_for(message):
                self.kill()
                return self._failure("its process sent an answer that was not asked for")
            if not isinstance(message, wire.Text) or message.kind != wire.LEARNED:
                return self._answer(message, now)
            self._learned_at = now
            left = max(0.0, left - (now - began))

    def _is_asked_for(self, message: wire.Message) -> bool:
        if isinstance(message, Answer | wire.LsyAnswer):
            return message.step == self._ticket
        if not isinstance(message, wire.Text) or message.number != self._ticket:
            return False
        return message.kind == wire.FAILED or (
            message.kind == wire.LEARNED and self._learned_at is None
        )

    def _answer(self, message: wire.Message, now: float) -> Answer:
        """With the times that passed here; the contestant is not asked for them."""
        step, self._step = self._step or 0, None
        learned = self._asked_at if self._learned_at is None else self._learned_at
        seconds, learning = now - self._asked_at, learned - self._asked_at
        if isinstance(message, wire.Text):
            text = self._named(message.text)
            return Answer(step, None, text, seconds, learn_seconds=learning)
        if isinstance(message, wire.LsyAnswer):
            message.step, message.seconds = step, seconds
            # What it says of its own times cannot be more than passed here.
            message.command_seconds = min(message.command_seconds, seconds)
            message.callback_seconds = min(message.callback_seconds, seconds)
            return cast(Answer, message)  # a contract's own kind, which its subclass asks for
        assert isinstance(message, Answer)
        # Of a question that asks for no command, nothing but the learning was done.
        command = now - learned if message.asked is not None else 0.0
        drawings = message.drawings
        return Answer(step, message.asked, None, seconds, command, learning, drawings=drawings)

    def hook(self, name: str) -> tuple[float, str | None]:
        started = time.perf_counter()
        try:
            self._send("hook", name)
            message = self._receive(self._limits.hook_timeout)
            # The run may have ended before its last question was answered.
            while self._is_late(message):
                message = self._receive(self._limits.hook_timeout)
            self._step = None
        except (_Dead, wire.ChannelError) as error:
            return time.perf_counter() - started, f"{name}: {error}{self._last_words()}"
        seconds = time.perf_counter() - started
        if message is None:
            self.kill()
            return seconds, f"{name} did not return within {self._limits.hook_timeout:g} s"
        if not isinstance(message, wire.Text) or message.kind != wire.HOOKED:
            self.kill()
            return seconds, f"{name}: its process sent something else"
        return seconds, self._named(message.text) or None

    def _is_late(self, message: wire.Message | None) -> bool:
        """Whether it belongs to the last question; at most two do."""
        if self._step is None or message is None or not self._is_asked_for(message):
            return False
        if isinstance(message, wire.Text) and message.kind == wire.LEARNED:
            self._learned_at = time.perf_counter()
        else:
            self._step = None
        return True

    def close(self) -> None:
        """Kill the process with all it started and delete its files; idempotent."""
        self.kill()
        if self._channel is not None:
            self._channel.close()
            self._channel = None
        if self._files is not None:
            os.close(self._files)
            self._files = None
        self._box.remove()

    # The process

    def kill(self) -> None:
        """End the process and everything it started, now."""
        process = self._process
        if process is None:
            return
        for pid in (self._inner, process.pid):
            if pid is not None and process.poll() is None:
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.kill(pid, signal.SIGKILL)
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=10.0)
        if self._quota is not None:
            with self._quota as watch:
                watch.kill()
            self._quota = None

    @property
    def pid(self) -> int | None:
        """Process id, None before it was started."""
        return None if self._process is None else self._process.pid

    def _start(self) -> None:
        box, limits = self._box, self._limits
        bwrap = bubblewrap.program()
        root = os.getuid() == 0
        # bubblewrap and a root of its own show the interpreter to everybody, wherever it is.
        drop = root and (bwrap is not None or open_to_others(MOUNT and may_mount()))
        user = own_user() if drop else os.getuid()
        if drop:
            box.give_to(user, user)
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._channel = ours
        command: list[str] = []
        size, inodes = box.size + limits.disk, box.count + limits.files
        if bwrap is not None:
            own = bubblewrap.can_limit(bwrap)
            disk = "bubblewrap" if own else "wrapped"
            command = bubblewrap.prefix(
                bwrap, readable(), box.files, box.work, root, box.given, size if own else None
            )
        else:
            disk = "mount" if MOUNT else "none"
        command += [sys.executable, "-s", "-m", "crazyarena.runner.contestant.sandbox.child"]
        command += [str(theirs.fileno()), str(box.files), str(box.given), str(box.submission)]
        command += [disk, str(user), json.dumps(asdict(limits)), str(size), str(inodes)]
        with theirs, open(box.output, "ab") as output:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                cwd=box.work,
                env=environment(self._box, self._parameters),
                pass_fds=(theirs.fileno(),),
                start_new_session=True,
            )

    def _prefer(self) -> None:
        """Before what else runs here, as the limits say; threads it starts later inherit that."""
        if self._limits.niceness == 0 or self._process is None:
            return
        for pid in quota.descendants(self._process.pid):
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, pid, self._limits.niceness)
                # Linux weighs sessions against each other first, by a niceness of their own.
                Path(f"/proc/{pid}/autogroup").write_text(str(self._limits.niceness))

    def _await_ready(self, require: bool) -> dict[str, Any]:
        try:
            message = self._receive_ready()
            if isinstance(message, int):
                self._inner = message
                message = self._receive_ready()
            if not isinstance(message, wire.Text) or message.kind != wire.READY:
                raise wire.ChannelError("it did not report to be ready")
            report = json.loads(message.text)
        except (_Dead, wire.ChannelError, ValueError) as error:
            raise SandboxError(
                f"{self._shown}: the contestant's process did not start: {error}"
                f"{self._last_words()}"
            ) from None
        if require and not report["complete"]:
            raise SandboxError(
                "--require-sandbox: this machine does not shut off "
                f"{', '.join(report['missing'])}; install bubblewrap, or allow "
                "namespaces of users, or use a kernel with Landlock and seccomp"
            )
        notes = list(report["notes"])
        if os.getuid() == 0 and report["processes_limited"]:
            notes.append("unprivileged user")
        if not report["processes_limited"]:
            notes.append("processes not counted (super-user)")
        notes.append(f"memory {self._limits.memory // _MIB} MiB")
        disk = f"disk {self._limits.disk // _MIB} MiB"
        own = "file system of its own" if report["own_files"] else "watched"
        notes.append(f"{disk} ({own})")
        self._watch(report["own_files"])
        limits = asdict(self._limits)
        return {
            "process": "its own",
            "isolated": bool(report["complete"]),
            "sandbox": notes,
            "missing": report["missing"],
            "limits": limits,
        }

    def _receive_ready(self) -> wire.Message | None:
        """As :meth:`_receive`; its own folder comes along, before it runs foreign code."""
        assert self._channel is not None
        self._channel.settimeout(_START_TIMEOUT)
        try:
            packet, files, _, _ = socket.recv_fds(self._channel, wire.MAX_PACKET, 1)
        except TimeoutError:
            return None
        except OSError as error:
            raise _Dead(self._obituary(str(error))) from None
        if files:
            self._files = files[0]
            os.set_inheritable(self._files, False)
        if not packet:
            raise _Dead(self._obituary("it closed the channel"))
        return wire.decode(packet)

    def _watch(self, own_files: bool) -> None:
        """Measure from a process beside this one what no limit of the system bounds."""
        assert self._process is not None
        box, limits = self._box, self._limits
        if not own_files and self._files is not None:
            os.close(self._files)
            self._files = None
        files = -1 if self._files is None else self._files
        folder = "" if own_files else str(box.files)
        numbers = (box.size + limits.disk, box.count + limits.files, self._process.pid)
        what = [folder, *map(str, (*numbers, limits.memory, files))]
        self._quota = subprocess.Popen(
            [sys.executable, "-I", "-S", quota.__file__, *what],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            pass_fds=() if self._files is None else (files,),
        )

    def _excess(self) -> str | None:
        """What it has too much of, in words. Its own file system bounds the bytes by itself."""
        if self._files is not None:
            status = os.fstatvfs(self._files)
            limit = self._box.count + self._limits.files
            excess = quota.words(0, status.f_files - status.f_ffree, 0, limit)
            if excess is not None:
                return excess
        if self._quota is not None and self._quota.stdout is not None:
            # It speaks before it ends anybody.
            said, _, _ = select.select([self._quota.stdout], [], [], 0.0)
            if said:
                return self._quota.stdout.readline().strip() or "nobody watches its memory any more"
        return None

    def _request(self, verb: str, payload: object, timeout: float, what: str) -> None:
        """Send, wait for success; raises InputError with the reason otherwise."""
        try:
            self._send(verb, payload)
            message = self._receive(timeout)
        except (_Dead, wire.ChannelError) as error:
            self.kill()
            raise InputError(f"{self._shown}: {what}: {error}{self._last_words()}") from None
        if isinstance(message, wire.Text) and message.kind == wire.MADE:
            return
        self.kill()
        if message is None:
            raise InputError(f"{self._shown}: {what} did not return within {timeout:g} s")
        if isinstance(message, wire.Text) and message.kind == wire.FAILED:
            raise InputError(self._named(message.text))
        raise InputError(f"{self._shown}: {what}: its process sent something else")

    def _named(self, text: str) -> str:
        """Tracebacks with the submission's own path instead of the copy's."""
        return shown(text.replace(str(self._box.submission), str(self.path)))

    def _send(self, verb: str, payload: object) -> None:
        assert self._channel is not None
        self._channel.settimeout(_SENDING)
        try:
            self._channel.send(pickle.dumps((verb, payload), protocol=5))
        except TimeoutError:
            # It was never asked a second question before it had answered the first.
            self.kill()
        except OSError:
            pass  # if the other end is gone the next receive says so, with the reason

    def _receive(self, timeout: float) -> wire.Message | None:
        assert self._channel is not None
        left = max(0.0, timeout)
        while True:
            excess = self._excess()
            if excess is not None:
                self.kill()
                raise _Dead(excess)
            slice_ = min(left, _LOOK)
            left -= slice_
            self._channel.settimeout(slice_)
            try:
                packet = self._channel.recv(wire.MAX_PACKET)
                break
            except (TimeoutError, BlockingIOError):
                if left <= 0.0:
                    return None
            except OSError as error:
                raise _Dead(self._obituary(str(error))) from None
        if not packet:
            raise _Dead(self._obituary("it closed the channel"))
        return wire.decode(packet)

    def _obituary(self, otherwise: str) -> str:
        assert self._process is not None
        excess = self._excess()
        if excess is not None:
            self.kill()
            return excess
        try:
            code = self._process.wait(timeout=0.5)
        except subprocess.TimeoutExpired:
            self.kill()
            return otherwise
        # bubblewrap tells a signal as 128 and its number, as a shell does.
        number = -code if code < 0 else code - 128 if code > 128 else 0
        if number:
            with contextlib.suppress(ValueError):
                return f"its process was ended by {signal.Signals(number).name}"
        return f"its process ended with exit code {code}"

    def _failure(self, text: str) -> Answer:
        step, self._step = self._step or 0, None
        seconds = time.perf_counter() - self._asked_at
        return Answer(step, None, f"step {step}: {text}{self._last_words()}", seconds)

    def _last_words(self) -> str:
        words = shown(self._box.last_output()).strip()
        return f"\nIts last output:\n{words}" if words else ""


class _Dead(Exception):
    """The contestant's process is no more."""
