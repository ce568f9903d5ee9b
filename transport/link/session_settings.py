"""Settings of the Zenoh session, and the Zenoh configuration made of them.

Peers with explicit endpoints, no scouting, no gossip; of two neighbours the one with the higher id dials.
Peers do not relay, so who is connected is who is a neighbour.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Annotated, Any

import msgspec
import zenoh

from transport.errors import SettingsError
from transport.link.addresses import ALL_LINKS, SECURE_LINKS, endpoint_fault
from transport.link.streams import (
    PREFIX,
    Stream,
    agent_name,
    check_agent_id,
    check_fleet_name,
    key_expression,
    observer_name,
)
from transport.messages.header import MAX_PACKET_BYTES
from transport.security.uwb_seal import UwbSeal

STRANGERS = 60
"""Sessions beside those of members: monitors, UWB drivers, and whoever else comes where links are open. Zenoh keeps
no slot for anybody; where strangers have taken all, a new session shakes them off (`agent.radio.session_watch`)."""
Milliseconds = Annotated[int, msgspec.Meta(ge=1, le=600_000)]
Count = Annotated[int, msgspec.Meta(ge=1)]



class TlsSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Mutual TLS: PEM files; the certificate's common name is ``{fleet}.agent.{id:03d}``."""

    ca: str
    """Certificate of the fleet's authority."""

    certificate: str
    """This drone's certificate."""

    private_key: str
    """Its private key."""


class SessionSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How one agent is connected.

    Raises `SettingsError` for endpoints that Zenoh would not understand, and for plain links beside TLS.
    """

    listen: tuple[str, ...] = ()
    """Endpoints such as ``tcp/192.168.7.3:7447``; for lossy radios ``udp/...``, or both at once, ``tcp/...?rel=1``
    and ``udp/...?rel=0``, so that round packets take the datagrams and declarations the stream. QUIC collapses under
    loss with delay; over a multicast group peers may answer each other's declarations without end (docs/links.md).
    """

    connect: tuple[str, ...] = ()
    """Endpoints of the neighbours to dial (those with lower ids)."""

    tls: TlsSettings | None = None
    """With it, only ``tls/`` and ``quic/`` endpoints are allowed, and members put on their own keys only."""

    lease_ms: Milliseconds = 2000
    """Silence after which neighbours consider this agent gone."""

    open_timeout_ms: Milliseconds = 1500
    """Longest time a link may take to be opened."""

    retry_initial_ms: Milliseconds = 200
    """First pause before an unreachable neighbour is dialled again; doubles up to ``retry_max_ms``."""

    retry_max_ms: Milliseconds = 2000
    """Longest such pause."""

    scouting_delay_ms: Milliseconds = 50
    """Longest time that opening the session waits for its links."""

    inbox_packets: Count = 4096
    """Packets received but not yet looked at; what comes beyond is shed and counted."""

    uwb_seal: UwbSeal | None = None
    """Of a UWB driver: closes what is put on the ``uwb`` stream; absent = frames go as they are."""

    def __post_init__(self) -> None:
        allowed = SECURE_LINKS if self.tls else ALL_LINKS
        for lowest, endpoints in enumerate((self.listen, self.connect)):
            for endpoint in endpoints:
                fault = endpoint_fault(endpoint, allowed, lowest=lowest)
                if fault is not None:
                    raise SettingsError(f"endpoint {endpoint!r}: expected {fault}")
                link = endpoint.partition("/")[0]
                if link in SECURE_LINKS and self.tls is None:
                    raise SettingsError(f"endpoint {endpoint!r}: a {link} link needs the tls settings")

    @property
    def multilink(self) -> bool:
        """Whether endpoints name a reliability, so that a neighbour has a stream and a datagram link."""
        return any("rel=" in endpoint for endpoint in (*self.listen, *self.connect))


def zenoh_config(
    settings: SessionSettings, fleet: str, agent_id: int | None, members: Iterable[int]
) -> zenoh.Config:
    """The Zenoh configuration of an agent (or observer, without id) of a fleet with these members.

    Raises `SettingsError` where Zenoh refuses it.
    """
    members = tuple(members)
    table = _table(settings, check_fleet_name(fleet), len(members) + STRANGERS)
    if settings.tls is not None:
        table["transport"]["link"]["protocols"] = list(SECURE_LINKS)
        table["transport"]["link"]["tls"] = _tls_table(settings.tls)
        table["access_control"] = access_control(fleet, agent_id, members)
    try:
        return zenoh.Config.from_json5(json.dumps(table))
    except zenoh.ZError as error:
        raise SettingsError(f"transport settings refused by Zenoh: {error}") from None


def _table(settings: SessionSettings, fleet: str, sessions: int) -> dict[str, Any]:
    s, largest = settings, 2 * MAX_PACKET_BYTES
    pauses = {"period_init_ms": s.retry_initial_ms, "period_max_ms": s.retry_max_ms}
    retry = {**pauses, "period_increase_factor": 2}
    return {
        "mode": "peer",
        "listen": {"endpoints": list(s.listen), "exit_on_failure": True},
        # timeout -1 and no exit: neighbours may come up later, and are dialled for ever
        "connect": {"endpoints": list(s.connect), "timeout_ms": -1, "exit_on_failure": False, "retry": retry},
        "scouting": {
            "delay": s.scouting_delay_ms,
            "multicast": {"enabled": False},
            "gossip": {"enabled": False},
        },
        "timestamping": {"enabled": False},
        "queries_default_timeout": 1000,
        "adminspace": {"enabled": False},
        "transport": {
            "unicast": {
                "open_timeout": s.open_timeout_ms,
                "accept_timeout": s.open_timeout_ms,
                "max_sessions": sessions,
                "max_links": 2 if s.multilink else 1,
            },
            "link": {
                "tx": {"lease": s.lease_ms, "keep_alive": 4, "queue": _queue_table()},
                "rx": {"buffer_size": 65535, "max_message_size": largest},
            },
            # on one host it would bypass the links that are to be tested
            "shared_memory": {"enabled": False},
        },
        "low_pass_filter": [
            {
                "id": "size",
                "messages": ["put", "reply", "query"],
                "flows": ["ingress"],
                "key_exprs": [f"{PREFIX}/{fleet}/**"],
                "size_limit": largest,
            }
        ],
    }


def _queue_table() -> dict[str, Any]:
    sizes = dict.fromkeys(
        ("control", "real_time", "interactive_low", "data_high", "data", "data_low", "background"), 2
    )
    drop = {"wait_before_drop": 500, "max_wait_before_drop_fragments": 5000}
    return {
        "size": {**sizes, "interactive_high": 8},
        "congestion_control": {"drop": drop, "block": {"wait_before_close": 500_000}},
    }


def _tls_table(tls: TlsSettings) -> dict[str, Any]:
    return {
        "root_ca_certificate": tls.ca,
        "listen_private_key": tls.private_key,
        "listen_certificate": tls.certificate,
        "connect_private_key": tls.private_key,
        "connect_certificate": tls.certificate,
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }


def access_control(fleet: str, agent_id: int | None, members: Iterable[int]) -> dict[str, Any]:
    """Zenoh access control of one agent: each member may put on its own keys only, everything else is denied.

    A UWB driver on the drone comes with the drone's own certificate and may put on its ``uwb`` key. Who comes with
    the observer's certificate hears everything and may put nothing. Without ``agent_id`` the table is an observer's.
    """

    def keys(member: int) -> str:
        return f"{PREFIX}/{fleet}/agent/{check_agent_id(member):03d}/**"

    asks = ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"]
    tells = ["put", "liveliness_token", "declare_queryable", "reply"]
    rules = [_rule("subscribe", ["ingress", "egress"], asks, f"{PREFIX}/{fleet}/**")]
    common = ["subscribe"]
    if agent_id is not None:
        clock = key_expression(fleet, agent_id, Stream.CLOCK)
        rules.append(_rule("own_out", ["egress"], tells, keys(agent_id)))
        rules.append(_rule("clock_in", ["ingress"], ["query"], clock))
        clocks = f"{PREFIX}/{fleet}/agent/*/{Stream.CLOCK.value}"
        rules.append(_rule("clock_out", ["egress"], ["query"], clocks))
        common += ["own_out", "clock_in", "clock_out"]
    subjects, policies = [], []
    for member in sorted(set(members)):
        if member == agent_id:
            driver = key_expression(fleet, member, Stream.UWB)
            rule = _rule(f"from_{member:03d}", ["ingress"], ["put"], driver)
        else:
            rule = _rule(f"from_{member:03d}", ["ingress"], tells, keys(member))
        rules.append(rule)
        subjects.append({"id": f"member_{member:03d}", "cert_common_names": [agent_name(fleet, member)]})
        policies.append({"rules": [*common, f"from_{member:03d}"], "subjects": [f"member_{member:03d}"]})
    if agent_id is not None:
        subjects.append({"id": "observers", "cert_common_names": [observer_name(fleet)]})
        policies.append({"rules": ["subscribe", "own_out"], "subjects": ["observers"]})
    return {
        "enabled": True,  # without it Zenoh ignores the whole table silently
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rule(name: str, flows: list[str], messages: list[str], keys: str) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": flows, "messages": messages, "key_exprs": [keys]}
