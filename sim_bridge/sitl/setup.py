"""What a configuration says about simulators: their addresses and where each one's clients are; checked."""

from __future__ import annotations

from dataclasses import dataclass

from agent.config.endpoints import SPELLINGS, Endpoint, LinkKind, parse_endpoint
from agent.config.tables import FleetConfig
from agent.errors import ConfigError, EndpointError
from sim_bridge.sitl.sitl_table import sitl_table

WHERE = "[sitl]"
ARDUPILOT_TCP, ARDUPILOT_STEP = 5760, 10
"""Serial port 0 of ArduPilot's SITL listens here; each further instance ten ports higher."""
PX4_UDP = 14540
"""PX4's SITL sends to this port, each further instance to the next one."""
LOCAL_HOST = "127.0.0.1"


@dataclass(frozen=True, slots=True)
class VehicleLinks:
    """The links of one agent's autopilot.

    ``simulator`` as the bridge opens it, ``daemon`` as the agent's daemon opens it, ``client_port`` where MAVSDK and
    ground stations reach the autopilot on this host, ``gcs`` one that is sent to unasked.
    """

    agent_id: int
    simulator: Endpoint
    daemon: Endpoint
    client_port: int
    gcs: Endpoint | None = None

    @property
    def name(self) -> str:
        """For messages."""
        return f"drone {self.agent_id}: simulator at {self.simulator}"


def vehicle_links(config: FleetConfig) -> dict[int, VehicleLinks]:
    """All links by agent; raises `ConfigError` for addresses that are missing, double or of the wrong kind."""
    _check_height(config)
    links = {agent_id: _links(config, agent_id, number) for number, agent_id in enumerate(config.ids)}
    taken: dict[str, str] = {}
    for link in links.values():
        for what, address in (
            (f"simulator of drone {link.agent_id}", f"{link.simulator.host}:{link.simulator.port}"),
            (f"daemon of drone {link.agent_id}", f"{link.daemon.host}:{link.daemon.port}"),
            (f"clients of drone {link.agent_id}", f"{LOCAL_HOST}:{link.client_port}"),
        ):
            if address in taken:
                raise ConfigError(WHERE, what, "an address of its own", f"{address}, that of the {taken[address]}")
            taken[address] = what
    return links


def _check_height(config: FleetConfig) -> None:
    """The simulators give heights above mean sea level only."""
    if config.fleet.origin.altitude == "ellipsoid" and config.sensors.geoid_separation_m is None:
        expected = "a geoid separation, since the origin's height is ellipsoidal and the simulators' truth is not"
        raise ConfigError(WHERE, "sensors.geoid_separation_m", expected, "none")


def _links(config: FleetConfig, agent_id: int, number: int) -> VehicleLinks:
    vehicle = next((vehicle for vehicle in sitl_table(config).vehicles if vehicle.agent == agent_id), None)
    if vehicle is None:
        simulator, gcs = _default_simulator(config, agent_id, number), None
    else:
        simulator = _parsed(vehicle.simulator, f"simulator of agent {agent_id}")
        gcs = None if vehicle.gcs is None else _parsed(vehicle.gcs, f"gcs of agent {agent_id}")
        if gcs is not None and gcs.kind is not LinkKind.UDP_IN:
            raise ConfigError(WHERE, f"gcs of agent {agent_id}", "udpin:HOST:PORT, a station that listens", str(gcs))
    daemon = _parsed(config.agent(agent_id).mavlink, f"mavlink of agent {agent_id}")
    if daemon.kind not in (LinkKind.UDP_IN, LinkKind.UDP_OUT):
        expected = "udpin:HOST:PORT or udpout:HOST:PORT for the daemon (a simulator's address goes to sitl.vehicles)"
        raise ConfigError(WHERE, f"mavlink of agent {agent_id}", expected, str(daemon))
    return VehicleLinks(agent_id, simulator, daemon, sitl_table(config).client_port + number, gcs)


def _default_simulator(config: FleetConfig, agent_id: int, number: int) -> Endpoint:
    match config.agent(agent_id).autopilot:
        case "ardupilot":
            return Endpoint(LinkKind.TCP_OUT, LOCAL_HOST, ARDUPILOT_TCP + ARDUPILOT_STEP * number)
        case "px4":
            return Endpoint(LinkKind.UDP_IN, LOCAL_HOST, PX4_UDP + number)
    expected = "an entry in sitl.vehicles, or agents.autopilot px4 or ardupilot for its default port"
    raise ConfigError(WHERE, f"simulator of agent {agent_id}", expected, "autopilot auto and no entry")


def _parsed(text: str, key: str) -> Endpoint:
    try:
        return parse_endpoint(text)
    except EndpointError as error:
        raise ConfigError(WHERE, key, SPELLINGS, str(error)) from error
