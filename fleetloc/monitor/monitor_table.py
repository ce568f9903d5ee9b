"""The ``[monitor]`` table: what `fleetloc monitor` shows, and where; no daemon reads it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

import msgspec

from agent.config.faults import Fault
from agent.config.fields import NotNegative, Table
from agent.config.reading import OtherTable
from agent.config.tables import FleetConfig
from transport.link.addresses import is_host


class MonitorTable(Table, frozen=True):
    """``[monitor]``: what `fleetloc monitor` shows, and where; no daemon reads it."""

    host: str = "127.0.0.1"
    """Address of the web page; it has no password."""
    port: Annotated[int, msgspec.Meta(ge=0, le=65_535)] = 8470
    """0 = any free one."""
    track_s: NotNegative = 60.0
    """Length of the tracks on the map."""


def _faults(table: MonitorTable, _config: FleetConfig) -> Iterator[Fault]:
    if not is_host(table.host):
        yield Fault("monitor.host", "an address to listen on", repr(table.host))


MONITOR = OtherTable("monitor", MonitorTable, _faults)


def monitor_table(config: FleetConfig) -> MonitorTable:
    """The table of a fleet's configuration; raises `ConfigError`."""
    return MONITOR.of(config)
