"""``fleetloc health``: asks a running daemon, for containers and service managers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fleetloc.errors import FAILED


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("health")(health)


def health(
    socket: Annotated[Path, typer.Argument(help="The daemon's socket, health.socket of its configuration.")],
    require_ok: Annotated[
        bool, typer.Option("--require-ok", help="Only state ok will do: located, on time, autopilot there.")
    ] = False,
    timeout_s: Annotated[float, typer.Option("--timeout", help="Seconds to wait for the answer.")] = 3.0,
) -> None:
    """Ask a running daemon how it is.

    Exit codes: 0 it runs and is not at fault, 1 it is, 3 nobody answers.
    """
    from agent.watch.health_query import STALE_AFTER_S, ask

    answer = ask(socket, timeout_s)
    state, reasons = answer["state"], ", ".join(answer["reasons"])
    stale = answer["age_s"] > STALE_AFTER_S
    typer.echo(f"{state}{f': {reasons}' if reasons else ''}{', but does not get on' if stale else ''}")
    wrong = state != "ok" if require_ok else state == "fault"
    if stale or wrong:
        raise typer.Exit(FAILED)
