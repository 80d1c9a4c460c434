"""``crazyarena arena-check``: is the fence of a level sound, and what does it look like?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crazyarena.runner.cli.common import EXIT_NOT_CLEAN, bad_input_exits


def register(app: typer.Typer) -> None:
    app.command("arena-check")(arena_check)


def arena_check(
    level: Annotated[str, typer.Argument(help="Shipped level, or a level file.")] = "level0",
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="FIELD=VALUE", help="Override a field of the level."),
    ] = None,
    out: Annotated[Path, typer.Option(help="PNG to draw to.")] = Path("arena.png"),
    height: Annotated[float, typer.Option(help="m, of the cut seen from above.")] = 1.0,
    track: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write the nominal track there, to be corrected by hand where no cameras can "
            "measure it, for --survey.",
        ),
    ] = None,
) -> None:
    """Check a level's fence and keep-out zones, and draw them.

    Exit code 2 when they contradict each other or the level, 1 when something stands in a gate's
    opening or a gate has no room.
    """
    with bad_input_exits():
        from crazyarena.errors import InputError
        from crazyarena.levels.lsy.arena import bare_arena
        from crazyarena.mocap.survey import write_taped
        from crazyarena.runner.records.arena_figure import save_arena
        from crazyarena.safety.fence import Fence
        from crazyarena.safety.placement import nominal_track, obstructions

        chosen = bare_arena(level, set_ or ())
        fence = Fence.from_level(chosen)
        low, high = fence.bounds
        typer.echo(f"{chosen.name}: hard fence {list(low)} .. {list(high)} m")
        typer.echo(f"soft margin {fence.soft_margin:g} m, {len(fence.zones)} keep-out zones")
        for name, place in (("start", chosen.start.position), ("goal", chosen.goal.position)):
            x, y, z = place
            text = f"{name}: {fence.clearance(x, y, z):.2f} m inside the fence"
            if fence.zones:
                text += f", {fence.zone_distance(x, y, z):.2f} m from the nearest zone"
            typer.echo(text)
        problems = obstructions(chosen)
        for problem in problems:
            typer.echo(problem)
        try:
            save_arena(out, chosen, fence, height)
        except OSError as error:
            raise InputError(f"--out {out}: cannot write: {error.strerror}") from None
        typer.echo(f"Drawn to {out}")
        if track is not None:
            write_taped(track, nominal_track(chosen), chosen.name)
            typer.echo(f"Nominal track written to {track}: correct x, y (m) and yaw (rad) in it")
    if problems:
        raise typer.Exit(EXIT_NOT_CLEAN)
