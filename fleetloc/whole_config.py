"""A fleet's configuration with the tables of all rooms in it, checked and with their defaults filled in."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from agent.config.documents import Document, Override
from agent.config.reading import OtherTable, load_config, read, with_other_table
from agent.config.tables import FleetConfig
from agent.errors import ConfigError
from fleetloc.monitor.monitor_table import MONITOR
from sim_bridge.sitl.sitl_table import SITL
from sim_bridge.world.sim_table import SIM

OTHER_TABLES: dict[str, OtherTable[Any]] = {table.name: table for table in (SIM, SITL, MONITOR)}


def load_whole(
    path: str | Path, overrides: Iterable[Override] = (), profiles: Iterable[str | Path] = ()
) -> FleetConfig:
    """`agent.config.reading.load_config` for those who stand for all rooms; a mistake in any table is refused.

    Raises `ConfigError`.
    """
    return whole(load_config(path, overrides, profiles))


def whole(config: FleetConfig) -> FleetConfig:
    """A configuration with the tables that others than the agent read checked and filled in; raises `ConfigError`."""
    for name, table in OTHER_TABLES.items():
        config = with_other_table(config, name, table.of(config))
    return config


def read_whole(document: Document) -> tuple[FleetConfig | None, list[ConfigError]]:
    """The same of a document, as far as it can be read, and everything that is wrong in any table."""
    config, errors = read(document)
    for table in OTHER_TABLES.values():
        errors += table.read(document, config)[1]
    return (config, errors) if errors or config is None else (whole(config), [])
