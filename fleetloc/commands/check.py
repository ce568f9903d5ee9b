"""``fleetloc check``: is a configuration right, and what is it in full?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleetloc.errors import BAD_INPUT
from fleetloc.options import FleetFile, Overrides, Profiles

if TYPE_CHECKING:
    from agent.config.tables import FleetConfig


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("check")(check)


def check(
    config: FleetFile,
    profiles: Profiles = None,
    overrides: Overrides = None,
    agent_id: Annotated[
        int | None, typer.Option("--id", help="Check the keys of this agent only, as its drone would.")
    ] = None,
    show: Annotated[
        bool, typer.Option("--print", help="Print the effective configuration, defaults filled in.")
    ] = False,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write mistakes and warnings here; - is the terminal.")
    ] = None,
) -> None:
    """Check a configuration; starts nothing and opens nothing.

    Its simulated scenario and its security profile are checked too.

    All mistakes are told at once, each with its file and line; warnings are about what is right and seldom meant.
    On the ground, where the authority's key is, the keys of every agent are checked, elsewhere those that are here.
    """
    import time

    from agent.config.reading import dump, load_document
    from fleetloc.config_check import check_document
    from fleetloc.errors import InputError
    from fleetloc.output import write_json

    document = load_document(config, overrides or (), profiles or ())
    checked = check_document(document, config.parent, agent_id, unix_s=time.time(), keys=not show)
    fleet = checked.config
    if agent_id is not None and fleet is not None and agent_id not in fleet.ids:
        raise InputError("--id", "", f"one of {', '.join(map(str, fleet.ids))} of {config}", str(agent_id))
    if json_file is not None:
        write_json(json_file, checked.as_dict())
    for error in checked.mistakes:
        typer.echo(f"fleetloc: error: {error}", err=True)
    for line in checked.warnings:
        typer.echo(f"warning: {line}", err=True)
    if checked.mistakes:
        raise typer.Exit(BAD_INPUT)
    assert fleet is not None
    if show:
        typer.echo(dump(fleet), nl=False)
    elif json_file is None or str(json_file) != "-":
        _summary(config, fleet)


def _summary(config: Path, fleet: FleetConfig) -> None:
    rate_hz = 1 / fleet.fleet.period_s
    typer.echo(f"{config}: no mistakes; fleet {fleet.fleet.name}, {rate_hz:g} Hz, {fleet.estimator.kind}")
    for table in fleet.agents:
        hears = ", ".join(map(str, fleet.neighbours(table.id))) or "nobody"
        listens = ", ".join(fleet.listen(table.id))
        typer.echo(f"agent {table.id}: {table.mavlink} ({table.autopilot}), listens on {listens}, hears {hears}")
