"""Options of whatever can be seen in a browser."""

from __future__ import annotations

from typing import Annotated

import typer

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
