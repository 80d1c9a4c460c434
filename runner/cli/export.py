"""``crazyarena export``: recordings to CSV or NPZ."""

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
    out: Annotated[Path | None, typer.Option(help="Folder to write to.")] = None,
) -> None:
    """Turn recordings into tables."""
    with bad_input_exits():
        from crazyarena.errors import InputError
        from crazyarena.runner.records import export as exporting

        if not (csv or npz):
            raise InputError("export: nothing to write. Pass --csv, --npz or both")
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
            for path in written:
                typer.echo(str(path))
