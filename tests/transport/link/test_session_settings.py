"""Settings of the session, and what they become for Zenoh."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest

from transport.errors import SettingsError
from transport.link.session_settings import (
    STRANGERS,
    SessionSettings,
    TlsSettings,
    access_control,
    zenoh_config,
)
from transport.link.streams import Stream, key_expression, parse_key, presence_pattern

TLS = TlsSettings("ca.pem", "a.pem", "a.key")


def effective(settings: SessionSettings, path: str) -> Any:
    return json.loads(zenoh_config(settings, "f1", 1, (1, 2)).get_json(path))


def test_peers_with_explicit_endpoints_and_nothing_that_scouts() -> None:
    settings = SessionSettings(listen=("tcp/127.0.0.1:1",), connect=("tcp/127.0.0.1:2",), lease_ms=1500)
    for path, value in {
        "mode": "peer",
        "listen/endpoints": ["tcp/127.0.0.1:1"],
        "connect/endpoints": ["tcp/127.0.0.1:2"],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 50,
        "timestamping/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": 1500,
        "transport/unicast/open_timeout": 1500,
        "transport/unicast/max_links": 1,
        "transport/unicast/max_sessions": 2 + STRANGERS,
        "adminspace/enabled": False,
        "adminspace/permissions/write": False,
    }.items():
        assert effective(settings, path) == value, path


def test_two_links_to_a_neighbour_for_lossy_radios() -> None:
    settings = SessionSettings(listen=("tcp/127.0.0.1:1?rel=1", "udp/127.0.0.1:2?rel=0"))
    assert effective(settings, "transport/unicast/max_links") == 2


def test_tls_brings_mutual_authentication_and_access_control() -> None:
    settings = SessionSettings(listen=("tls/127.0.0.1:1",), tls=TLS)
    assert effective(settings, "access_control/enabled") is True
    assert effective(settings, "access_control/default_permission") == "deny"
    assert effective(settings, "transport/link/protocols") == ["tls", "quic"]
    assert effective(settings, "transport/link/tls/enable_mtls") is True
    assert effective(settings, "transport/link/tls/verify_name_on_connect") is True


def test_access_control_lets_each_member_put_on_its_own_keys_only() -> None:
    table = access_control("f1", 1, (1, 2, 3))
    rules = {rule["id"]: rule for rule in table["rules"]}
    assert rules["from_002"]["key_exprs"] == ["cl/v1/f1/agent/002/**"]
    assert rules["from_001"]["key_exprs"] == ["cl/v1/f1/agent/001/uwb"]  # our own UWB driver
    policies = {policy["subjects"][0]: policy["rules"] for policy in table["policies"]}
    assert [rule for rule in policies["member_003"] if rule.startswith("from")] == ["from_003"]
    names = {subject["id"]: subject["cert_common_names"] for subject in table["subjects"]}
    assert names["member_003"] == ["f1.agent.003"]


def test_an_observer_puts_nothing() -> None:
    table = access_control("f1", None, (1, 2))
    assert not [rule for rule in table["rules"] if "egress" in rule["flows"] and "put" in rule["messages"]]


@pytest.mark.parametrize(
    "endpoint",
    [
        *("127.0.0.1:1", "tcp/127.0.0.1", "http/127.0.0.1:80", "", "tls/127.0.0.1:1", "tcp/a b:1"),
        *("tcp/127.0.0.1:99999", "tcp/127.0.0.1:abc", "tcp/127.0.0.1:", "tcp/:7447", "tcp/..bad:7447"),
        *("tcp/::1:7447", "udp/1.2.3.256:7447"),
    ],
)
def test_endpoints_that_cannot_be_used_are_named(endpoint: str) -> None:
    with pytest.raises(SettingsError, match=f"endpoint '{endpoint}'"):
        SessionSettings(listen=(endpoint,))


def test_a_port_of_zero_is_for_those_who_listen() -> None:
    SessionSettings(listen=("tcp/[::1]:0?rel=1", "udp/drone-1.local:7447#iface=wlan0"))
    with pytest.raises(SettingsError, match=r"expected a port 1..65535"):
        SessionSettings(connect=("tcp/127.0.0.1:0",))


def test_no_plain_link_beside_tls() -> None:
    with pytest.raises(SettingsError, match="expected one of tls/HOST:PORT, quic/HOST:PORT"):
        SessionSettings(listen=("tls/127.0.0.1:1",), connect=("tcp/127.0.0.1:2",), tls=TLS)


def test_what_zenoh_refuses_is_an_error_of_the_settings() -> None:
    with pytest.raises(SettingsError, match="refused by Zenoh"):
        zenoh_config(SessionSettings(listen=("tcp/127.0.0.1:1?",)), "f1", 1, (1,))


@pytest.mark.parametrize(
    "table", [{"lease_ms": 0}, {"inbox_packets": 0}, {"listens": []}, {"listen": "tcp/x:1"}]
)
def test_bad_tables_are_refused(table: dict[str, object]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(table, SessionSettings)


def test_keys() -> None:
    assert key_expression("f1", 7, Stream.MEAS) == "cl/v1/f1/agent/007/meas"
    assert presence_pattern("f1") == "cl/v1/f1/agent/*/alive"
    for stream in Stream:
        assert parse_key(key_expression("a-b_0", 999, stream)) == ("a-b_0", 999, stream)


@pytest.mark.parametrize(
    "key",
    ["", "cl/v1/f1/agent/000/meas", "cl/v1/f1/agent/1000/meas", "cl/v1/f1/agent/01/meas",
     "cl/v2/f1/agent/001/meas", "cl/v1/f1/agent/001/other", "cl/v1/F/agent/001/meas",
     "cl/v1/f1/agent/001/meas\n", "x/cl/v1/f1/agent/001/meas",
     "cl/v1/f1/agent/\u0660\u0660\u0661/meas"],
)  # fmt: skip
def test_keys_that_are_not_ours(key: str) -> None:
    assert parse_key(key) is None
