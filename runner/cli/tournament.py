"""``crazyarena tournament``: strangers' submissions on all levels, points, and a page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crazyarena.runner.cli.common import EXIT_NOT_CLEAN, bad_input_exits

if TYPE_CHECKING:
    from rich.console import Console

    from crazyarena.runner.tournament.run import Tournament


def register(app: typer.Typer) -> None:
    app.command("tournament")(tournament)


def tournament(
    source: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FOLDER|LIST]",
            help="Folder with a submission a team, or a list of teams (.csv: team,path; .yaml). "
            "Left out, the tournament in --out goes on.",
        ),
    ] = None,
    levels: Annotated[
        str | None,
        typer.Option(
            metavar="LEVEL,...",
            help="Default: level0,level1,level2,level3,sim2real, and lsy/level2 where a team is "
            "of lsy_drone_racing.",
        ),
    ] = None,
    seeds: Annotated[
        int | None, typer.Option(min=1, help="Secret draws of each level. Default: 10.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Results folder, and all that is needed to go on. Default: a new one."),
    ] = None,
    rules: Annotated[
        str | None,
        typer.Option(help="iros2022, lsy, or a file. Default: by the levels."),
    ] = None,
    title: Annotated[str | None, typer.Option(help="Of the page.")] = None,
    compute: Annotated[
        str | None,
        typer.Option(
            metavar="free|fixed=MS|measured",
            help="What thinking costs on the simulated clock. Default: free. measured needs a "
            "machine to itself.",
        ),
    ] = None,
    patience: Annotated[
        float | None,
        typer.Option(help="s of wall time for an answer whose time does not count. Default: 10."),
    ] = None,
    record: Annotated[
        bool | None,
        typer.Option("--record/--no-record", help="Keep an MCAP file an episode. Default: yes."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="tcp://HOST:PORT", help="A dask scheduler, whose workers fly. Default: here."
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes here. Default: as many as processors.")
    ] = None,
    add_trial: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[TEAM=]RUN", help="Take in a run of crazyarena fly; may be repeated."
        ),
    ] = None,
    compare: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TEAM,TEAM",
            help="Compare two teams on the same draws; may be repeated. Neighbours of the "
            "leaderboard always are.",
        ),
    ] = None,
    watch: Annotated[
        bool, typer.Option("--watch", help="Show the whole table while it flies.")
    ] = False,
    parquet: Annotated[
        bool, typer.Option("--parquet", help="Write results.parquet as well (needs pyarrow).")
    ] = False,
) -> None:
    """Fly every submission on every level, each behind walls, all in the same secret worlds.

    Started again with the same --out it goes on where it was, whatever ended it.

    Exit code: 0 when everything was flown, 1 when some of it could not be, 2 when something is at
    fault.
    """
    with bad_input_exits():
        from rich.console import Console

        from crazyarena.runner.records.run_folder import run_folder
        from crazyarena.runner.tournament.run import open_tournament

        console = Console()
        if not console.is_terminal:
            console = Console(width=160)
        given = {"seeds": seeds, "compute": compute, "patience": patience, "record": record}
        chosen = {name: value for name, value in given.items() if value is not None}
        if out is None:
            from crazyarena.errors import InputError

            if source is None:
                raise InputError(
                    "pass a folder or a list of submissions, or the --out of a tournament"
                )
            out = run_folder(None, source, "tournament")
        names = None if levels is None else [n.strip() for n in levels.split(",") if n.strip()]
        pairs = [_pair(text) for text in compare or []]
        event = open_tournament(out, source, names, chosen, rules, title)
        try:
            failed = _fly(
                event, console, scheduler, workers, add_trial or [], watch, parquet, pairs
            )
        finally:
            event.close()
    if failed:
        raise typer.Exit(EXIT_NOT_CLEAN)


def _fly(
    event: Tournament,
    console: Console,
    scheduler: str | None,
    workers: int | None,
    trials: list[str],
    watch: bool,
    parquet: bool,
    compare: list[tuple[str, str]],
) -> bool:
    """Fly, write and tell; whether something is missing."""
    import itertools
    import os

    from crazyarena.runner.tournament.engine import Engine
    from crazyarena.runner.tournament.page import write_pages
    from crazyarena.runner.tournament.results import assemble, named, write_files
    from crazyarena.runner.tournament.run import measured_remark
    from crazyarena.runner.tournament.tables import Watch, tell
    from crazyarena.runner.tournament.trials import add_trial

    def say(text: str) -> None:
        console.print(text, markup=False, highlight=False, soft_wrap=True)

    for trial in trials:
        for line in add_trial(event, trial):
            say(f"{line['team']} on {line['level']}: {line['outcome']} taken in")
    for team in event.plan.teams:
        if team.trouble:
            say(f"{team.name} does not fly: {team.trouble}")
    if event.journal.dropped:
        say("The last line of the journal was cut short; its episode is flown again.")
    if event.resumed:
        say(f"{event.resumed} episodes were there already.")
    remark = measured_remark(event.plan)
    if remark:
        event.remarks.append(remark)
    event.warm_up(console)
    for name in itertools.chain.from_iterable(compare):
        named(event.plan.teams, name)
    failed: list[str] = []
    try:
        count = workers or len(os.sched_getaffinity(0))
        with Watch(event, console, count, watch) as shown:
            failed = event.fly(
                lambda: Engine(
                    scheduler, workers, measured=event.plan.options.compute == "measured", say=say
                ),
                shown.flown,
                shown.tick,
                say,
            )
    except KeyboardInterrupt:
        say("Stopped. What was flown is safe; the same --out goes on.")
        failed = ["stopped"]
    event.remarks += [f"could not be flown: {reason}" for reason in failed]
    results = assemble(event, compare)
    write_files(results, parquet)
    page = write_pages(results)
    tell(results, console)
    say(f"Results in {event.out}; page: {page}")
    return bool(failed)


def _pair(text: str) -> tuple[str, str]:
    from crazyarena.errors import InputError

    first, comma, second = text.partition(",")
    if not comma or not first.strip() or not second.strip():
        raise InputError(f"--compare {text}: expected the names of two teams, with a comma between")
    return first.strip(), second.strip()
