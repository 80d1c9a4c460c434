"""``crazyarena export``: recordings to CSV, NPZ or Foxglove's messages."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crazyarena.runner.cli.common import bad_input_exits


def register(app: typer.Typer) -> None:
    app.command("export")(export)


def export(
    run: Annotated[Path, typer.Argument(help="Results folder, or one .mcap file.")],
    csv: Annotated[bool, typer.Option("--csv", help="Write a CSV file a topic.")] = False,
    npz: Annotated[bool, typer.Option("--npz", help="Write an NPZ file an episode.")] = False,
    foxglove: Annotated[
        bool,
        typer.Option(
            "--foxglove",
            help="Write <name>.foxglove.mcap in Foxglove's message types; "
            "docs/foxglove_layout.json shows them.",
        ),
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Folder to write to.")] = None,
) -> None:
    """Turn recordings into tables, or into what Foxglove and Lichtblick show as it is."""
    with bad_input_exits():
        from crazyarena.errors import InputError
        from crazyarena.runner.records import export as exporting

        if not (csv or npz or foxglove):
            raise InputError("export: nothing to write. Pass --csv, --npz, --foxglove or several")
        files = exporting.recordings(run)
        folder = out if out is not None else files[0].parent
        folder.mkdir(parents=True, exist_ok=True)
        for file in files:
            recording = exporting.read(file)
            if not recording.complete:
                typer.echo(f"{file}: cut short; exporting what it holds", err=True)
            stem = folder / file.name.removesuffix(".part").removesuffix(".mcap")
            written = exporting.write_csv(recording, stem) if csv else []
            written += exporting.write_npz(recording, stem) if npz else []
            if foxglove:
                from crazyarena.runner.records.foxglove import write_foxglove

                written.append(write_foxglove(file, stem.with_name(stem.name + exporting.FOXGLOVE)))
            for path in written:
                typer.echo(str(path))
