"""What a configuration says about simulators: their addresses and where each one's clients are; checked."""

from __future__ import annotations

from dataclasses import dataclass

from agent.config.endpoints import SPELLINGS, Endpoint, LinkKind, parse_endpoint
from agent.config.faults import Fault
from agent.config.tables import FleetConfig
from agent.errors import ConfigError, EndpointError
from sim_bridge.faults.fault_tables import RangeFault
from sim_bridge.sitl.sitl_table import sitl_table
from sim_bridge.world.sim_table import sim_table

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
    _check_faults(config)
    links = {agent_id: _links(config, agent_id, number) for number, agent_id in enumerate(config.ids)}
    taken: dict[str, str] = {}
    for index, link in enumerate(links.values()):
        for key, what, address in (
            (_simulator_key(config, link.agent_id), "simulator", f"{link.simulator.host}:{link.simulator.port}"),
            (f"agents[{index}].mavlink", "daemon", f"{link.daemon.host}:{link.daemon.port}"),
            ("sitl.client_port", "clients", f"{LOCAL_HOST}:{link.client_port}"),
        ):
            who = f"{what} of drone {link.agent_id}"
            if address in taken:
                expected = f"an address of its own for the {who}"
                raise _error(config, key, expected, f"{address}, that of the {taken[address]}")
            taken[address] = who
    return links


def _error(config: FleetConfig, key: str, expected: str, found: str) -> ConfigError:
    return config.others.document.error(Fault(key, expected, found))


def _simulator_key(config: FleetConfig, agent_id: int) -> str:
    agents = [vehicle.agent for vehicle in sitl_table(config).vehicles]
    return f"sitl.vehicles[{agents.index(agent_id)}].simulator" if agent_id in agents else "sitl.vehicles"


def _check_height(config: FleetConfig) -> None:
    """The simulators give heights above mean sea level only."""
    if config.fleet.origin.altitude == "ellipsoid" and config.sensors.geoid_separation_m is None:
        expected = "a geoid separation, since the origin's height is ellipsoidal and the simulators' truth is not"
        raise _error(config, "sensors.geoid_separation_m", expected, "none")


def _check_faults(config: FleetConfig) -> None:
    """Only the ranges are simulated here; the other sensors are the simulators' own."""
    for index, fault in enumerate(sim_table(config).faults):
        if not isinstance(fault, RangeFault):
            expected = "uwb_wrong, uwb_stuck, uwb_swapped with real firmware (fixes: sim.gps_outages)"
            raise _error(config, f"sim.faults[{index}].kind", expected, f'"{fault.__struct_config__.tag}"')


def _links(config: FleetConfig, agent_id: int, number: int) -> VehicleLinks:
    vehicle = next((vehicle for vehicle in sitl_table(config).vehicles if vehicle.agent == agent_id), None)
    if vehicle is None:
        simulator, gcs = _default_simulator(config, agent_id, number), None
    else:
        key = _simulator_key(config, agent_id)
        simulator = _parsed(config, vehicle.simulator, key)
        key = key.replace(".simulator", ".gcs")
        gcs = None if vehicle.gcs is None else _parsed(config, vehicle.gcs, key)
        if gcs is not None and gcs.kind is not LinkKind.UDP_IN:
            raise _error(config, key, "udpin:HOST:PORT, a station that listens", str(gcs))
    key = f"agents[{number}].mavlink"
    daemon = _parsed(config, config.agent(agent_id).mavlink, key)
    if daemon.kind not in (LinkKind.UDP_IN, LinkKind.UDP_OUT):
        expected = "udpin:HOST:PORT or udpout:HOST:PORT for the daemon (a simulator's address goes to sitl.vehicles)"
        raise _error(config, key, expected, str(daemon))
    return VehicleLinks(agent_id, simulator, daemon, sitl_table(config).client_port + number, gcs)


def _default_simulator(config: FleetConfig, agent_id: int, number: int) -> Endpoint:
    match config.agent(agent_id).autopilot:
        case "ardupilot":
            return Endpoint(LinkKind.TCP_OUT, LOCAL_HOST, ARDUPILOT_TCP + ARDUPILOT_STEP * number)
        case "px4":
            return Endpoint(LinkKind.UDP_IN, LOCAL_HOST, PX4_UDP + number)
    expected = f"an entry for agent {agent_id}, or its autopilot px4 or ardupilot for the default port"
    raise _error(config, "sitl.vehicles", expected, "autopilot auto and no entry")


def _parsed(config: FleetConfig, text: str, key: str) -> Endpoint:
    try:
        return parse_endpoint(text)
    except EndpointError as error:
        raise _error(config, key, SPELLINGS, str(error)) from error
