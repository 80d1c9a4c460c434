"""What a contestant can get at, on whatever walls this machine has.

    python benchmarks/sandbox_matrix.py [--json FILE]

Flies nothing: starts a submission that tries everything below, as the user who calls and, for the
super-user, as an ordinary one as well, with bubblewrap, with namespaces alone, and with neither
(Landlock and seccomp). Each cell is ``denied``, ``-`` (cannot be tried here) or ``BREACH``; the
exit code is that of a breach where ``--require-sandbox`` would have flown.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path
from typing import Any

KINDS = ("bubblewrap", "namespaces", "neither")
USER = 64999  # an ordinary one, who owns nothing
_IMPORTS = """
import ctypes, gc, mmap, os, resource, shutil, signal, socket, struct, subprocess, sys
import numpy as np
libc = ctypes.CDLL(None, use_errno=True)
def call(result):
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result
"""
# Each must raise. {secret}: a file of the caller's; {folder}: where it lies; {neighbour}: another
# contestant's file; {runner}: the judge's process; {port}: a TCP port somebody listens at.
PROBES: dict[str, str] = {
    "read a file": "open('{secret}').read()",
    "list a folder": "os.listdir('{folder}')",
    "write a file": "open('{secret}', 'a').write('x')",
    "make a file": "open('{folder}/made', 'w').write('x')",
    "remove a file": "os.unlink('{secret}')",
    "rename a file": "os.rename('{secret}', '{folder}/renamed')",
    "truncate a file": "os.truncate('{secret}', 0)",
    "link to a file": "os.link('{secret}', 'link')",
    "follow a symbolic link": "os.symlink('{secret}', 'symbolic'); open('symbolic').read()",
    "chmod a file": "os.chmod('{secret}', 0o777)",
    "chmod a folder": "os.chmod('{folder}', 0o777)",
    "chown a file": "os.chown('{secret}', os.getuid(), os.getgid())",
    "set times of a file": "os.utime('{secret}', (1, 1))",
    "set attributes of a file": "os.setxattr('{secret}', 'user.x', b'x')",
    "set flags of a file": (
        "import fcntl; f = os.open('{secret}', os.O_RDONLY); "
        "fcntl.ioctl(f, 0x40086602, struct.pack('i', 0x80))"
    ),
    "chmod the runtime folder": (
        "[os.chmod(p, 0o777) for p in ('/run/user/%d' % {uid}, '/tmp/crazyarena-%d' % {uid}, "
        "'{folder}/crazyarena-%d' % {uid}) if os.path.exists(p)] or 1 / 0"
    ),
    "chmod the system": "os.chmod('/usr/bin/env', 0o755)",
    "write the system": "open('/usr/lib/mine', 'w')",
    "write this package": "import crazyarena; open(crazyarena.__file__, 'a')",
    "read /etc/shadow": "open('/etc/shadow').read()",
    "read ssh keys": "os.listdir('/etc/ssh')",
    "read another's home": "os.listdir('/root')",
    "neighbours": "open('{neighbour}').read()",
    "other boxes": (
        "me = os.path.dirname(os.path.dirname(os.getcwd())); "
        "assert [d for d in os.listdir('{tmp}') if d.startswith('crazyarena-contestant-') "
        "and os.path.join('{tmp}', d) != me]"
    ),
    "write to /tmp": "open('/tmp/mine', 'w').write('x')",
    "shared memory": "open('/dev/shm/mine', 'w').write('x')",
    "tcp": "socket.create_connection(('127.0.0.1', {port}), 2)",
    "udp": "socket.socket(socket.AF_INET, socket.SOCK_DGRAM)",
    "unix socket": "socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)",
    "raw socket": "socket.socket(socket.AF_PACKET, socket.SOCK_RAW)",
    "netlink": "socket.socket(socket.AF_NETLINK, socket.SOCK_RAW)",
    "signal the judge": "os.kill({runner}, 0)",
    "signal everybody": "os.kill(-1, 0)",
    "ptrace the judge": "call(libc.ptrace(16, {runner}, 0, 0))",
    "read the judge's memory": "open('/proc/{runner}/mem', 'rb')",
    "read the judge's arguments": "open('/proc/{runner}/cmdline').read()",
    "pidfd of the judge": "os.pidfd_open({runner})",
    "memfd": "os.memfd_create('mine')",
    "System V memory": "call(libc.shmget(0, 1 << 20, 0o1600))",
    "io_uring": "call(libc.syscall(425, 1, ctypes.create_string_buffer(120)))",
    "mount": "call(libc.mount(b'none', b'/tmp', b'tmpfs', 0, None))",
    "new namespace": "call(libc.unshare(0x10000000))",
    "chroot": "os.chroot('.')",
    "become the super-user": "os.setuid(0)",
    "capabilities": (
        "lines = open('/proc/self/status').read().split('CapEff:')[1]; "
        "assert int(lines.split()[0], 16)"
    ),
    "more than its processes": (
        "soft, hard = resource.getrlimit(resource.RLIMIT_NPROC); "
        "assert os.getuid() == 0 or soft == resource.RLIM_INFINITY"
    ),
    "raise its limits": "resource.setrlimit(resource.RLIMIT_AS, (-1, -1))",
    "real-time priority": "os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))",
    "outlive the judge": "call(libc.prctl(1, 0, 0, 0, 0))",
    "fill the disk": "open('big', 'wb').write(bytes(65 << 20))",
    "devices": "open('/dev/mem', 'rb')",
    "kernel settings": "open('/proc/sys/kernel/hostname', 'w')",
    "truth": (
        "from crazyarena.sim_backend.arena_world import SimulatedArena; "
        "assert any(isinstance(o, SimulatedArena) for o in gc.get_objects())"
    ),
    "seed": (
        "from crazyarena.levels.schema import Level; "
        "assert any(isinstance(o, Level) and o.seed for o in gc.get_objects())"
    ),
    "seed in the environment": "assert any('4711' in v for v in os.environ.values())",
}
_SUBMISSION = (
    _IMPORTS
    + """
PROBES = {probes!r}
class Controller:
    def __init__(self, obs, info, use_firmware=True, buffer_size=100, verbose=False):
        for name, code in PROBES.items():
            try:
                exec(code, dict(globals()))
                print("BREACH\\t" + name, flush=True)
            except BaseException as error:
                print("denied\\t" + name + "\\t" + repr(error)[:100], flush=True)
    def cmdFirmware(self, *arguments):
        pass
"""
)


def cell(kind: str, folder: Path) -> dict[str, Any]:
    """Try everything as the present user; what became of each probe, and what was said."""
    from crazyarena.levels import load_level
    from crazyarena.runner.contestant.sandbox import bubblewrap, process

    if kind != "bubblewrap":
        bubblewrap.program = lambda: None  # type: ignore[assignment]
    elif bubblewrap.program() is None:
        return {"announcement": "no bubblewrap here", "probes": {}}
    process.MOUNT = kind != "neither"
    import numpy as np

    from crazyarena.runner.contestant.sandbox.process import Sandboxed

    secret, neighbour = folder / "secret", folder / "two.py"
    for file in (secret, neighbour):
        file.write_text("seed: 4711\n")
    (folder / f"crazyarena-{os.getuid()}").mkdir()
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        tempfile.TemporaryDirectory(prefix="crazyarena-contestant-"),
    ):
        names = {
            "secret": secret,
            "folder": folder,
            "neighbour": neighbour,
            "runner": os.getpid(),
            "uid": os.getuid(),
            "port": server.getsockname()[1],
            "tmp": tempfile.gettempdir(),
        }
        probes = dict(PROBES)
        for key, value in names.items():
            probes = {n: c.replace("{" + key + "}", str(value)) for n, c in probes.items()}
        entry = folder / "one.py"
        entry.write_text(_SUBMISSION.replace("{probes!r}", repr(probes)))
        before = secret.stat()
        contestant = Sandboxed(entry)
        try:
            contestant.make([0.0] * 12, load_level("level0"), np.zeros(12))
            lines = contestant._box.last_output(1 << 20).splitlines()
        finally:
            contestant.close()
    found = {}
    for line in lines:
        verdict, _, rest = line.partition("\t")
        if verdict in ("denied", "BREACH"):
            name, _, why = rest.partition("\t")
            found[name] = [verdict, why]
    after = secret.stat()
    if (before.st_mode, before.st_mtime, before.st_size) != (
        after.st_mode,
        after.st_mtime,
        after.st_size,
    ):
        found["read a file"] = ["BREACH", "the file was changed"]
    return {
        "announcement": contestant.announcement,
        "complete": contestant.description["isolated"],
        "probes": found,
    }


def become(user: int) -> None:
    """Go on as an ordinary user, who can read the interpreter wherever it lies."""
    from crazyarena.runner.contestant.sandbox import kernel
    from crazyarena.runner.contestant.sandbox.confine import interpreter_paths, package_paths

    paths = [p for p in (*interpreter_paths(), *package_paths()) if p.exists()]
    kernel.unshare(kernel.CLONE_NEWNS)
    kernel.mount(None, Path("/"), None, kernel.MS_REC | kernel.MS_PRIVATE)
    for closed in sorted({f for p in paths for f in p.parents if not f.stat().st_mode & 1}):
        inside = [p for p in paths if closed in p.parents]
        top = {closed / p.relative_to(closed).parts[0] for p in inside}
        held = {path: os.open(path, os.O_PATH) for path in top}
        kernel.mount("tmpfs", closed, "tmpfs", 0, "size=1m,mode=755")
        for path, number in held.items():
            path.mkdir()
            kernel.mount(f"/proc/self/fd/{number}", path, None, kernel.MS_BIND | kernel.MS_REC)
    os.setgroups([])
    os.setgid(user)
    os.setuid(user)


def _run(kind: str, user: int | None) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="crazyarena-matrix-") as name:
        folder = Path(name)
        more = []
        if user is not None:
            os.chown(folder, user, user)
            more = ["--become", str(user)]
        done = subprocess.run(
            [sys.executable, __file__, "--cell", kind, "--folder", name, *more],
            capture_output=True,
            text=True,
            cwd=name,
            env={**os.environ, "HOME": name, "NUMBA_CACHE_DIR": name, "MPLCONFIGDIR": name},
        )
    if done.returncode != 0:
        return {"announcement": f"did not start: {done.stderr.strip()[-300:]}", "probes": {}}
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def main() -> int:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="also write everything there")
    parser.add_argument("--cell", choices=KINDS, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--become", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.become is not None:
        become(options.become)
        arguments = [a for a in sys.argv if a not in ("--become", str(options.become))]
        os.execv(sys.executable, [sys.executable, *arguments])
    if options.cell:
        print(json.dumps(cell(options.cell, options.folder)))
        return 0
    users: dict[str, int | None] = {"user": None}
    if os.getuid() == 0:
        users = {"root": None, "user": USER}
    cells = {f"{who}, {kind}": _run(kind, users[who]) for who in users for kind in KINDS}
    print(f"| {len(PROBES)} probes | " + " | ".join(cells) + " |")
    print("|---" * (len(cells) + 1) + "|")
    for name in PROBES:
        row = [found["probes"].get(name, ["-"])[0] for found in cells.values()]
        print(f"| {name} | " + " | ".join(row) + " |")
    print()
    breaches = 0
    for title, found in cells.items():
        print(textwrap.shorten(f"{title}: {found['announcement']}", 400))
        bad = [n for n, (verdict, _) in found["probes"].items() if verdict == "BREACH"]
        if found.get("complete"):
            breaches += len(bad) + len(PROBES) - len(found["probes"])
    if options.json:
        options.json.write_text(json.dumps(cells, indent=2) + "\n")
    return 1 if breaches else 0


if __name__ == "__main__":
    sys.exit(main())
