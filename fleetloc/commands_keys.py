"""``fleetloc keys``: the signing keys of a fleet."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from transport.keys import KeyInfo

Config = Annotated[Path, typer.Argument(help="Configuration of the fleet; its security.keys names the folder.")]
AgentId = Annotated[int, typer.Option("--id", help="Agent.")]


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    keys = typer.Typer(help="Make, list and replace the signing keys of a fleet.", no_args_is_help=True)
    keys.command("init")(init)
    keys.command("add")(add)
    keys.command("list")(list_all)
    keys.command("rotate")(rotate)
    keys.command("retire")(retire)
    app.add_typer(keys, name="keys")


def init(config: Config) -> None:
    """Make the folder and a key pair for every agent; no key that exists is overwritten."""
    from transport.keys import init_keys

    folder, ids = _folder_and_ids(config)
    _print(init_keys(folder, ids))
    typer.echo(f"keys in {folder}: give each drone its own .key and everybody's .pub", err=True)


def add(config: Config, agent_id: AgentId) -> None:
    """Make a key pair for one more agent."""
    from transport.keys import add_key

    _print([add_key(_folder_and_ids(config, agent_id)[0], agent_id)])


def list_all(config: Config) -> None:
    """Show whose keys are there, by fingerprint."""
    from transport.keys import list_keys

    _print(list_keys(_folder_and_ids(config)[0]))


def rotate(config: Config, agent_id: AgentId) -> None:
    """Give an agent a new key pair; its present public key is still accepted until `retire`."""
    from transport.keys import rotate_key

    _print([rotate_key(_folder_and_ids(config, agent_id)[0], agent_id)])


def retire(config: Config, agent_id: AgentId) -> None:
    """Stop accepting the key from before an agent's last rotation."""
    from transport.keys import retire_key

    _print([retire_key(_folder_and_ids(config, agent_id)[0], agent_id)])


def _folder_and_ids(config: Path, agent_id: int | None = None) -> tuple[Path, tuple[int, ...]]:
    """The key folder of a configuration and the ids of its fleet, ``agent_id`` checked against them."""
    from agent.config import load_config
    from fleetloc.errors import InputError

    fleet = load_config(config)
    if agent_id is not None and agent_id not in fleet.ids:
        raise InputError("--id", "", f"one of {', '.join(map(str, fleet.ids))} of {config}", str(agent_id))
    return config.parent / fleet.security.keys, fleet.ids


def _print(infos: list[KeyInfo]) -> None:
    for info in infos:
        secret = "secret here" if info.has_secret else "public only"
        typer.echo(f"agent {info.agent_id:3d}  {secret}  {'  '.join(info.fingerprints)}")
