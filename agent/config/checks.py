"""What has to hold between the settings of a fleet, and what its addresses have to look like."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

from agent.config.endpoints import SPELLINGS, LinkKind, parse_endpoint
from agent.config.faults import Fault
from agent.config.tables import AgentTable, FleetConfig
from agent.errors import EndpointError
from agent.feedback.feedback_table import FEEDBACK_FITS
from estimators.settings import EstimatorSettings
from transport.link.addresses import MAX_PORT, endpoint_fault, is_host
from transport.messages.measurement_body import MAX_POSITION_M

IMU_FRAME_BYTES, ATTITUDE_FRAME_BYTES, GPS_FRAME_BYTES = 75, 44, 63
FEED_FRAME_BYTES = 245
OTHER_BYTES_PER_S = 500
"""Heartbeats, TIMESYNC and the like, with room for what the autopilot sends by itself."""
BAUD_SHARE, BITS_PER_BYTE = 0.7, 10
CENTRALISED = "centralized_ekf"
LONGEST_FEED_PERIOD_S = 0.15
"""PX4 begins with gaps below 0.2 s between messages only; ticks are late at times."""


def faults_between(config: FleetConfig) -> Iterator[Fault]:
    """Everything that does not go together, or is no address, in settings that are right one by one."""
    yield from _estimator(config)
    yield from _agents(config)
    yield from _targets(config)
    yield from _edges(config)
    yield from _anchors(config)
    yield from _uwb_pairs(config)
    yield from _times(config)
    yield from _radio(config)
    yield from _services(config)
    yield from _feedback(config)


def unknown_ids(config: FleetConfig, key: str, ids: Iterable[int]) -> Iterator[Fault]:
    """A fault for each id that no agent has."""
    for agent_id in ids:
        if agent_id not in config.ids:
            yield Fault(key, f"ids of agents ({', '.join(map(str, config.ids))})", str(agent_id))


def _estimator(config: FleetConfig) -> Iterator[Fault]:
    """Each agent estimates by itself."""
    kind = config.estimator.kind
    if kind == CENTRALISED:
        expected = "a kind for agents; this one sees everything at once: `fleetloc estimate` and `bench` have it"
        yield Fault("estimator.kind", expected, f'"{kind}"')
    yield from _limits(config.estimator)


def _limits(settings: EstimatorSettings) -> Iterator[Fault]:
    """What is between two limits must not be empty."""
    vehicle, key = settings.limits.vehicle, "estimator.limits.vehicle"
    for name in ("floor_m", "ceiling_m"):
        value = getattr(vehicle, name)
        if value is not None and not math.isfinite(value):
            yield Fault(f"{key}.{name}", "a finite altitude", f"{value:g}")
    if vehicle.floor_m is not None and vehicle.ceiling_m is not None and not vehicle.floor_m < vehicle.ceiling_m:
        yield Fault(f"{key}.ceiling_m", f"above floor_m = {vehicle.floor_m:g}", f"{vehicle.ceiling_m:g}")
    for name, sides in (("north_m", vehicle.north_m), ("east_m", vehicle.east_m)):
        if sides is not None and not (-math.inf < sides[0] < sides[1] < math.inf):
            yield Fault(f"{key}.{name}", "[lowest, highest], finite, the first below the second", f"{list(sides)}")
        elif sides is not None and settings.state_box_position_m is not None:
            box = settings.state_box_position_m
            if sides[0] >= box or sides[1] <= -box:
                expected = f"a part of +-{box:g}, which estimator.state_box_position_m leaves"
                yield Fault(f"{key}.{name}", expected, f"{list(sides)}")


def _targets(config: FleetConfig) -> Iterator[Fault]:
    """A target is nobody else, and has room in the joint state."""
    for index, target in enumerate(config.targets):
        if target.id in config.bodies[: len(config.ids) + index] or target.id in config.places_m:
            yield Fault(f"targets[{index}].id", "an id that no other body has", str(target.id))
    if config.targets and len(config.ids) > config.fleet.joint_bodies:
        expected = f"none where the agents are more than fleet.joint_bodies = {config.fleet.joint_bodies}"
        yield Fault("targets", expected, str(len(config.targets)))
    limits, key = config.estimator.limits.target, "estimator.limits.target"
    for name in ("floor_m", "ceiling_m"):
        value = getattr(limits, name)
        if value is not None and not math.isfinite(value):
            yield Fault(f"{key}.{name}", "a finite altitude", f"{value:g}")
    if limits.floor_m is not None and limits.ceiling_m is not None and not limits.floor_m < limits.ceiling_m:
        yield Fault(f"{key}.ceiling_m", f"above floor_m = {limits.floor_m:g}", f"{limits.ceiling_m:g}")


def _agents(config: FleetConfig) -> Iterator[Fault]:
    seen: dict[str, int] = {}
    for index, agent in enumerate(config.agents):
        if agent.id in config.ids[:index]:
            yield Fault(f"agents[{index}].id", "distinct ids", f"a second agent {agent.id}")
        if agent.id > 255 and agent.system_id is None:
            expected = f"1..255, since the id {agent.id} is no system id"
            yield Fault(f"agents[{index}].system_id", expected, "nothing")
        key = f"agents[{index}].mavlink"
        try:
            endpoint = parse_endpoint(agent.mavlink)
        except EndpointError as error:
            yield Fault(key, SPELLINGS, str(error))
            continue
        opened = f"{endpoint.host}:{endpoint.port}" if endpoint.kind is not LinkKind.SERIAL else endpoint.host
        opened = f"{agent.radio or ''} {opened}"  # an address of its own on the radio is a computer of its own
        if opened in seen and not opened.endswith(":0"):
            yield Fault(key, f"another address than agent {seen[opened]}'s", repr(agent.mavlink))
        seen[opened] = agent.id
        if endpoint.kind is LinkKind.SERIAL:
            yield from _baud(config, key, agent, endpoint.port)


def _baud(config: FleetConfig, key: str, agent: AgentTable, baud: int) -> Iterator[Fault]:
    """A serial line that the requested streams would fill: frames would be lost without a word."""
    settings, address = config.mavlink, agent.mavlink
    needed = (
        settings.imu_hz * IMU_FRAME_BYTES
        + settings.attitude_hz * ATTITUDE_FRAME_BYTES
        + settings.gps_hz * GPS_FRAME_BYTES
        + OTHER_BYTES_PER_S
    )
    fed = FEED_FRAME_BYTES / config.fleet.period_s if config.feeds(agent.id) else 0.0  # the other way, by itself
    usable = BAUD_SHARE * baud / BITS_PER_BYTE
    if fed > usable:
        yield Fault(key, f"a baud rate of {fed * BITS_PER_BYTE / BAUD_SHARE:.0f} or more for the feed", repr(address))
    if needed > usable:
        expected = f"a baud rate of {needed * BITS_PER_BYTE / BAUD_SHARE:.0f} or more for the rates in [mavlink]"
        given = str(baud) in address
        found = repr(address) if given else f"{address!r}, which is {baud} baud as it says none"
        yield Fault(key, expected, found)


def _anchors(config: FleetConfig) -> Iterator[Fault]:
    taken = set(config.ids)
    for index, anchor in enumerate(config.anchors):
        key = f"anchors[{index}]"
        if anchor.id in taken:
            yield Fault(f"{key}.id", "an id that no drone and no other anchor has", str(anchor.id))
        taken.add(anchor.id)
        if not all(abs(component) <= MAX_POSITION_M for component in anchor.position_m):
            yield Fault(f"{key}.position_m", f"finite, at most {MAX_POSITION_M:g} m", str(list(anchor.position_m)))


def _uwb_pairs(config: FleetConfig) -> Iterator[Fault]:
    seen: set[frozenset[tuple[int, int | None]]] = set()
    for index, each in enumerate(config.sensors.uwb_pairs):
        key, pair = f"sensors.uwb_pairs[{index}].pair", frozenset(each.pair)
        yield from unknown_ids(config, key, set(each.pair) - config.places_m.keys())
        if len(pair) < 2:
            yield Fault(key, "two different agents", f"{list(each.pair)}")
        ends = frozenset(zip(each.pair, each.tags or (None, None), strict=True))
        if ends in seen:
            found = f"a second entry of {sorted(pair)}"
            found += "" if each.tags is None else f" with tags {list(each.tags)}"
            yield Fault(key, "each pair once, or once for each two tags", found)
        seen.add(ends)


def _edges(config: FleetConfig) -> Iterator[Fault]:
    for index, edge in enumerate(config.fleet.edges or ()):
        yield from unknown_ids(config, f"fleet.edges[{index}]", edge)
        if edge[0] == edge[1]:
            yield Fault(f"fleet.edges[{index}]", "two different agents", f"{list(edge)}")


def _radio(config: FleetConfig) -> Iterator[Fault]:
    """Datagrams between machines need addresses; the endpoints on loopback need free ports."""
    transport = config.transport
    for index, agent in enumerate(config.agents):
        yield from _endpoints(agent, f"agents[{index}]")
        if transport.link != "tcp" and agent.radio is None and (agent.listen or agent.connect):
            expected = f"an address, since transport.link is {transport.link} and listen or connect is given"
            yield Fault(f"agents[{index}].radio", expected, "nothing")
    for index, outage in enumerate(transport.faults.outages):
        key = f"transport.faults.outages[{index}]"
        yield from unknown_ids(config, f"{key}.receivers", outage.receivers)
        yield from unknown_ids(config, f"{key}.senders", outage.senders)
        if outage.to_s <= outage.from_s:
            yield Fault(f"{key}.to_s", f"later than from_s = {outage.from_s:g}", f"{outage.to_s:g}")


def _endpoints(agent: AgentTable, key: str) -> Iterator[Fault]:
    for lowest, (name, endpoints) in enumerate((("listen", agent.listen), ("connect", agent.connect))):
        for number, endpoint in enumerate(endpoints or ()):
            fault = endpoint_fault(endpoint, lowest=lowest)
            if fault is not None:
                yield Fault(f"{key}.{name}[{number}]", fault, repr(endpoint))
    if agent.radio is not None and endpoint_fault(f"tcp/{agent.radio}:1") is not None:
        expected = "an address on the radio, or a name, without port (IPv6 in brackets)"
        yield Fault(f"{key}.radio", expected, repr(agent.radio))


def _services(config: FleetConfig) -> Iterator[Fault]:
    """What answers those who look after the fleet."""
    metrics, adsb = config.metrics, config.adsb
    if metrics.base_port is not None and metrics.base_port + len(config.agents) - 1 > MAX_PORT:
        found = f"{metrics.base_port + len(config.agents) - 1} for the last"
        yield Fault("metrics.base_port", f"a port for each agent up to {MAX_PORT}", found)
    if not is_host(metrics.host):
        yield Fault("metrics.host", "an address to listen on", repr(metrics.host))
    if adsb.address is not None:
        try:
            parse_endpoint(adsb.address)
        except EndpointError as error:
            yield Fault("adsb.address", SPELLINGS, str(error))


def _feedback(config: FleetConfig) -> Iterator[Fault]:
    """What autopilots are given has to come often enough, and be something that they read."""
    table = config.feedback
    yield from unknown_ids(config, "feedback.agents", table.agents or ())
    if table.kind == "off":
        return
    if config.fleet.period_s > LONGEST_FEED_PERIOD_S:
        expected = f"at most {LONGEST_FEED_PERIOD_S:g} with [feedback], as PX4 takes no slower feed"
        yield Fault("fleet.period_s", expected, f"{config.fleet.period_s:g}")
    for index, agent in enumerate(config.agents):
        fits = FEEDBACK_FITS[table.kind]
        if config.feeds(agent.id) and agent.autopilot not in ("auto", *fits):
            expected = f'{" or ".join(fits)}, which read feedback.kind = "{table.kind}", or another feedback.agents'
            yield Fault(f"agents[{index}].autopilot", expected, f'"{agent.autopilot}"')


def _times(config: FleetConfig) -> Iterator[Fault]:
    transport = config.transport
    used = transport.exchange_fraction + transport.rounds_fraction
    if used > 1.0:
        yield Fault("transport.rounds_fraction", "at most 1 together with transport.exchange_fraction", f"{used:g}")
    if transport.guard_s >= transport.exchange_fraction * config.fleet.period_s:
        expected = "less than transport.exchange_fraction of fleet.period_s"
        yield Fault("transport.guard_s", expected, f"{transport.guard_s:g}")
    last = transport.base_port + (1 if transport.link == "tcp" else 2) * len(config.agents) - 1
    if last > MAX_PORT:
        yield Fault("transport.base_port", f"a port for each agent up to {MAX_PORT}", f"{last} for the last")
