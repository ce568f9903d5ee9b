"""The observers that a configuration and the environment ask for."""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Mapping
from pathlib import Path

from agent.config.endpoints import Endpoint, LinkKind, parse_endpoint
from agent.config.faults import Fault
from agent.config.tables import FleetConfig
from agent.mavlink.adsb import AdsbReporter
from agent.mavlink.signing import LinkSigning
from agent.radio.security import is_field, key_folder
from agent.watch.health_socket import HealthSocket
from agent.watch.observers import Observer
from agent.watch.systemd import ServiceManager

ADSB_LINK_ID = 1
"""Of signatures; 0 is the autopilot's link, whose stamps would get in their way."""


def observers_of(
    config: FleetConfig, agent_id: int, base: Path, environment: Mapping[str, str] = os.environ
) -> list[Observer]:
    """Who is told what a daemon does; raises `ConfigError`, `KeyFileError`.

    ``base`` is the folder of the configuration file. The service manager comes last: it hears "ready" when all else
    is open.
    """
    observers: list[Observer] = []
    if config.health.socket is not None:
        observers.append(HealthSocket(Path(config.health.socket)))
    if config.metrics.base_port is not None:
        from agent.watch.metrics import Metrics  # a server of HTTP that few daemons need

        observers.append(Metrics(config, agent_id))
    if config.adsb.address is not None:
        observers.append(AdsbReporter(config, agent_id, _adsb_signing(config, agent_id, base)))
    manager = ServiceManager.of(environment)
    if manager is not None:
        observers.append(manager)
    return observers


def _adsb_signing(config: FleetConfig, agent_id: int, base: Path) -> LinkSigning | None:
    """As the profile demands of every MAVLink link that leaves the machine."""
    from transport.security.shared_keys import load_mavlink_key  # with its library: few fleets sign

    endpoint = parse_endpoint(config.adsb.address or "")
    wanted, promised = config.mavlink.signing, is_field(config)
    if endpoint.kind is LinkKind.SERIAL:
        promised = False
    if wanted == "off" and promised and not _on_loopback(endpoint):
        expected = f'"auto" or "on" for adsb.address in profile {config.security.profile}'
        raise config.others.document.error(Fault("mavlink.signing", expected, '"off"'))
    if wanted == "on" or (wanted == "auto" and promised):
        return LinkSigning(load_mavlink_key(key_folder(config, base), agent_id), unix_s=0.0, link_id=ADSB_LINK_ID)
    return None


def _on_loopback(endpoint: Endpoint) -> bool:
    try:
        return ipaddress.ip_address(endpoint.host).is_loopback
    except ValueError:
        return endpoint.host == "localhost"
