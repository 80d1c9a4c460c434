"""``crazyarena mocap-survey``: measure the track before a trial."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crazyarena.plain_text import shown
from crazyarena.runner.cli.common import EXIT_NOT_CLEAN, bad_input_exits
from crazyarena.runner.cli.options.mocap import (
    HOST_HELP,
    OPTION_HELP,
    SOURCE_HELP,
)

if TYPE_CHECKING:
    from crazyarena.clock import Clock
    from crazyarena.mocap.source import PoseSource
    from crazyarena.types import PoseFrame


def register(app: typer.Typer) -> None:
    app.command("mocap-survey")(mocap_survey)


def _frames(source: PoseSource, clock: Clock, timeout: float) -> Iterator[PoseFrame]:
    end = clock.now() + timeout
    while clock.now() < end:
        yield from source.frames(0.1)


def mocap_survey(
    level: Annotated[str, typer.Argument(help="Level (name or file) whose track is set up.")],
    mocap: Annotated[str, typer.Argument(metavar="MOCAP", help=SOURCE_HELP)],
    output: Annotated[Path, typer.Option(help="Where to write the measured track.")],
    host: Annotated[str | None, typer.Option(help=HOST_HELP)] = None,
    option: Annotated[list[str] | None, typer.Option(metavar="KEY=VALUE", help=OPTION_HELP)] = None,
    frames: Annotated[int, typer.Option(min=10, help="Frames to average.")] = 200,
    tolerance: Annotated[
        float | None,
        typer.Option(min=0.0, help="Of x and y each, m, instead of the level's own ranges."),
    ] = None,
    timeout: Annotated[float, typer.Option(min=0.1, help="Give up after this long, s.")] = 30.0,
) -> None:
    """Average the poses of gates and obstacles; refuse what is out of tolerance.

    Each of x, y and yaw may differ from nominal by as much as the level draws them, the same as
    for preflight and fly. Refused is also a gate that cannot be flown through.
    """
    with bad_input_exits():
        from contextlib import closing
        from dataclasses import replace

        from crazyarena.clock import WallClock
        from crazyarena.levels import load_level
        from crazyarena.levels.lsy import is_lsy_level, load_lsy_level
        from crazyarena.mocap.survey import SurveyConfig, survey, write_track
        from crazyarena.runner.rig.cameras import open_named_source
        from crazyarena.safety.lsy_placement import lsy_allowed, lsy_nominal
        from crazyarena.safety.placement import allowed, nominal_track, obstructions

        theirs = is_lsy_level(level)
        if theirs:
            lsy = load_lsy_level(level)
            nominal, rules, moving = lsy_nominal(lsy), lsy_allowed(lsy), list[str]()
        else:
            flown = load_level(level)
            nominal, rules = nominal_track(flown), allowed(flown)
            moving = [f"gate{i + 1}" for i in flown.track.tracked]
        if tolerance is not None:
            reach = (-tolerance, tolerance)
            rules = {name: replace(rule, x=reach, y=reach) for name, rule in rules.items()}
        clock = WallClock()
        with closing(open_named_source(mocap, host, option or (), clock)) as source:
            report = survey(
                _frames(source, clock, timeout),
                nominal,
                SurveyConfig(frames=frames, allowed=rules, full_turn=theirs),
                moving,
            )
        for measured in report.bodies:
            typer.echo(
                f"{measured.name}: seen {measured.seen}/{report.frames}, "
                f"{measured.deviation * 1e2:.1f} cm from nominal, spread "
                f"{measured.spread * 1e3:.1f} mm"
            )
        if not report.accepted:
            typer.echo(shown("\n".join(report.problems)))
            raise typer.Exit(EXIT_NOT_CLEAN)
        blocked = [] if theirs else obstructions(flown, report.track())
        if blocked:
            typer.echo(shown("\n".join(blocked)))
            raise typer.Exit(EXIT_NOT_CLEAN)
        write_track(output, report, level)
        typer.echo(f"measured track written to {output}")
