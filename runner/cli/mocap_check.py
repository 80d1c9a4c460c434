"""``crazyarena mocap-check``: is the motion capture fit to fly with?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crazyarena.plain_text import shown
from crazyarena.runner.cli.common import EXIT_NOT_CLEAN, bad_input_exits
from crazyarena.runner.cli.options.mocap import (
    HOST_HELP,
    OPTION_HELP,
    SOURCE_HELP,
)


def register(app: typer.Typer) -> None:
    app.command("mocap-check")(mocap_check)


def mocap_check(
    mocap: Annotated[str, typer.Argument(metavar="MOCAP", help=SOURCE_HELP)],
    host: Annotated[str | None, typer.Option(help=HOST_HELP)] = None,
    body: Annotated[
        list[str] | None, typer.Option(help="A body that must be visible (repeatable).")
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.1, help="How long to listen.")] = 10.0,
    option: Annotated[list[str] | None, typer.Option(metavar="KEY=VALUE", help=OPTION_HELP)] = None,
    record: Annotated[
        Path | None, typer.Option(help="Also write the frames to this .mcap or .csv file.")
    ] = None,
) -> None:
    """Print rates, latency, jitter, dropouts and visible bodies, and say what is wrong."""
    with bad_input_exits():
        from contextlib import ExitStack, closing

        from crazyarena.clock import WallClock
        from crazyarena.mocap.check import MocapCheck, report_lines
        from crazyarena.mocap.poselog import PoseLogWriter
        from crazyarena.mocap.source import SourceState
        from crazyarena.runner.rig.cameras import open_named_source

        clock = WallClock()
        check = MocapCheck(body or (), knows_latency=mocap in ("zenoh", "replay"))
        with ExitStack() as stack:
            log = stack.enter_context(PoseLogWriter(record)) if record else None
            source = stack.enter_context(
                closing(open_named_source(mocap, host, option or (), clock))
            )
            start = clock.now()
            told = start
            while (now := clock.now()) < start + seconds:
                frames = source.frames(0.1)
                for frame in frames:
                    check.add(frame)
                    if log is not None:
                        log.write(frame)
                if not frames and source.status.state is SourceState.ENDED:
                    break
                if now - told >= 1.0:
                    told = now
                    typer.echo(shown(report_lines(check.report(source.status, now - start))[0]))
            report = check.report(source.status, clock.now() - start)
        typer.echo(shown("\n".join(report_lines(report))))
        if not report.healthy:
            raise typer.Exit(EXIT_NOT_CLEAN)
