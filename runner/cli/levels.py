"""``crazyarena levels``: the levels that come along."""

from __future__ import annotations

from typing import Annotated

import typer

from crazyarena.runner.cli.common import bad_input_exits


def register(app: typer.Typer) -> None:
    app.command("levels")(levels)


def levels(
    name: Annotated[
        str | None, typer.Argument(help="Show this level (name or file) in full.")
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="FIELD=VALUE", help="Override a field.")
    ] = None,
) -> None:
    """List the shipped levels, or print one with every field, ready to be edited."""
    with bad_input_exits():
        from crazyarena.levels import dump_level, load_level, shipped_levels
        from crazyarena.levels.lsy import (
            is_lsy_level,
            load_lsy_level,
            lsy_text,
            shipped_lsy_levels,
        )

        if name is not None and is_lsy_level(name):
            load_lsy_level(name, set_ or (), race=True)  # says what is wrong with it
            typer.echo(lsy_text(name), nl=False)
            return
        if name is not None:
            typer.echo(dump_level(load_level(name, set_ or ())), nl=False)
            return
        for shipped in shipped_levels():
            level = load_level(shipped)
            random = level.randomization
            parts = {
                "start": random.start,
                "inertia": random.inertia,
                "track": random.gates_and_obstacles,
                "disturbances": level.disturbances.action or level.disturbances.dynamics,
            }
            what = ", ".join(key for key, value in parts.items() if value) or "nothing"
            typer.echo(
                f"{shipped:<16} {len(level.track.gates)} gates, {level.num_episodes} episodes, "
                f"random: {what}"
            )
        for shipped in shipped_lsy_levels():
            foreign = load_lsy_level(shipped, race=True)
            drawn = [key for key, value in foreign.env.randomizations if value is not None]
            layout = ["layout"] if foreign.env.track.randomize else []
            what = ", ".join([*layout, *drawn]) or "nothing"
            gates = len(foreign.env.track.gates)
            drones = f", {foreign.drones} drones" if foreign.race else ""
            typer.echo(f"{shipped:<16} {gates} gates{drones}, random: {what}")
