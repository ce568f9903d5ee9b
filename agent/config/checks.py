"""What has to hold between the settings of a fleet, and what its addresses have to look like."""

from __future__ import annotations

from collections.abc import Iterable

from agent.config.endpoints import SPELLINGS, LinkKind, parse_endpoint
from agent.config.tables import AgentTable, FleetConfig
from agent.errors import ConfigError, EndpointError
from transport.link.addresses import MAX_PORT, endpoint_fault, is_host

IMU_FRAME_BYTES, ATTITUDE_FRAME_BYTES, GPS_FRAME_BYTES = 75, 44, 63
OTHER_BYTES_PER_S = 500
"""Heartbeats, TIMESYNC and the like, with room for what the autopilot sends by itself."""
BAUD_SHARE, BITS_PER_BYTE = 0.7, 10
CENTRALISED = "centralized_ekf"


def check_fleet(config: FleetConfig, where: str) -> None:
    """Raises `ConfigError` for the first thing that is wrong; ``where`` names the configuration."""
    _check_estimator(config, where)
    _check_agents(config, where)
    _check_references(config, where)
    _check_times(config, where)
    _check_radio(config, where)
    _check_services(config, where)


def _check_estimator(config: FleetConfig, where: str) -> None:
    """Each agent estimates by itself."""
    kind = config.estimator.kind
    if kind == CENTRALISED:
        expected = "a kind for agents; this one sees everything at once: `fleetloc estimate` and `bench` have it"
        raise ConfigError(where, "estimator.kind", expected, f'"{kind}"')


def _check_agents(config: FleetConfig, where: str) -> None:
    seen: dict[str, int] = {}
    for index, agent in enumerate(config.agents):
        if agent.id in config.ids[:index]:
            raise ConfigError(where, f"agents[{index}].id", "distinct ids", f"a second agent {agent.id}")
        key = f"agents[{index}].mavlink"
        try:
            endpoint = parse_endpoint(agent.mavlink)
        except EndpointError as error:
            raise ConfigError(where, key, SPELLINGS, str(error)) from error
        opened = f"{endpoint.host}:{endpoint.port}" if endpoint.kind is not LinkKind.SERIAL else endpoint.host
        opened = f"{agent.radio or ''} {opened}"  # an address of its own on the radio is a computer of its own
        if opened in seen and not opened.endswith(":0"):
            raise ConfigError(where, key, f"another address than agent {seen[opened]}'s", repr(agent.mavlink))
        seen[opened] = agent.id
        if endpoint.kind is LinkKind.SERIAL:
            _check_baud(config, where, key, endpoint.port)
        if agent.id > 255 and agent.system_id is None:
            expected = f"1..255, since the id {agent.id} is no system id"
            raise ConfigError(where, f"agents[{index}].system_id", expected, "nothing")


def _check_baud(config: FleetConfig, where: str, key: str, baud: int) -> None:
    """Refuse a serial line that the requested streams would fill: frames would be lost without a word."""
    settings = config.mavlink
    needed = (
        settings.imu_hz * IMU_FRAME_BYTES
        + settings.attitude_hz * ATTITUDE_FRAME_BYTES
        + settings.gps_hz * GPS_FRAME_BYTES
        + OTHER_BYTES_PER_S
    )
    usable = BAUD_SHARE * baud / BITS_PER_BYTE
    if needed > usable:
        expected = f"a baud rate of {needed * BITS_PER_BYTE / BAUD_SHARE:.0f} or more for the rates in [mavlink]"
        raise ConfigError(where, key, expected, str(baud))


def _check_references(config: FleetConfig, where: str) -> None:
    for index, edge in enumerate(config.fleet.edges or ()):
        _known(config, where, f"fleet.edges[{index}]", edge)
        if edge[0] == edge[1]:
            raise ConfigError(where, f"fleet.edges[{index}]", "two different agents", f"{list(edge)}")


def _check_radio(config: FleetConfig, where: str) -> None:
    """Datagrams between machines need addresses; the endpoints on loopback need free ports."""
    transport = config.transport
    for index, agent in enumerate(config.agents):
        _check_endpoints(agent, where, f"agents[{index}]")
        if transport.link != "tcp" and agent.radio is None and (agent.listen or agent.connect):
            expected = f"an address, since transport.link is {transport.link} and listen or connect is given"
            raise ConfigError(where, f"agents[{index}].radio", expected, "nothing")
    for index, outage in enumerate(transport.faults.outages):
        key = f"transport.faults.outages[{index}]"
        _known(config, where, f"{key}.receivers", outage.receivers)
        _known(config, where, f"{key}.senders", outage.senders)
        if outage.to_s <= outage.from_s:
            raise ConfigError(where, f"{key}.to_s", f"later than from_s = {outage.from_s}", str(outage.to_s))


def _check_endpoints(agent: AgentTable, where: str, key: str) -> None:
    for lowest, (name, endpoints) in enumerate((("listen", agent.listen), ("connect", agent.connect))):
        for number, endpoint in enumerate(endpoints or ()):
            fault = endpoint_fault(endpoint, lowest=lowest)
            if fault is not None:
                raise ConfigError(where, f"{key}.{name}[{number}]", fault, repr(endpoint))
    if agent.radio is not None and endpoint_fault(f"tcp/{agent.radio}:1") is not None:
        expected = "an address on the radio, or a name, without port (IPv6 in brackets)"
        raise ConfigError(where, f"{key}.radio", expected, repr(agent.radio))


def _check_services(config: FleetConfig, where: str) -> None:
    """What answers those who look after the fleet."""
    metrics, adsb = config.metrics, config.adsb
    if metrics.base_port is not None and metrics.base_port + len(config.agents) - 1 > MAX_PORT:
        found = f"{metrics.base_port + len(config.agents) - 1} for the last"
        raise ConfigError(where, "metrics.base_port", f"a port for each agent up to {MAX_PORT}", found)
    if not is_host(metrics.host):
        raise ConfigError(where, "metrics.host", "an address to listen on", repr(metrics.host))
    if adsb.address is not None:
        try:
            parse_endpoint(adsb.address)
        except EndpointError as error:
            raise ConfigError(where, "adsb.address", SPELLINGS, str(error)) from error


def _known(config: FleetConfig, where: str, key: str, ids: Iterable[int]) -> None:
    for agent_id in ids:
        if agent_id not in config.ids:
            raise ConfigError(where, key, f"ids of agents ({', '.join(map(str, config.ids))})", str(agent_id))


def _check_times(config: FleetConfig, where: str) -> None:
    transport = config.transport
    used = transport.exchange_fraction + transport.rounds_fraction
    if used > 1.0:
        expected = "at most 1 together with transport.exchange_fraction"
        raise ConfigError(where, "transport.rounds_fraction", expected, f"{used:g}")
    if transport.guard_s >= transport.exchange_fraction * config.fleet.period_s:
        expected = "less than transport.exchange_fraction of fleet.period_s"
        raise ConfigError(where, "transport.guard_s", expected, f"{transport.guard_s:g}")
    last = transport.base_port + (1 if transport.link == "tcp" else 2) * len(config.agents) - 1
    if last > MAX_PORT:
        found = f"{last} for the last"
        raise ConfigError(where, "transport.base_port", f"a port for each agent up to {MAX_PORT}", found)
