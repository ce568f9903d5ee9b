"""``fleetloc monitor``: watch a fleet from a laptop that only listens."""

from __future__ import annotations

from typing import Annotated

import typer

from fleetloc.options import FleetFile, Overrides, Profiles


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("monitor")(monitor)


def monitor(
    config: FleetFile,
    profiles: Profiles = None,
    overrides: Overrides = None,
    connect: Annotated[
        list[str] | None,
        typer.Option("--connect", help="Endpoint to dial instead of those of the file, e.g. tcp/192.168.7.3:7447."),
    ] = None,
    web: Annotated[bool, typer.Option("--web/--no-web", help="Serve the web page.")] = True,
    table: Annotated[bool, typer.Option("--table/--no-table", help="Show the table in the terminal.")] = True,
    duration_s: Annotated[float | None, typer.Option("--duration", help="End after so many seconds.")] = None,
) -> None:
    """Show a fleet in the terminal and on a local web page.

    It listens and never sends, until Ctrl-C.
    """
    import asyncio

    from agent.config.reading import load_config
    from fleetloc.errors import InputError
    from fleetloc.monitor.run import LiveMonitor

    if duration_s is not None and not duration_s > 0:
        raise InputError("--duration", "", "seconds greater than 0", f"{duration_s:g}")
    fleet = load_config(config, list(overrides or ()), profiles or ())

    async def show() -> None:
        shown = LiveMonitor(fleet, config.parent, endpoints=connect or (), web=web, terminal=table)
        await shown.run(duration_s)

    asyncio.run(show())
