"""``crazyarena preflight``: the checklist before a flight."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from crazyarena.runner.cli.common import EXIT_NOT_CLEAN, Overrides, bad_input_exits
from crazyarena.runner.cli.options.groups import takes
from crazyarena.runner.cli.options.mocap import HOST_HELP, OPTION_HELP, SOURCE_HELP
from crazyarena.runner.cli.options.stops import (
    Gamepad,
    StopConnect,
    StopListen,
    StopNetwork,
    StopToken,
    Waive,
    stop_options,
)
from crazyarena.runner.cli.options.vehicle import vehicle_choice
from crazyarena.whole_file import write_whole

if TYPE_CHECKING:
    from crazyarena.safety.preflight import Line
    from crazyarena.sim_backend.vehicles import VehicleChoice


def register(app: typer.Typer) -> None:
    app.command("preflight")(preflight)


@takes(vehicle=vehicle_choice)
def preflight(
    uri: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=URI", help="A vehicle; NAME is its body. Repeatable."),
    ] = None,
    level: Annotated[str, typer.Option(help="Level to be flown.")] = "sim2real",
    set_: Overrides = None,
    mocap: Annotated[str | None, typer.Option(help=SOURCE_HELP)] = None,
    host: Annotated[str | None, typer.Option("--mocap-host", "--host", help=HOST_HELP)] = None,
    option: Annotated[
        list[str] | None,
        typer.Option("--mocap-option", "--option", metavar="KEY=VALUE", help=OPTION_HELP),
    ] = None,
    controller: Annotated[int, typer.Option(help="1 PID, 2 Mellinger.")] = 2,
    tip: Annotated[
        bool, typer.Option("--tip", help="Ask for each vehicle to be tipped by hand.")
    ] = False,
    waive: Waive = None,
    wait: Annotated[float, typer.Option(min=0.5, help="s, to gather what is checked.")] = 5.0,
    out: Annotated[Path, typer.Option(help="Where recordings would go.")] = Path("runs"),
    report: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the checklist as JSON, too.")
    ] = None,
    gamepad: Gamepad = None,
    stop_network: StopNetwork = False,
    stop_connect: StopConnect = None,
    stop_listen: StopListen = None,
    stop_token: StopToken = None,
    *,
    vehicle: VehicleChoice,
) -> None:
    """Check vehicles, cameras, arena and machine; red lines come with a remedy.

    While it listens, try the emergency stop: crazyarena estop --test in another shell, or any
    source named here; it stops nothing. crazyarena fly believes for an hour what was tried.
    Nothing is armed and no motor turns. Exit code: 0 when every line is green or waived, 1 when
    not.
    """
    with bad_input_exits():
        from rich.console import Console

        from crazyarena.runner.trial.preflight import Wanted, gather
        from crazyarena.safety.preflight import may_fly

        console = Console()
        wanted = Wanted(
            level,
            tuple(uri or ()),
            mocap,
            host,
            tuple(option or ()),
            tuple(set_ or ()),
            controller,
            tip,
            wait,
            out,
            stop_options(
                gamepad, None, stop_network, stop_connect, stop_listen, stop_token, "preflight"
            ),
            vehicle,
        )
        checklist = gather(
            wanted, lambda text: console.print(text, highlight=False, markup=False, soft_wrap=True)
        )
        lines = checklist.run(waive or ())
        console.print(table(lines))
        ready = may_fly(lines)
        console.print("Ready to fly." if ready else "Not ready: see the lines marked no.")
        if report is not None:
            _write(report, wanted, lines, ready)
    if not ready:
        raise typer.Exit(EXIT_NOT_CLEAN)


def table(lines: list[Line]) -> Any:
    """Rich table, a row a line."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    view = Table(box=box.SIMPLE, header_style="bold", pad_edge=False)
    for name in ("", "line", "found", "remedy"):
        view.add_column(name)
    for line in lines:
        if not line.checked:
            word, style = "--", "yellow"
        elif line.ok:
            word, style = "ok", "green"
        else:
            word, style = ("waived", "yellow") if line.waived else ("no", "red")
        remedy = "" if line.ok else line.remedy
        view.add_row(Text(word, style), Text(line.name), Text(line.found), Text(remedy))
    return view


def _write(file: Path, wanted: Any, lines: list[Line], ready: bool) -> None:
    import datetime
    import json
    from dataclasses import asdict

    from crazyarena.errors import InputError

    document = {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "level": wanted.level,
        "vehicles": wanted.vehicles(),
        "ready": ready,
        "waived": [line.name for line in lines if line.waived],
        "lines": [asdict(line) for line in lines],
    }
    try:
        write_whole(file, json.dumps(document, indent=2) + "\n")
    except OSError as error:
        raise InputError(f"--report {file}: cannot write it: {error.strerror}") from None
