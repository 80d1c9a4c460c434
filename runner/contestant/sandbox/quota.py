"""Watches how much a contestant has in its folder, where the file system itself sets no limit.

Run as ``python quota.py FOLDER BYTES FILES PID``, beside the runner and not in it: looking through
thousands of files must not delay a tick. Says what was exceeded, ends the process, and exits with
:data:`EXCEEDED`. Ends when its standard input does. What was deleted and is still open is not
seen.
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


def main(arguments: list[str]) -> None:
    """See the module's text."""
    folder, most_bytes, most_files, pid = arguments[0], *map(int, arguments[1:])
    pause = _PAUSE
    while True:
        ended, _, _ = select.select([0], [], [], pause)
        if ended:
            return
        began = time.perf_counter()
        size, count = used(folder, most_bytes, most_files)
        pause = max(_PAUSE, _SHARE * (time.perf_counter() - began))
        problem = words(size, count, most_bytes, most_files)
        if problem is not None:
            print(problem, flush=True)
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
            sys.exit(EXCEEDED)


if __name__ == "__main__":
    main(sys.argv[1:])
