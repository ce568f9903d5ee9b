"""``fleetloc check``: is a configuration right, and what is it in full?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("check")(check)


def check(
    config: Annotated[Path, typer.Argument(help="Configuration of a fleet (TOML).")],
    overrides: Annotated[
        list[str] | None, typer.Option("--set", help="KEY=VALUE, beats the file; may be repeated.")
    ] = None,
    show: Annotated[
        bool, typer.Option("--print", help="Print the effective configuration, defaults filled in.")
    ] = False,
) -> None:
    """Check a configuration, its simulated scenario included; starts nothing and opens nothing."""
    from agent.config import dump, load_config
    from sim_bridge.scenario_config import scenario_from_config

    fleet = load_config(config, overrides or ())
    scenario_from_config(fleet)
    if show:
        typer.echo(dump(fleet), nl=False)
        return
    typer.echo(f"{config}: fleet {fleet.fleet.name}, {1 / fleet.fleet.period_s:g} Hz, {fleet.estimator.kind}")
    for table in fleet.agents:
        hears = ", ".join(map(str, fleet.neighbours(table.id))) or "nobody"
        listens = ", ".join(fleet.listen(table.id))
        typer.echo(f"agent {table.id}: {table.mavlink} ({table.autopilot}), listens on {listens}, hears {hears}")
