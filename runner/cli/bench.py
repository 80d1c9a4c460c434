"""``crazyarena bench``: the whole hardware path in real time, without hardware."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from crazyarena.runner.cli.common import (
    EXIT_NOT_CLEAN,
    AnySubmission,
    ArenaLevel,
    Compute,
    ComputeFactor,
    Late,
    LateChoice,
    MaxMisses,
    Out,
    Overrides,
    RequireSandbox,
    Seed,
    bad_input_exits,
)
from crazyarena.runner.cli.stop_options import (
    DeadMan,
    Gamepad,
    StopConnect,
    StopListen,
    StopNetwork,
    StopToken,
    Waive,
    stop_options,
)


class LinkChoice(StrEnum):
    """What carries the radio protocol."""

    UDP = "udp"
    RADIO = "radio"


def register(app: typer.Typer) -> None:
    app.command("bench")(bench)


def bench(
    submission: AnySubmission = None,
    level: ArenaLevel = "sim2real",
    runs: Annotated[int, typer.Option(min=1, max=100, help="How many, on the same draw.")] = 1,
    seed: Seed = None,
    out: Out = None,
    set_: Overrides = None,
    dry: Annotated[
        bool, typer.Option("--dry/--no-dry", help="Fly the dry runs too, and compare.")
    ] = True,
    link: Annotated[
        LinkChoice, typer.Option(help="UDP, or a virtual Crazyradio under cflib's radio driver.")
    ] = LinkChoice.UDP,
    mocap_rate: Annotated[
        float | None, typer.Option(min=10.0, max=500.0, metavar="HZ", help="Camera frames.")
    ] = None,
    compute: Compute = None,
    compute_factor: ComputeFactor = 1.0,
    late: Late = LateChoice.HOLD,
    max_misses: MaxMisses = 15,
    require_sandbox: RequireSandbox = False,
    real_time: Annotated[
        bool, typer.Option(help="Ask for real-time scheduling and locked memory.")
    ] = True,
    figure: Annotated[bool, typer.Option(help="Write figures.")] = True,
    waive: Waive = None,
    gamepad: Gamepad = None,
    dead_man: DeadMan = None,
    stop_network: StopNetwork = False,
    stop_connect: StopConnect = None,
    stop_listen: StopListen = None,
    stop_token: StopToken = None,
) -> None:
    """Fly a virtual Crazyflie over UDP or radio with cameras over zenoh, in real time.

    Radio protocol, client, camera network, watchdog and contestant's process are those of a
    flight; --compute is for the dry runs that it is compared with.
    """
    with bad_input_exits():
        import datetime

        from rich.console import Console

        from crazyarena.levels import load_level
        from crazyarena.runner import compare as comparing
        from crazyarena.runner.bench import Bench
        from crazyarena.runner.flight_options import FlightOptions

        console = Console()
        loaded = load_level(level, set_ or [])
        stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
        folder = out if out is not None else Path("runs") / f"{stamp}-bench-{loaded.name}"
        folder.mkdir(parents=True, exist_ok=True)
        result = Bench(
            submission,
            level,
            folder.resolve(),
            overrides=set_ or [],
            runs=runs,
            seed=loaded.seed if seed is None else seed,
            dry=dry,
            options=FlightOptions(
                require_sandbox=require_sandbox,
                compute=compute,
                factor=compute_factor,
                late=late.policy,
                max_misses=max_misses,
            ),
            real_time=real_time,
            figure=figure,
            console=console,
            waive=waive or (),
            radio=link is LinkChoice.RADIO,
            cameras=None if mocap_rate is None else {"rate": mocap_rate},
            stops=stop_options(
                gamepad, dead_man, stop_network, stop_connect, stop_listen, stop_token, "bench"
            ),
        ).run()
        if result.comparison is not None:
            console.print(comparing.table(result.comparison))
            summary = {**result.comparison.summary(), "arenas": result.arenas}
            (folder / "compare.json").write_text(json.dumps(summary, indent=2) + "\n")
            if figure:
                comparing.save_figure(folder / "compare.png", result.comparison)
                console.print(f"Figure: {folder / 'compare.png'}", highlight=False, soft_wrap=True)
    if not result.clean:
        raise typer.Exit(EXIT_NOT_CLEAN)
