"""The contestant's side: confines itself, loads the submission and answers questions.

Run as ``python -m crazyarena.runner.contestant.sandbox.child FD FILES GIVEN COPY DISK USER LIMITS
SIZE INODES``; DISK is who bounds FILES: ``bubblewrap`` has put an empty file system there,
``wrapped`` runs in one without, ``mount`` tries to make a root with one of SIZE and INODES,
``none`` does not; USER is the id to change to, or the present one."""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import pickle
import socket
import sys
from pathlib import Path

from crazyarena.runner.contestant.sandbox import limits as limits_module
from crazyarena.runner.contestant.sandbox import namespaces
from crazyarena.runner.contestant.sandbox.confine import confine, readable
from crazyarena.runner.contestant.sandbox.files import fill, own_root

_LONGEST = 1 << 20  # bytes, of what the runner says


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
    number, files, given, copy, disk, user, limits, size, inodes = arguments
    wrapped = disk in ("bubblewrap", "wrapped")
    changes_user = int(user) != os.getuid()
    channel = socket.socket(fileno=int(number))
    namespaces.die_with_parent()
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    # In the machine's own view of processes, which a root of its own will not have.
    counted = 0 if wrapped else _processes_of(int(user))
    entered: list[str] = [] if wrapped else namespaces.enter(own_users=not changes_user)
    if "processes" in entered:
        # A bare record, as in wire.py, whose imports would be in the way of a quick fork.
        import struct

        def tell(pid: int) -> None:
            channel.send(struct.pack("<cqdd", b"P", pid, 0.0, 0.0))
            channel.close()

        namespaces.split(tell)
    rooted = False
    if disk == "mount":
        rooted = own_root(
            readable(), Path(files), Path(given), int(size), int(inodes), "processes" in entered
        )
    own_files = rooted or disk == "bubblewrap"
    if changes_user:
        os.setgroups([])
        os.setgid(int(user))
        os.setuid(int(user))
        # Changing the user cleared it; also, memory of this process is now its user's to see.
        namespaces.die_with_parent()
    if own_files:
        fill(Path(files), Path(given))
    work = Path(files) / "work"
    os.chdir(work)
    counted = 0 if "user" in entered else counted
    limits_module.apply(limits_module.Limits(**json.loads(limits)), counted)
    faulthandler.enable()

    from crazyarena.runner.contestant.contract_lsy.pilot import LsyPilot
    from crazyarena.runner.contestant.contract_lsy.submission import LsySubmission
    from crazyarena.runner.contestant.in_process import Pilot
    from crazyarena.runner.contestant.sandbox import wire
    from crazyarena.runner.contestant.submission import Submission

    own = os.open(files, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    state = confine(Path(files), entered, wrapped, rooted)
    report = {
        "complete": state.complete,
        "missing": state.missing,
        "notes": state.notes,
        "processes_limited": state.counted,
        "own_files": own_files,
    }
    socket.send_fds(channel, [wire.encode_text(wire.READY, json.dumps(report))], [own])
    os.close(own)

    pilot: Pilot | LsyPilot | None = None
    # A buffer for each message would be mapped and unmapped at each tick.
    buffer = memoryview(bytearray(_LONGEST))
    while True:
        length = channel.recv_into(buffer)
        if not length:
            os._exit(0)
        verb, payload = pickle.loads(buffer[:length])
        if verb == "load":
            try:
                if payload is None:
                    pilot = Pilot(Submission(copy, work))
                else:
                    pilot = LsyPilot(LsySubmission(Path(copy), work, payload))
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
            # The ticket is known to nobody who has not read the question.
            ticket, question = payload
            if isinstance(pilot, LsyPilot):
                answer = wire.encode_lsy(pilot.ask(question), ticket)
            else:

                def learned(ticket: int = ticket) -> None:
                    channel.send(wire.encode_text(wire.LEARNED, "", ticket))

                answer = wire.encode_answer(pilot.answer(question, learned), ticket)
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
