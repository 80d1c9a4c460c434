"""The viewer of a live flight, a process of its own: ``python -m crazyarena.runner.viewer FILE``.

Says its address, or what is wrong, in one line of JSON on standard output. Lives as long as the
flight, and on while a browser shows it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
from pathlib import Path

from crazyarena.errors import CrazyarenaError, DependencyMissing
from crazyarena.live import Watched
from crazyarena.secret import read_secret


def _give_way() -> None:
    """To what flies, which may have real-time scheduling; but to nobody else on this machine, for
    people press STOP here."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def main() -> int:
    """Serve; returns the exit code."""
    parser = argparse.ArgumentParser()
    parser.add_argument("file", type=Path)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8080)
    parser.add_argument("--token", type=Path)
    options = parser.parse_args()
    _give_way()
    # Standard output carries one line; whatever libraries print goes where errors go.
    told = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def say(**line: object) -> None:
        print(json.dumps(line), file=told, flush=True)

    try:
        secret = None if options.token is None else read_secret(options.token)
        watched = Watched(options.file)
        from crazyarena.runner.viewer.server import Rights, address, open_server

        server = open_server(options.host, options.port, "crazyarena")
        from crazyarena.runner.viewer.live_page import LivePage

        page = LivePage(server, watched, Rights(options.host, secret))
    except DependencyMissing as error:
        say(missing=["viser", "viewer", "the viewer"], error=str(error))
        return 2
    except CrazyarenaError as error:
        say(error=str(error))
        return 2
    say(url=address(server, options.host))
    with contextlib.suppress(KeyboardInterrupt):
        page.run()
    # Its server prints, and its threads may not end.
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
