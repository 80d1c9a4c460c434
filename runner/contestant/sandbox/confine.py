"""What a contestant may see of the machine, and shutting off the rest from inside."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import site
import stat
import subprocess
import sys
import sysconfig
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from crazyarena.runner.contestant.sandbox import kernel, landlock, seccomp

# Our own folders that the contestant's side imports from.
ACADOS = "ACADOS_SOURCE_DIR"
_OWN = (
    "crazyarena",
    "crazyarena.runner",
    "crazyarena.levels",
    "crazyarena.crazyswarm_compat",
    "crazyarena.sim_backend",
    "crazyarena.mocap",
)
_SYSTEM = (
    "/usr",
    "/bin",
    "/sbin",
    "/lib",
    "/lib32",
    "/lib64",
    # Of /etc what libraries look up; no passwords, keys and settings of other programs.
    "/etc/alternatives",
    "/etc/fonts",
    "/etc/group",
    "/etc/hosts",
    "/etc/ld.so.cache",
    "/etc/ld.so.conf",
    "/etc/ld.so.conf.d",
    "/etc/localtime",
    "/etc/matplotlibrc",
    "/etc/mime.types",
    "/etc/nsswitch.conf",
    "/etc/os-release",
    "/etc/passwd",
    "/etc/python3",
    "/etc/timezone",
)
_DEVICES = ("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom")
_MACHINE = (
    "/proc/self",
    "/proc/cpuinfo",
    "/proc/meminfo",
    "/proc/stat",
    "/proc/version",
    "/proc/filesystems",
    "/proc/sys/vm/overcommit_memory",
    "/proc/sys/kernel/osrelease",
    "/sys/devices/system/cpu",
    "/sys/devices/system/node",
    "/sys/fs/cgroup",
)

_TRY_MOUNT = f"""
import ctypes, sys
c = ctypes.CDLL(None)
sys.exit(c.unshare({kernel.CLONE_NEWNS})
         or c.mount(None, b"/", None, ctypes.c_ulong({kernel.MS_REC | kernel.MS_PRIVATE}), None))
"""


@dataclass
class InForce:
    """Which walls stand."""

    files: bool = False
    network: bool = False
    signals: bool = False
    calls: bool = False
    processes: bool = False
    metadata: bool = False
    counted: bool = False
    notes: list[str] = field(default_factory=list)

    @property
    def complete(self) -> bool:
        """Files, network and other processes are out of reach."""
        return not self.missing

    @property
    def missing(self) -> list[str]:
        names = {
            "files": self.files,
            "network": self.network,
            "signals to other processes": self.signals,
            "system calls": self.calls,
            "permissions and times of others' files": self.metadata,
            "the number of processes (super-user)": self.counted,
        }
        return [name for name, there in names.items() if not there]


def interpreter_paths() -> list[Path]:
    """Folders of the interpreter and of what is installed for it."""
    found = {sys.prefix, sys.base_prefix, sys.exec_prefix, *sysconfig.get_paths().values()}
    found |= set(site.getsitepackages())
    found.add(os.path.dirname(os.path.realpath(sys.executable)))
    return [Path(path) for path in sorted(found) if path and Path(path) != Path("/")]


def package_paths() -> list[Path]:
    """Our own folders (neither results nor anything else beside them)."""
    paths = []
    for name in _OWN:
        spec = importlib.util.find_spec(name)
        if spec is not None:
            paths += [Path(place) for place in spec.submodule_search_locations or ()]
    # In a checkout they are links beside each other.
    return list(dict.fromkeys([*paths, *(path.resolve() for path in paths)]))


def acados_folder() -> Path | None:
    """Where acados was built, if the one who runs us says so: solvers are compiled against it."""
    named = os.environ.get(ACADOS)
    if not named or not os.path.isabs(named):
        return None
    folder = Path(named).resolve()
    parts = folder / "lib", folder / "interfaces" / "acados_template"
    return folder if all(part.is_dir() for part in parts) else None


def readable() -> list[Path]:
    """Everything a contestant may read outside of its own files."""
    acados = acados_folder()
    solver = [] if acados is None else [acados]
    return [*interpreter_paths(), *package_paths(), *solver, *(Path(p) for p in _SYSTEM)]


def confine(box: Path, entered: list[str], in_bubblewrap: bool, own_root: bool) -> InForce:
    """Shut everything off from this process, for good.

    Parameters
    ----------
    box: the contestant's own files.
    entered: namespaces it is in.
    own_root: it has a root of its own, without bubblewrap.
    """
    result = InForce()
    with contextlib.suppress(OSError):
        kernel.drop_capabilities()
    kernel.prctl(kernel.PR_SET_NO_NEW_PRIVS, 1)
    devices = [Path(p) for p in _DEVICES]
    files, tcp, signals = landlock.restrict(
        read=[Path(p) for p in _MACHINE], run=readable(), write=[box, *devices]
    )
    own_processes = "processes" in entered or in_bubblewrap
    own_files = in_bubblewrap or own_root
    calls = seccomp.restrict(deny_kill=not (signals or own_processes), deny_metadata=not own_files)
    result.calls = calls
    result.files = files or own_files
    result.metadata = calls or own_files
    # The super-user's processes are not.
    result.counted = os.getuid() != 0
    result.network = calls or "network" in entered or in_bubblewrap
    result.signals = signals or own_processes or calls
    result.processes = own_processes
    if in_bubblewrap:
        result.notes.append("bubblewrap")
    if own_root:
        result.notes.append("root of its own")
    if files:
        result.notes.append(f"Landlock {landlock.abi()}" + (" (TCP)" if tcp else ""))
    if calls:
        result.notes.append("seccomp" if own_files else "seccomp (no chmod, chown, utime)")
    if entered:
        result.notes.append(f"namespaces ({', '.join(entered)})")
    return result


def open_to_others(own_root: bool) -> bool:
    """Whether an unprivileged user can read the interpreter and this package; in a root of its
    own the folders above them are open."""
    return all(
        parent.stat().st_mode & stat.S_IXOTH
        for path in (*interpreter_paths(), *package_paths())
        if path.exists()
        for parent in ((path,) if own_root else (path, *path.parents))
    )


@cache
def may_mount() -> bool:
    """Whether this user may make mounts in a namespace of its own without one of users."""
    try:
        done = subprocess.run(
            [sys.executable, "-I", "-S", "-c", _TRY_MOUNT], capture_output=True, timeout=20
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0
