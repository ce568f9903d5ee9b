"""``fleetloc check``: is a configuration right, and what is it in full?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fleetloc.options import Overrides, Profiles


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("check")(check)


def check(
    config: Annotated[Path, typer.Argument(help="Configuration of a fleet (TOML).")],
    profiles: Profiles = None,
    overrides: Overrides = None,
    agent_id: Annotated[
        int | None, typer.Option("--id", help="Check the keys of this agent only, as its drone would.")
    ] = None,
    show: Annotated[
        bool, typer.Option("--print", help="Print the effective configuration, defaults filled in.")
    ] = False,
) -> None:
    """Check a configuration, its simulated scenario and its security profile; starts nothing and opens nothing.

    On the ground, where the authority's key is, the keys of every agent are checked, elsewhere those that are here.
    """
    import time

    from agent.config.reading import dump
    from agent.radio.security import agents_here, expiry_warnings, security_faults, state_warnings
    from agent.sensing.clock import require_epoch
    from fleetloc.errors import InputError
    from fleetloc.whole_config import load_whole
    from sim_bridge.world.scenario_config import scenario_from_config

    fleet = load_whole(config, overrides or (), profiles or ())
    scenario_from_config(fleet)
    if show:
        typer.echo(dump(fleet), nl=False)
        return
    if agent_id is not None and agent_id not in fleet.ids:
        raise InputError("--id", "", f"one of {', '.join(map(str, fleet.ids))} of {config}", str(agent_id))
    base, unix_s = config.parent, time.time()
    warnings = [line for line in (require_epoch(fleet.fleet, str(config), unix_s=unix_s),) if line is not None]
    here = (agent_id,) if agent_id is not None else agents_here(fleet, base)
    faults = dict.fromkeys(line for one in here for line in security_faults(fleet, one, base, unix_s=unix_s))
    if faults:
        for line in faults:
            typer.echo(line, err=True)
        expected = f"all that profile {fleet.security.profile} promises"
        raise InputError(str(config), "security", expected, f"{len(faults)} things missing, see above")
    for one in here:
        warnings += expiry_warnings(fleet, one, base, unix_s=unix_s)
    for line in dict.fromkeys([*warnings, *state_warnings(fleet, base)]):
        typer.echo(f"warning: {line}", err=True)
    typer.echo(f"{config}: fleet {fleet.fleet.name}, {1 / fleet.fleet.period_s:g} Hz, {fleet.estimator.kind}")
    for table in fleet.agents:
        hears = ", ".join(map(str, fleet.neighbours(table.id))) or "nobody"
        listens = ", ".join(fleet.listen(table.id))
        typer.echo(f"agent {table.id}: {table.mavlink} ({table.autopilot}), listens on {listens}, hears {hears}")
