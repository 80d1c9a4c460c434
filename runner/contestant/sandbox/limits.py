"""Resource limits of a contestant's process."""

from __future__ import annotations

import resource
from dataclasses import dataclass

_MIB = 1024 * 1024


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of one contestant.

    address_space, file_size: bytes, of each process and file; memory: bytes of all its processes
    and of its file system in memory together, looked at a few times a second;
    cpu: s of each process;
    processes: at once; open_files: of each process; disk, files: bytes in, and number of, all
    its files and folders beyond those of the submission; copy_size: bytes a submission may have;
    make_timeout, hook_timeout: s of wall time for the constructor and the episode hooks.
    niceness: of its processes, below 0 before others, as far as the runner may say so.
    """

    address_space: int = 4096 * _MIB
    memory: int = 4096 * _MIB
    cpu: int = 1800
    processes: int = 64
    file_size: int = 64 * _MIB
    open_files: int = 256
    disk: int = 256 * _MIB
    files: int = 20_000
    copy_size: int = 1024 * _MIB
    make_timeout: float = 120.0
    hook_timeout: float = 120.0
    niceness: int = 0


def apply(limits: Limits, already_running: int = 0) -> None:
    """Impose the limits on this process and its descendants, for good.

    ``already_running`` processes of the same user count against the limit of processes; they
    are added to it.
    """
    for kind, value in (
        (resource.RLIMIT_AS, limits.address_space),
        (resource.RLIMIT_CPU, limits.cpu),
        (resource.RLIMIT_NPROC, limits.processes + already_running),
        (resource.RLIMIT_FSIZE, limits.file_size),
        (resource.RLIMIT_NOFILE, limits.open_files),
        (resource.RLIMIT_CORE, 0),
    ):
        _, ceiling = resource.getrlimit(kind)
        if ceiling != resource.RLIM_INFINITY:
            value = min(value, ceiling)
        resource.setrlimit(kind, (value, value))
