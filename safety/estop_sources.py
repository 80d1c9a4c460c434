"""Where an emergency stop comes from: keyboard, gamepad, the network; another shell is
:mod:`.estop_socket`.

Each source runs in a thread of its own, and from it pulls a
:class:`~crazyarena.safety.estop.StopButton`.
"""

from __future__ import annotations

import contextlib
import os
import select
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from crazyarena.errors import DependencyMissing, InputError
from crazyarena.mocap.zenoh_session import open_session
from crazyarena.plain_text import shown_line
from crazyarena.safety.estop import DeadMan, StopButton, say_loudly
from crazyarena.safety.estop_local import MOST_REASON, runtime_folder, stop_local
from crazyarena.safety.estop_socket import SocketSource
from crazyarena.safety.estop_token import MAX_BYTES, TokenCheck, make_message

__all__ = [
    "ZENOH_KEY",
    "ZENOH_SESSION_KEY",
    "GamepadSource",
    "KeyboardSource",
    "SocketSource",
    "ZenohSource",
    "keyboard_trouble",
    "open_gamepad",
    "runtime_folder",
    "stop_local",
    "stop_over_zenoh",
]

ZENOH_KEY = "crazyarena/estop"
ZENOH_SESSION_KEY = "crazyarena/estop/session"

_KEYS = 4096  # bytes, read at once: a stop must not wait behind what somebody pasted
_TICK = 0.1  # s, at which threads look whether they should end
_STOP_KEYS = frozenset(" \r\n\x1bqQ")
_HOLD_KEYS = frozenset("hH")


class ZenohSource:
    """Listens for stops on a zenoh key; says which session it is on another.

    Parameters
    ----------
    check: with a secret, what bears no valid token is refused and counted.
    connect, listen: zenoh endpoints, see :func:`crazyarena.mocap.zenoh_session.open_session`.
    """

    def __init__(
        self,
        stop: StopButton,
        check: TokenCheck,
        connect: Sequence[str] = (),
        listen: Sequence[str] = (),
        key: str = ZENOH_KEY,
    ) -> None:
        self._stop = stop
        self.check = check
        self._session = open_session(connect, listen, network=True)
        import zenoh

        handler = zenoh.handlers.Callback(self._receive, indirect=False)
        self._subscriber = self._session.declare_subscriber(key, handler)
        self._queryable = self._session.declare_queryable(f"{key}/session", self._answer)

    def _receive(self, sample: Any) -> None:
        # In a thread of zenoh's, which nothing that is sent may end.
        try:
            payload = sample.payload
            # What is longer is no message of ours, and not copied to be looked at.
            reason = self.check.accept(payload.to_bytes() if len(payload) <= MAX_BYTES else b"")
            if reason is not None:
                self._stop.trigger("zenoh", shown_line(reason))
        except Exception as error:
            say_loudly(f"a message over zenoh was not understood: {type(error).__name__}: {error}")

    def _answer(self, query: Any) -> None:
        with contextlib.suppress(Exception):  # who asked may be gone
            query.reply(query.key_expr, self.check.session)

    def close(self) -> None:
        """Leave the network."""
        self._subscriber.undeclare()
        self._queryable.undeclare()
        self._session.close()


def stop_over_zenoh(
    secret: bytes | None,
    reason: str = "",
    connect: Sequence[str] = (),
    key: str = ZENOH_KEY,
    patience: float = 1.0,
) -> list[str]:
    """Send a stop to every session on the network; returns the sessions that were found.

    Sent at once for whoever needs no session name, and again to each session that answers
    within ``patience`` s.
    """
    reason = shown_line(reason, MOST_REASON)
    session = open_session(connect, network=True)
    try:
        import zenoh

        publisher = session.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
            reliability=zenoh.Reliability.RELIABLE,
        )
        found: list[str] = []
        deadline = _Deadline(patience)
        publisher.put(make_message(secret, reason))
        while not found and deadline.left() > 0.0:
            # The network of peers takes a moment to form; the question is repeated until then.
            for reply in session.get(f"{key}/session", timeout=min(0.3, deadline.left() + 0.05)):
                if reply.ok is not None:
                    found.append(reply.ok.payload.to_string())
            publisher.put(make_message(secret, reason))
        for name in found:
            publisher.put(make_message(secret, reason, name))
        deadline.wait(0.05)
        return found
    finally:
        session.close()


class _Deadline:
    """Time left of a wait, on the monotonic clock."""

    def __init__(self, seconds: float) -> None:
        from crazyarena.clock import WallClock

        self._clock = WallClock()
        self._end = self._clock.now() + seconds

    def left(self) -> float:
        return max(0.0, self._end - self._clock.now())

    def wait(self, seconds: float) -> None:
        self._clock.sleep_until(self._clock.now() + seconds)


def keyboard_trouble(stream: int) -> str | None:
    """Why keys cannot be read from a file descriptor; None if they can."""
    if not os.isatty(stream):
        return "standard input is no terminal"
    with contextlib.suppress(OSError):  # a terminal, but not the one that controls this process
        if os.tcgetpgrp(stream) != os.getpgrp():
            return "this program runs in the background of its terminal; bring it to the front"
    return None


class KeyboardSource:
    """Space, Enter, Escape or q in the terminal stops; h, held, is the dead-man's key.

    Parameters
    ----------
    stream: a terminal's file descriptor; standard input by default.
    say: told when its keys cannot stop any more.
    """

    def __init__(
        self,
        stop: StopButton,
        dead_man: DeadMan | None = None,
        stream: int | None = None,
        say: Callable[[str], None] = say_loudly,
    ) -> None:
        self._say = say
        self._stop = stop
        self._dead_man = dead_man
        self._stream = sys.stdin.fileno() if stream is None else stream
        trouble = keyboard_trouble(self._stream)
        if trouble is not None:
            raise InputError(f"emergency stop by keyboard: {trouble}")
        self._closed = threading.Event()
        self._restore = contextlib.ExitStack()
        # Before anything else: what is pressed before this is thrown away, and after it, counts.
        self._restore.enter_context(_single_keys(self._stream))
        self._thread = threading.Thread(target=self._run, name="estop-keyboard", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                ready, _, _ = select.select([self._stream], [], [], _TICK)
                if not ready:
                    continue
                keys = os.read(self._stream, _KEYS).decode("utf-8", "replace")
            except (BlockingIOError, InterruptedError):
                continue  # somebody else has read them, or made the terminal non-blocking
            except (OSError, ValueError) as error:
                self._say(f"the terminal is gone ({error}): its keys do not stop any more")
                return
            if not keys:
                self._say("the terminal is gone: its keys do not stop any more")
                return
            try:
                self._take(keys)
            except Exception as error:  # the next key must still stop
                self._say(f"a key did not do what it should ({type(error).__name__}: {error})")

    def _take(self, keys: str) -> None:
        if any(key in _STOP_KEYS for key in keys):
            self._stop.trigger("keyboard", "key pressed")
        elif self._dead_man is not None and any(key in _HOLD_KEYS for key in keys):
            self._dead_man.held()

    def close(self) -> None:
        """Idempotent; the terminal is as before."""
        self._closed.set()
        self._thread.join(timeout=2 * _TICK + 0.5)
        self._restore.close()


@contextlib.contextmanager
def _single_keys(stream: int) -> Iterator[None]:
    """Keys one by one and unseen; Ctrl-C stays a signal."""
    import termios
    import tty

    before = termios.tcgetattr(stream)
    tty.setcbreak(stream)
    try:
        yield
    finally:
        with contextlib.suppress(termios.error):  # the terminal may be gone
            termios.tcsetattr(stream, termios.TCSADRAIN, before)


class GamepadSource:
    """A gamepad's button stops; another, held, is the dead-man's.

    Losing the gamepad counts as letting go of the dead-man's button, and as nothing else.

    Parameters
    ----------
    device: anything with ``fd`` and ``read()`` like ``evdev.InputDevice``; by default the first
        gamepad found.
    stop_button, hold_button: codes of linux/input-event-codes.h; 0x131 is the right one of the
        four (B), 0x136 the left shoulder.
    say: told when it cannot stop any more.
    """

    def __init__(
        self,
        stop: StopButton,
        dead_man: DeadMan | None = None,
        device: Any = None,
        stop_button: int = 0x131,
        hold_button: int = 0x136,
        say: Callable[[str], None] = say_loudly,
    ) -> None:
        self._say = say
        self._stop = stop
        self._dead_man = dead_man
        self._device = device if device is not None else open_gamepad("auto", stop_button)
        self._stop_button = stop_button
        self._hold_button = hold_button
        self._held = False
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="estop-gamepad", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                ready, _, _ = select.select([self._device.fd], [], [], _TICK)
                events = list(self._device.read()) if ready else []
            except (BlockingIOError, InterruptedError):
                continue  # somebody else has read them
            except (OSError, ValueError) as error:
                if self._dead_man is not None:
                    self._dead_man.released()
                if not self._closed.is_set():
                    self._say(f"the gamepad is gone ({error}): it does not stop any more")
                return
            try:
                for event in events:
                    with contextlib.suppress(AttributeError, TypeError):  # one of another kind
                        self._take(event)
                if self._held and self._dead_man is not None:
                    self._dead_man.held()
            except Exception as error:  # the next event must still stop
                self._say(f"a button did not do what it should ({type(error).__name__}: {error})")

    def _take(self, event: Any) -> None:
        is_key = event.type == 1  # EV_KEY
        if is_key and event.code == self._stop_button and event.value:
            self._stop.trigger("gamepad", f"button {event.code:#x}")
        elif is_key and event.code == self._hold_button:
            self._held = bool(event.value)
            if not self._held and self._dead_man is not None:
                self._dead_man.released()

    def close(self) -> None:
        """Idempotent."""
        self._closed.set()
        self._thread.join(timeout=2 * _TICK + 0.5)
        if hasattr(self._device, "close"):
            with contextlib.suppress(OSError):
                self._device.close()


def open_gamepad(which: str = "auto", button: int = 0x131) -> Any:
    """``evdev.InputDevice`` of a device file, or with ``auto`` the first that has ``button``.

    Raises
    ------
    DependencyMissing: no evdev.
    InputError: no such gamepad, or not for this user to read.
    """
    try:
        import evdev
    except ImportError:
        raise DependencyMissing("evdev", "gamepad", "emergency stop by gamepad") from None
    paths = sorted(evdev.list_devices()) if which == "auto" else [which]
    for path in paths:
        try:
            device = evdev.InputDevice(path)
        except OSError as error:
            if which == "auto":
                continue
            raise InputError(
                f"--gamepad {which}: {error.strerror or error}; name a file such as "
                "/dev/input/event5 that this user can read (sudo usermod -aG input $USER)"
            ) from None
        if button in device.capabilities().get(1, []):
            return device
        device.close()
    if which != "auto":
        raise InputError(f"--gamepad {which}: has no button {button:#x}; is it a gamepad?")
    raise InputError(
        f"--gamepad auto: none with button {button:#x} found. Plug it in, and let this user read "
        "it: sudo usermod -aG input $USER, then log in again"
    )
