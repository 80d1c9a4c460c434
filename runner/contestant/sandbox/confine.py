"""What a contestant may see of the machine, and shutting off the rest from inside."""

from __future__ import annotations

import importlib.util
import os
import site
import sys
import sysconfig
from dataclasses import dataclass, field
from pathlib import Path

from crazyarena.runner.contestant.sandbox import kernel, landlock, seccomp

# Our own folders that the contestant's side imports from.
_OWN = (
    "crazyarena",
    "crazyarena.runner",
    "crazyarena.levels",
    "crazyarena.crazyswarm_compat",
    "crazyarena.sim_backend",
    "crazyarena.mocap",
)
_SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/etc")
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


@dataclass
class InForce:
    """Which walls stand."""

    files: bool = False
    network: bool = False
    signals: bool = False
    calls: bool = False
    processes: bool = False
    notes: list[str] = field(default_factory=list)

    @property
    def complete(self) -> bool:
        """Files, network and other processes are out of reach."""
        return self.files and self.network and self.signals and self.calls

    @property
    def missing(self) -> list[str]:
        names = {
            "files": self.files,
            "network": self.network,
            "signals to other processes": self.signals,
            "system calls": self.calls,
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
            # Where they are, not where the package has links to them.
            paths += [Path(place).resolve() for place in spec.submodule_search_locations or ()]
    return paths


def readable() -> list[Path]:
    """Everything a contestant may read outside of its own files."""
    return [*interpreter_paths(), *package_paths(), *(Path(p) for p in _SYSTEM)]


def confine(box: Path, entered: list[str], in_bubblewrap: bool) -> InForce:
    """Shut everything off from this process, for good.

    Parameters
    ----------
    box: the contestant's own files.
    entered: namespaces it is in.
    """
    result = InForce()
    kernel.prctl(kernel.PR_SET_NO_NEW_PRIVS, 1)
    devices = [Path(p) for p in _DEVICES]
    files, tcp, signals = landlock.restrict(
        read=[Path(p) for p in _MACHINE], run=readable(), write=[box, *devices]
    )
    own_processes = "processes" in entered or in_bubblewrap
    calls = seccomp.restrict(deny_kill=not (signals or own_processes))
    result.calls = calls
    result.files = files or in_bubblewrap
    result.network = calls or "network" in entered or in_bubblewrap
    result.signals = signals or own_processes or calls
    result.processes = own_processes
    if in_bubblewrap:
        result.notes.append("bubblewrap")
    if files:
        result.notes.append(f"Landlock {landlock.abi()}" + (" (TCP)" if tcp else ""))
    if calls:
        result.notes.append("seccomp")
    if entered:
        result.notes.append(f"namespaces ({', '.join(entered)})")
    return result
