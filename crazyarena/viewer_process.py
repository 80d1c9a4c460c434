"""Starts the viewer of a live flight: a process of its own, which the flight never waits for."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from crazyarena.clock import WallClock
from crazyarena.errors import DependencyMissing, InputError
from crazyarena.live import Live

# By name, so that what flies need not know what draws.
_MODULE = "crazyarena.runner.viewer"
_STARTING = 90.0  # s; imports on a loaded machine
_ENDING = 4.0  # s
_OPENING = 30.0  # s
_LOOK = 0.1  # s


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """How a viewer is opened.

    host, port: that it listens at; port 0 takes any that is free. token: file with the secret that
    lets browsers elsewhere stop, land and arm; None lets nobody but this machine's own.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    token: Path | None = None


class View:
    """A live flight, and its viewer if one is asked for.

    Several flights of one command may share it, one after the other.
    """

    def __init__(
        self,
        options: ViewOptions | None,
        say: Callable[[str], None],
        vehicles: int = 1,
    ) -> None:
        self.live = Live(vehicles)
        self._say = say
        self._viewer: ViewerProcess | None = None
        if options is None:
            return
        try:
            self._viewer = ViewerProcess(self.live.file, options)
        except BaseException:
            self.live.close()
            raise
        say(f"Viewer: {self._viewer.url}")

    @property
    def shown(self) -> bool:
        """Whether there is a page that people can open."""
        return self._viewer is not None and self._viewer.running

    def await_browser(self) -> None:
        """Let people, if there are any, open the page before something short is shown."""
        if self._viewer is None or not sys.stdout.isatty():
            return
        self._say(f"Open it now: the flight begins then, or in {_OPENING:g} s.")
        clock = WallClock()
        end = clock.now() + _OPENING
        while not self.live.reply().get("browsers") and clock.now() < end:
            clock.sleep_until(clock.now() + _LOOK)

    def finish(self) -> None:
        """The last flight is over; its page stays as long as somebody has it open. Idempotent."""
        self.live.close()
        if self._viewer is not None:
            self._viewer.linger(self._say)
            self._viewer = None

    def close(self) -> None:
        """End everything now; idempotent."""
        self.live.close()
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None


class ViewerProcess:
    """A viewer of the live flight ``file`` (:class:`crazyarena.live.Live`).

    Raises
    ------
    DependencyMissing: viser is not installed.
    InputError: the address cannot be had, or the token cannot be read.
    """

    def __init__(self, file: Path, options: ViewOptions) -> None:
        command = [sys.executable, "-m", _MODULE, str(file)]
        command += ["--host", options.host, "--port", str(options.port)]
        if options.token is not None:
            command += ["--token", str(options.token)]
        # A session of its own: Ctrl-C is for the flight, and means to land.
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            start_new_session=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )
        self.url = self._address()

    def _address(self) -> str:
        clock = WallClock()
        end = clock.now() + _STARTING
        data = b""
        assert self._process.stdout is not None
        stream = self._process.stdout.fileno()
        while b"\n" not in data and (left := end - clock.now()) > 0.0:
            if select.select([stream], [], [], left)[0]:
                more = os.read(stream, 4096)
                if not more:
                    break
                data += more
        try:
            told = json.loads(data)
        except ValueError:
            told = {}
        if "url" in told:
            return str(told["url"])
        self.close()
        if "missing" in told:
            raise DependencyMissing(*told["missing"])
        raise InputError(told.get("error") or "the viewer did not start; see above")

    @property
    def running(self) -> bool:
        """Whether anybody can still look."""
        return self._process.poll() is None

    def linger(self, say: Callable[[str], None]) -> None:
        """Stay after the flight as long as a browser shows it; Ctrl-C ends that."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_ENDING)
        if self.running:
            say(f"{self.url} stays until it is closed; Ctrl-C ends it.")
        self.stay()

    def stay(self) -> None:
        """Until the flight is over and the last browser is closed; Ctrl-C ends it."""
        with contextlib.suppress(KeyboardInterrupt):
            self._process.wait()
        self.close()

    def close(self) -> None:
        """End it; idempotent."""
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(_ENDING)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()
