"""The flight process itself: ``python -m crazyarena.runner.rig.flight_process.server FD``.

It gets a :class:`~crazyarena.runner.rig.hardware.HardwareSetup` over the socket ``FD``, connects,
and then serves the runner until the runner is gone. It never waits for the runner. A vehicle
that is in the air when the runner disappears, or falls silent, is landed by the watchdog.
"""

from __future__ import annotations

import contextlib
import gc
import math
import os
import pickle
import signal
import socket
import sys
import threading
import traceback
from collections.abc import Callable
from typing import Any

from crazyarena.crazyswarm_compat.commands import Arm
from crazyarena.errors import CrazyarenaError
from crazyarena.runner.rig.flight_process import wire
from crazyarena.runner.rig.flight_process.channel import PatientSender, Receiver
from crazyarena.runner.rig.hardware import Hardware, HardwareSetup, connect
from crazyarena.runner.rig.stops import StopOptions
from crazyarena.runner.timing.realtime import SERVING, lock_memory, raise_priority
from crazyarena.safety.events import Action

READY = 1  # number of the reply that says that everything is connected
STATUS_PERIOD = 0.02  # s
SILENCE = 2.0  # s without a word of the runner, after which a vehicle in the air is landed
_FAREWELL = 10.0  # s for the runner to take notice of a landing after SIGTERM
_LOOK = 0.1  # s, between looks whether to end
_SENDING = 0.2  # s for the last packet to leave
_SETTLING = 2.0  # s for a vehicle that has come down to stand still
# Answered in a thread of their own: they wait for the vehicle, or for people's devices.
_SLOW = ("get_param", "hand_over", "open_stops", "open_keys", "close_keys")


class FlightServer:
    """Serves one runner over a connected socket."""

    def __init__(
        self, setup: HardwareSetup, hardware: Hardware, receiver: Receiver, sender: PatientSender
    ) -> None:
        self._setup = setup
        self._hardware = hardware
        self._receiver = receiver
        self._sender = sender
        self._terminated = False
        self._down_since = math.inf
        self._closed = threading.Event()
        self._wake = threading.Event()
        self._heard = hardware.clock.now()
        self._landing = False
        backend, guard = hardware.backend, hardware.safeguard
        self._calls: dict[str, Callable[..., Any]] = {
            "send": backend.send,
            "send_external_poses": backend.send_external_poses,
            "get_param": backend.get_param,
            "begin": guard.begin,
            "answered": guard.answered,
            "late": guard.late,
            "hand_over": guard.hand_over,
            "done": guard.done,
            "events": guard.events,
            "record": guard.record,
            "stop": guard.stop,
            "tested": guard.estop.tested,
            "open_stops": self._open_stops,
            "open_keys": guard.open_keys,
            "close_keys": guard.close_keys,
            "here": lambda: None,
        }
        # What stops the run must not wait for the next look.
        guard.estop.on_stop(lambda stop: self._wake.set())
        hardware.listeners.frames.append(lambda frame, result: self._tell(frame))
        self._ticker = threading.Thread(target=self._tick, name="status", daemon=True)
        self._ticker.start()

    def terminate(self) -> None:
        """For a signal's handler: bring the vehicle down, then end."""
        self._terminated = True

    def run(self) -> None:
        """Serve until the runner is gone, and the vehicle down."""
        orderly = False
        try:
            while not orderly and not self._closed.is_set():
                for data in self._receiver.receive(_LOOK):
                    message = wire.decode(data)
                    self._heard = self._hardware.clock.now()
                    assert isinstance(message, wire.Call)
                    if message.name == "close":
                        orderly = True
                    elif message.name in _SLOW:
                        threading.Thread(
                            target=self._answer, args=(message,), name=message.name, daemon=True
                        ).start()
                    else:
                        self._answer(message)
        except EOFError:
            pass
        self._bring_down(orderly)

    def close(self) -> None:
        self._closed.set()
        self._wake.set()
        self._ticker.join(timeout=1.0)
        self._sender.close()

    def _answer(self, call: wire.Call) -> None:
        try:
            value, failed = self._calls[call.name](*call.arguments), None
        except Exception as error:
            value, failed = None, wire.failure(error)
            # The runner will ask why, and whether the watchdog was faster.
            self._tell(self._status())
        if call.number > 0 or (call.number == wire.POSTED and failed is not None):
            self._tell(wire.Reply(call.number, value, failed))

    def _tell(self, message: wire.Message) -> None:
        self._sender.send(wire.encode(message))

    def _status(self) -> wire.Status:
        guard, source = self._hardware.safeguard, self._hardware.pipeline.source
        stop = guard.estop.stopped
        return wire.Status(
            self._hardware.backend.telemetry(self._setup.vehicle),
            source.status,
            guard.verdict(),
            guard.over,
            None if stop is None else stop.source,
            guard.held,
            guard.ladder,
        )

    def _tick(self) -> None:
        while not self._closed.is_set():
            self._wake.wait(STATUS_PERIOD)
            self._wake.clear()
            self._tell(self._status())
            self._look()

    def _look(self) -> None:
        now = self._hardware.clock.now()
        if self._airborne():
            if self._terminated and not self._landing:
                self._land("terminated")
            elif now - self._heard > SILENCE and not self._landing:
                self._land("runner_silent")
        elif self._terminated:
            self._down_since = min(self._down_since, now)
            if not self._landing or now - self._down_since > _FAREWELL:
                self._closed.set()

    # Coming down

    def _airborne(self) -> bool:
        guard = self._hardware.safeguard
        return guard.watchdog.airborne(self._setup.vehicle) and not guard.over

    def _land(self, rule: str) -> None:
        self._landing = True
        self._hardware.safeguard.watchdog.request(Action.LAND, rule, self._setup.vehicle)

    def _bring_down(self, orderly: bool) -> None:
        """Leave nothing in the air, and, after a runner that was torn away, nothing armed."""
        clock, guard = self._hardware.clock, self._hardware.safeguard
        vehicle = self._setup.vehicle
        # A crew that has done its work says that it is gone before the watchdog believes that
        # the vehicle stands.
        end = clock.now() + _SETTLING
        while orderly and guard.watchdog.settling(vehicle) and clock.now() < end:
            clock.sleep_until(clock.now() + STATUS_PERIOD)
        if self._airborne():
            _say("the runner is gone: landing the vehicle")
            self._land("runner_gone")
            limits = guard.watchdog.limits
            end = clock.now() + limits.hold_time + limits.land_time + 1.0
            while not guard.over and clock.now() < end:
                clock.sleep_until(clock.now() + STATUS_PERIOD)
            _say("the vehicle is down" if guard.over else "the vehicle did not come down in time")
        elif not orderly:
            try:
                guard.gate.safety.send(Arm(False), vehicle)
            except CrazyarenaError as error:
                _say(f"not disarmed: {error}")
        clock.sleep_until(clock.now() + _SENDING)

    def _open_stops(self, options: StopOptions) -> tuple[list[str], bool]:
        notes, hold = self._hardware.safeguard.open_stops(options)
        return notes, hold is not None


def _say(text: str) -> None:
    """To the operator, whose terminal may be gone as well."""
    with contextlib.suppress(OSError):
        print(f"crazyarena flight process: {text}", file=sys.stderr, flush=True)


def main(descriptor: int) -> None:
    """Serve the runner on the other end of a socket."""
    # The runner decides what Ctrl-C means. A closed terminal ends the runner, which is seen.
    # Reading keys when the terminal is no longer ours must not suspend us, nor may the keys that
    # suspend and quit, which go to all programs of a terminal.
    for number in (
        signal.SIGINT,
        signal.SIGHUP,
        signal.SIGTTIN,
        signal.SIGTTOU,
        signal.SIGTSTP,
        signal.SIGQUIT,
    ):
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT,))
    connection = socket.socket(fileno=descriptor)
    receiver, sender = Receiver(connection), PatientSender(connection)
    received: list[bytes] = []
    while not received:
        received = receiver.receive(None)
    setup: HardwareSetup = pickle.loads(received[0])
    notes = []
    if setup.real_time:
        # Every thread of it: one that is put aside while it holds the interpreter's lock stops
        # the others. A pose that waits for a processor is an old pose.
        notes = [lock_memory(), raise_priority(SERVING, inherit=True)]
    try:
        hardware = connect(setup)
    except CrazyarenaError as error:
        sender.send(wire.encode(wire.Reply(READY, None, wire.failure(error))))
        return
    notes.append(f"watchdog {hardware.safeguard.watchdog.priority}")
    server = FlightServer(setup, hardware, receiver, sender)
    signal.signal(signal.SIGTERM, lambda *_: server.terminate())
    gc.collect()
    gc.freeze()
    sender.send(wire.encode(wire.Reply(READY, notes)))
    try:
        server.run()
    finally:
        server.close()
        hardware.close()


if __name__ == "__main__":
    code = 1
    try:
        main(int(sys.argv[1]))
        code = 0
    except EOFError:
        pass  # the runner was gone before anything was connected
    except BaseException:
        traceback.print_exc()
    finally:
        # Threads of the link that do not end must not keep the process alive.
        os._exit(code)
