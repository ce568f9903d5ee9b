"""A fleet's configuration with the tables of all rooms in it, checked and with their defaults filled in."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import msgspec

from agent.config.reading import load_config, with_other_table
from agent.config.tables import FleetConfig
from fleetloc.monitor.monitor_table import MonitorTable, monitor_table
from sim_bridge.sitl.sitl_table import SitlTable, sitl_table
from sim_bridge.world.sim_table import SimTable, sim_table

OTHER_TABLES: dict[str, type[msgspec.Struct]] = {"sim": SimTable, "sitl": SitlTable, "monitor": MonitorTable}
READERS: dict[str, Callable[[FleetConfig], msgspec.Struct]] = {
    "sim": sim_table,
    "sitl": sitl_table,
    "monitor": monitor_table,
}


def load_whole(path: str | Path, overrides: Iterable[str] = (), profiles: Iterable[str | Path] = ()) -> FleetConfig:
    """`agent.config.reading.load_config` for those who stand for all rooms; a mistake in any table is refused.

    Raises `ConfigError`.
    """
    return whole(load_config(path, overrides, profiles))


def whole(config: FleetConfig) -> FleetConfig:
    """A configuration with the tables that others than the agent read checked and filled in; raises `ConfigError`."""
    for name, read in READERS.items():
        config = with_other_table(config, name, read(config))
    return config
