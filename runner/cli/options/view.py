"""Options of whatever can be seen in a browser."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from crazyarena.viewer_process import ViewOptions

View = Annotated[
    bool,
    typer.Option("--view", help="Show it in the browser while it flies; the address is printed."),
]
ViewPort = Annotated[
    int,
    typer.Option(min=0, max=65535, help="Port of the viewer; 0 takes any that is free."),
]
ViewHost = Annotated[
    str,
    typer.Option(help="Address the viewer listens at; 0.0.0.0 lets others on the network look."),
]
ViewToken = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Browsers elsewhere that know this file's secret may stop, land and arm, too.",
    ),
]


def view_options(
    view: View = False,
    view_port: ViewPort = 8080,
    view_host: ViewHost = "127.0.0.1",
    view_token: ViewToken = None,
) -> Callable[[], ViewOptions | None]:
    """A group of options: the viewer of a live flight; it gives None without --view."""
    return lambda: _options(view, view_port, view_host, view_token)


def _options(view: bool, port: int, host: str, token: Path | None) -> ViewOptions | None:
    from crazyarena.errors import InputError
    from crazyarena.viewer_process import ViewOptions

    if not view:
        if token is not None:
            raise InputError("--view-token: nothing is shown; add --view")
        return None
    if token is not None:
        from crazyarena.secret import read_secret

        read_secret(token)
    return ViewOptions(host, port, token)
