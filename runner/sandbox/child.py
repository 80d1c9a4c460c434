"""The contestant's side: confines itself, loads the submission and answers questions.

Run as ``python -m crazyarena.runner.sandbox.child FD BOX COPY IN_BUBBLEWRAP USER LIMITS``; USER
is the id to change to, or the present one.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import pickle
import socket
import sys
from pathlib import Path

from crazyarena.runner.sandbox import limits as limits_module
from crazyarena.runner.sandbox import namespaces


def _processes_of(uid: int) -> int:
    count = 0
    for name in os.listdir("/proc"):
        if name.isdigit():
            try:
                count += os.stat(f"/proc/{name}").st_uid == uid
            except OSError:
                continue
    return count


def main(arguments: list[str]) -> None:
    """Serve until the runner closes the channel."""
    number, box, copy, in_bubblewrap, user, limits = arguments
    wrapped = in_bubblewrap == "1"
    channel = socket.socket(fileno=int(number))
    namespaces.die_with_parent()
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    entered: list[str] = [] if wrapped else namespaces.enter()
    if "processes" in entered:
        # A bare record, as in wire.py, whose imports would be in the way of a quick fork.
        import struct

        def tell(pid: int) -> None:
            channel.send(struct.pack("<cqdd", b"P", pid, 0.0, 0.0))
            channel.close()

        namespaces.split(tell)
    if int(user) != os.getuid():
        os.setgroups([])
        os.setgid(int(user))
        os.setuid(int(user))
        # Changing the user cleared it; also, memory of this process is now its user's to see.
        namespaces.die_with_parent()
    counted = 0 if wrapped or "user" in entered else _processes_of(os.getuid())
    limits_module.apply(limits_module.Limits(**json.loads(limits)), counted)
    faulthandler.enable()

    from crazyarena.runner.contender import Pilot
    from crazyarena.runner.contestant import Submission
    from crazyarena.runner.sandbox import wire
    from crazyarena.runner.sandbox.confine import confine

    state = confine(Path(box), entered, wrapped)
    report = {
        "complete": state.complete,
        "missing": state.missing,
        "notes": state.notes,
        # The super-user's processes are not counted.
        "processes_limited": os.getuid() != 0,
    }
    channel.send(wire.encode_text(wire.READY, json.dumps(report)))

    pilot: Pilot | None = None
    while True:
        packet = channel.recv(1 << 20)
        if not packet:
            os._exit(0)
        verb, payload = pickle.loads(packet)
        if verb == "load":
            try:
                pilot = Pilot(Submission(copy, Path(box) / "work"))
                answer = wire.encode_text(wire.MADE, "")
            except BaseException as error:
                answer = wire.encode_text(wire.FAILED, _told(error))
        elif verb == "make":
            assert pilot is not None
            try:
                pilot.make(*payload)
                answer = wire.encode_text(wire.MADE, "")
            except BaseException as error:
                answer = wire.encode_text(wire.FAILED, _told(error))
        elif verb == "ask":
            assert pilot is not None
            answer = wire.encode_answer(pilot.answer(payload))
        else:
            assert pilot is not None
            seconds, trouble = pilot.hook(payload)
            answer = wire.encode_text(wire.HOOKED, trouble or "", seconds=seconds)
        channel.send(answer)


def _told(error: BaseException) -> str:
    text = str(error)
    return text if text else type(error).__name__


if __name__ == "__main__":
    main(sys.argv[1:])
