"""``fleetloc examples``: the example configurations and the systemd unit that come with the installation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("examples")(examples)


def examples(
    folder: Annotated[
        Path | None, typer.Option("--copy", help="Copy them into this folder, which must be new or empty.")
    ] = None,
) -> None:
    """List the examples that come with fleetloc, or copy them.

    They are configurations and the systemd unit.
    """
    from fleetloc import examples as held

    if folder is not None:
        typer.echo(f"{len(held.copy(folder))} files copied to {folder}")
        return
    typer.echo(f"in {held.DATA} (copy them with: fleetloc examples --copy DIR)")
    for name, what in held.files().items():
        typer.echo(f"  {name.as_posix():36} {what}".rstrip())
