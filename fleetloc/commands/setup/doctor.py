"""``fleetloc doctor``: is a drone set up right, and what is to be done where it is not?"""

from __future__ import annotations

from typing import Annotated

import typer

from fleetloc.errors import FAILED
from fleetloc.options import FleetFile, Overrides, Profiles


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("doctor")(doctor)


def doctor(
    config: FleetFile,
    agent_id: Annotated[int, typer.Option("--id", help="The drone that this computer is on.")],
    profiles: Profiles = None,
    overrides: Overrides = None,
    listen_s: Annotated[
        float, typer.Option("--listen", metavar="S", help="How long to listen to the autopilot.", min=0.1, max=600.0)
    ] = 12.0,
) -> None:
    """Look at a drone's set-up: one line each, with what to do.

    Run it on the drone, the daemon stopped, the autopilot on. It asks the autopilot for rates and parameters, as the
    daemon does, and sets none. Exit codes: 0 nothing is wrong, 1 something is.
    """
    import asyncio
    import time

    from agent.config.reading import load_document
    from fleetloc.config_check import check_document
    from fleetloc.doctor.examination import Mark, of_autopilot, of_computer
    from fleetloc.doctor.listening import listen
    from fleetloc.doctor.radio_device import of_radio
    from fleetloc.errors import InputError

    document = load_document(config, overrides or (), profiles or ())
    checked = check_document(document, config.parent, agent_id, unix_s=time.time())
    if checked.mistakes or checked.config is None:
        raise checked.mistakes[0]
    fleet = checked.config
    if agent_id not in fleet.ids:
        raise InputError("--id", "", f"one of {', '.join(map(str, fleet.ids))} of {config}", str(agent_id))
    lines = of_computer(fleet, checked.warnings) + of_radio(fleet, agent_id)
    heard = asyncio.run(listen(fleet, agent_id, config.parent, listen_s))
    lines += of_autopilot(fleet, agent_id, heard)
    for line in lines:
        typer.echo(str(line))
    if any(line.mark is Mark.WRONG for line in lines):
        raise typer.Exit(FAILED)
