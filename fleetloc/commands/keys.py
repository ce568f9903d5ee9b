"""``fleetloc keys``: signing keys, certificates, group key and MAVLink keys of a fleet."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from fleetloc.fleet_keys import FleetKeys

Config = Annotated[Path, typer.Argument(help="Configuration of the fleet; its security.keys names the folder.")]
AgentId = Annotated[int, typer.Option("--id", help="Agent.")]
OptionalId = Annotated[int | None, typer.Option("--id", help="Agent.")]
Days = Annotated[float, typer.Option("--days", min=1, max=3650, help="How long certificates are valid.")]
Group = Annotated[bool, typer.Option("--group", help="The key that encrypts payloads.")]


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    keys = typer.Typer(help="Make, list, replace and hand out the keys of a fleet.", no_args_is_help=True)
    keys.command("init")(init)
    keys.command("add")(add)
    keys.command("list")(list_all)
    keys.command("rotate")(rotate)
    keys.command("retire")(retire)
    keys.command("export")(export)
    keys.command("passphrase")(passphrase)
    app.add_typer(keys, name="keys")


def init(
    config: Config,
    days: Days = 90,
    missing: Annotated[
        bool, typer.Option("--missing", help="Make only what is not there, e.g. certificates beside older keys.")
    ] = False,
) -> None:
    """Make the folder with everything for every agent.

    Nothing that exists is overwritten.
    """
    keys = _keys(config, days=days)
    keys.init(missing_only=missing)
    _print(keys)
    typer.echo(f"keys in {keys.folder}: `fleetloc keys export` makes a drone's folder; ca.key stays here", err=True)


def add(config: Config, agent_id: AgentId, days: Days = 90) -> None:
    """Make everything for one more agent."""
    keys = _keys(config, agent_id, days=days)
    keys.add(agent_id)
    _print(keys)


def list_all(config: Config) -> None:
    """Show what is there, and when certificates expire."""
    _print(_keys(config))


def rotate(
    config: Config,
    agent_id: OptionalId = None,
    group: Group = False,
    observer: Annotated[bool, typer.Option("--observer", help="The certificate of those who only listen.")] = False,
    mavlink: Annotated[bool, typer.Option("--mavlink", help="With --id: the key of its MAVLink link.")] = False,
    days: Days = 90,
) -> None:
    """Replace the signing key and certificate of an agent.

    Or what is named. The signing key and group key from before are accepted until `retire`, a certificate until it
    expires.
    """
    keys = _keys(config, agent_id, days=days)
    _one_of(agent_id is not None, group, observer)
    export, retire = f"fleetloc keys export {config}", f"fleetloc keys retire {config}"
    if group:
        keys.rotate_group()
        then = f"`{export} --id ID --out FOLDER` for every drone, restart their daemons, then `{retire} --group`"
    elif observer:
        keys.certify(None)
        then = f"`{export} --observer --out FOLDER` for whoever listens"
    elif agent_id is not None and mavlink:
        keys.rotate_mavlink(agent_id)
        then = (
            f"`fleetloc keys passphrase {config} --id {agent_id}` for its autopilot, "
            f"`{export} --id {agent_id} --out FOLDER` for its drone, restart its daemon"
        )
    else:
        assert agent_id is not None
        keys.rotate(agent_id)
        then = (
            f"`{export} --id ID --out FOLDER` for drone {agent_id} and for all that hear it, restart their daemons, "
            f"then `{retire} --id {agent_id}`"
        )
    _print(keys)
    typer.echo(f"next: {then}", err=True)


def retire(config: Config, agent_id: OptionalId = None, group: Group = False) -> None:
    """Stop accepting the key from before the last rotation."""
    keys = _keys(config, agent_id)
    _one_of(agent_id is not None, group)
    if agent_id is not None:
        keys.retire(agent_id)
    else:
        keys.retire_group()
    _print(keys)


def export(
    config: Config,
    out: Annotated[Path, typer.Option("--out", help="New folder; it becomes security.keys there.")],
    agent_id: OptionalId = None,
    observer: Annotated[bool, typer.Option("--observer", help="For someone who only listens.")] = False,
) -> None:
    """Copy what one drone needs into a new folder.

    And nothing else: no other drone's secret, no authority's key.
    """
    keys = _keys(config, agent_id)
    _one_of(agent_id is not None, observer)
    files = keys.export(agent_id, out)
    typer.echo(f"{out}: {', '.join(path.name for path in files)}")


def passphrase(config: Config, agent_id: AgentId) -> None:
    """Print the passphrase of an agent's MAVLink link.

    It is typed into the ground station that sets signing up on the autopilot.
    """
    from transport.security.shared_keys import load_mavlink_passphrase

    typer.echo(load_mavlink_passphrase(_keys(config, agent_id).folder, agent_id))


def _keys(config: Path, agent_id: int | None = None, *, days: float = 90) -> FleetKeys:
    """The keys of a configuration's fleet, ``agent_id`` checked against it."""
    import time

    from agent.config.reading import load_config
    from fleetloc.errors import InputError
    from fleetloc.fleet_keys import FleetKeys

    fleet = load_config(config)
    if agent_id is not None and agent_id not in fleet.ids:
        raise InputError("--id", "", f"one of {', '.join(map(str, fleet.ids))} of {config}", str(agent_id))
    return FleetKeys(fleet, config.parent, time.time(), days)


def _one_of(*chosen: bool) -> None:
    from fleetloc.errors import InputError

    if sum(chosen) != 1:
        expected = "one of --id, --group, --observer (those that the command has)"
        raise InputError("options", "", expected, f"{sum(chosen)} of them")


def _print(keys: FleetKeys) -> None:
    for line in keys.lines():
        typer.echo(line)
