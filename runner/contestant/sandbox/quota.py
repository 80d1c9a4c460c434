"""Watches how much memory a contestant takes in all its processes, and how much it has in its
folder, where the file system itself sets no limit.

Run as ``python quota.py FOLDER BYTES FILES PID [MEMORY DESCRIPTOR]``, beside the runner and not in
it: looking through thousands of files must not delay a tick. FOLDER may be empty: then there is
none to look through. DESCRIPTOR is an open file of a file system in memory that counts as well, or
-1. Says what was exceeded, ends the process, and exits with :data:`EXCEEDED`. Ends when its
standard input does. Files that were deleted and are still open are not seen.
"""

import contextlib
import errno
import os
import select
import signal
import sys
import time

EXCEEDED = 3
_PAUSE = 0.25  # s, between looks, at least
_SHARE = 10  # times as long as a look takes


def used(folder: str, most_bytes: int, most_files: int) -> tuple[int, int]:
    """Bytes on disk and files (with folders) below ``folder``; not counted on beyond a limit."""
    size = count = 0
    pending = [folder]
    while pending:
        try:
            with os.scandir(pending.pop()) as entries:
                for entry in entries:
                    count += 1
                    try:
                        size += entry.stat(follow_symlinks=False).st_blocks * 512
                    except FileNotFoundError:
                        continue  # one that is gone must not hide the others
                    if entry.is_dir(follow_symlinks=False):
                        pending.append(entry.path)
                    if size > most_bytes or count > most_files:
                        return size, count
        except OSError as error:
            if error.errno == errno.ENAMETOOLONG:
                return size, most_files + 1  # nobody means well at that depth
            # Otherwise the folder is gone meanwhile.
    return size, count


def words(size: int, count: int, most_bytes: int, most_files: int) -> str | None:
    """What was exceeded, or None."""
    if size > most_bytes:
        return f"it used more than {most_bytes // 2**20} MiB of disk"
    if count > most_files:
        return f"it made more than {most_files} files"
    return None


def descendants(pid: int) -> list[int]:
    """A process and everything it has started that still belongs to it."""
    found, pending = [], [pid]
    while pending:
        one = pending.pop()
        found.append(one)
        with contextlib.suppress(OSError):
            for task in os.listdir(f"/proc/{one}/task"):
                with open(f"/proc/{one}/task/{task}/children") as stream:
                    pending += map(int, stream.read().split())
    return found


def memory(pids: list[int], most: int) -> int:
    """Bytes that processes have to themselves or share with each other; exact above ``most``."""
    total = sum(_resident(pid, "status", ("RssAnon", "RssShmem")) for pid in pids)
    if total > most:
        # Pages of several processes were counted several times.
        total = sum(
            _resident(pid, "smaps_rollup", ("Pss_Anon", "Pss_Shmem"))
            or _resident(pid, "status", ("RssAnon", "RssShmem"))
            for pid in pids
        )
    return total


def _resident(pid: int, file: str, names: tuple[str, ...]) -> int:
    total = 0
    with contextlib.suppress(OSError, ValueError), open(f"/proc/{pid}/{file}") as stream:
        for line in stream:
            name, _, rest = line.partition(":")
            if name in names:
                total += int(rest.split()[0]) * 1024
    return total


def in_memory(descriptor: int) -> int:
    """Bytes in the file system of an open file; 0 without one."""
    if descriptor < 0:
        return 0
    status = os.fstatvfs(descriptor)
    return (status.f_blocks - status.f_bfree) * status.f_frsize


def _taken(pid: int, descriptor: int, most: int) -> int:
    return in_memory(descriptor) + memory(descendants(pid), most)


def main(arguments: list[str]) -> None:
    """See the module's text."""
    folder, most_bytes, most_files, pid = arguments[0], *map(int, arguments[1:4])
    most_memory, descriptor = map(int, arguments[4:6]) if len(arguments) > 4 else (None, -1)
    pause = _PAUSE
    while True:
        ended, _, _ = select.select([0], [], [], pause)
        if ended:
            return
        began = time.perf_counter()
        problem = None
        if folder:
            size, count = used(folder, most_bytes, most_files)
            problem = words(size, count, most_bytes, most_files)
        if most_memory is not None and _taken(pid, descriptor, most_memory) > most_memory:
            problem = f"it used more than {most_memory // 2**20} MiB of memory in all"
        pause = max(_PAUSE, _SHARE * (time.perf_counter() - began))
        if problem is not None:
            print(problem, flush=True)
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
            sys.exit(EXCEEDED)


if __name__ == "__main__":
    main(sys.argv[1:])
