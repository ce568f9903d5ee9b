"""The ``[sitl]`` table: a fleet of autopilots in software-in-the-loop simulators and the bridge in front of them.

Noise, rate and seed of the synthesised ranges, the duration and GPS outages are those of ``[sim]``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

import msgspec

from agent.config.checks import unknown_ids
from agent.config.faults import Fault
from agent.config.fields import AgentId, Positive, Table
from agent.config.reading import OtherTable
from agent.config.tables import FleetConfig
from sim_bridge.world.sim_table import GpsOutage
from transport.link.addresses import MAX_PORT

COMPONENT_ID = 194
"""MAVLink component id of the bridge, another one than the daemon's, and none that MAVLink gives to others."""


class SitlVehicleTable(Table, frozen=True):
    """``[[sitl.vehicles]]``: where the simulated autopilot of one agent is."""

    agent: AgentId
    """Whose autopilot."""
    simulator: str
    """Address of its MAVLink link, e.g. ``tcp:127.0.0.1:5760`` or ``udpin:127.0.0.1:14540``."""
    gcs: str | None = None
    """A ground station that listens, e.g. ``udpin:127.0.0.1:14550``; it is sent to unasked."""


class SitlTable(Table, frozen=True):
    """``[sitl]``: what `fleetloc sitl` attaches to; no agent reads it."""

    vehicles: tuple[SitlVehicleTable, ...] = ()
    """An agent that is absent has the n-th default port of its autopilot, n from 0 in order of the file:
    ArduPilot ``tcp:127.0.0.1:5760 + 10 n``, PX4 ``udpin:127.0.0.1:14540 + n``."""
    client_port: Annotated[int, msgspec.Meta(ge=1024, le=64_000)] = 14_590
    """MAVSDK and ground stations reach agent number n (from 0) at UDP 127.0.0.1, this port + n."""
    uwb_reach_m: Positive = 200.0
    """No ranges over longer distances."""
    appear_timeout_s: Positive = 60.0
    """All simulators have to show themselves within this."""
    silence_s: Positive = 5.0
    """A simulator that tells no truth for longer than this ends the run."""
    autopilot_gps: tuple[GpsOutage, ...] = ()
    """When the autopilots themselves have no GPS: their simulators take it away (SIM_GPS_USED, SIM_GPS1_ENABLE)."""
    mission: str | None = None
    """File of the mission to fly, relative to the configuration file; absent = the bridge only watches."""


def _faults(table: SitlTable, config: FleetConfig) -> Iterator[Fault]:
    seen: set[int] = set()
    for index, vehicle in enumerate(table.vehicles):
        key = f"sitl.vehicles[{index}].agent"
        yield from unknown_ids(config, key, (vehicle.agent,))
        if vehicle.agent in seen:
            yield Fault(key, "one entry per agent", f"a second one of agent {vehicle.agent}")
        seen.add(vehicle.agent)
    for index, outage in enumerate(table.autopilot_gps):
        key = f"sitl.autopilot_gps[{index}]"
        yield from unknown_ids(config, f"{key}.agent", (outage.agent,))
        if outage.to_s <= outage.from_s:
            yield Fault(f"{key}.to_s", f"later than from_s = {outage.from_s:g}", f"{outage.to_s:g}")
    last = table.client_port + len(config.ids) - 1
    if last > MAX_PORT:
        yield Fault("sitl.client_port", f"a port for each agent up to {MAX_PORT}", f"{last} for the last")
    if config.mavlink.component_id == COMPONENT_ID:
        yield Fault("mavlink.component_id", "another id than the bridge's", f"{COMPONENT_ID} for both")


SITL = OtherTable("sitl", SitlTable, _faults)


def sitl_table(config: FleetConfig) -> SitlTable:
    """The table of a fleet's configuration; raises `ConfigError`. `sim_bridge.sitl.setup` checks its addresses."""
    return SITL.of(config)
