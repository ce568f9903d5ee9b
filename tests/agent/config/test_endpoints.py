"""Both spellings of addresses, and what is wrong with others."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.config.endpoints import Endpoint, LinkKind, parse_endpoint
from agent.errors import EndpointError


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("udpin:0.0.0.0:14540", Endpoint(LinkKind.UDP_IN, "0.0.0.0", 14540)),
        ("udpin://0.0.0.0:14540", Endpoint(LinkKind.UDP_IN, "0.0.0.0", 14540)),
        ("udpin::14540", Endpoint(LinkKind.UDP_IN, "0.0.0.0", 14540)),
        ("udp://:14540", Endpoint(LinkKind.UDP_IN, "0.0.0.0", 14540)),
        ("udpout:127.0.0.1:14550", Endpoint(LinkKind.UDP_OUT, "127.0.0.1", 14550)),
        ("tcp:127.0.0.1:5760", Endpoint(LinkKind.TCP_OUT, "127.0.0.1", 5760)),
        ("tcpout://fc.local:5760", Endpoint(LinkKind.TCP_OUT, "fc.local", 5760)),
        ("tcpin://[::1]:5760", Endpoint(LinkKind.TCP_IN, "::1", 5760)),
        ("serial:/dev/ttyAMA0:921600", Endpoint(LinkKind.SERIAL, "/dev/ttyAMA0", 921600)),
        ("serial:///dev/ttyAMA0:921600", Endpoint(LinkKind.SERIAL, "/dev/ttyAMA0", 921600)),
        ("/dev/ttyACM0,115200", Endpoint(LinkKind.SERIAL, "/dev/ttyACM0", 115200)),
        ("/dev/ttyACM0", Endpoint(LinkKind.SERIAL, "/dev/ttyACM0", 57600)),
    ],
)
def test_both_spellings_are_understood(text: str, expected: Endpoint) -> None:
    assert parse_endpoint(text) == expected
    assert parse_endpoint(str(expected)) == expected


@pytest.mark.parametrize(
    "text",
    [
        *("", "udp", "http://x:1", "udpin:x", "udpin:x:99999", "udpout::1", "serial:", "serial:/dev/x:fast"),
        *("tcpout:..bad:5760", "udpin:256.0.0.1:1", "tcp:a b:1", "udpout:x..y:1", f"tcp:{'x' * 64}:1"),
    ],
)
def test_what_is_no_address_is_refused_by_name(text: str) -> None:
    with pytest.raises(EndpointError) as caught:
        parse_endpoint(text)
    assert repr(text) in str(caught.value)


@given(st.text(max_size=40))
def test_no_text_does_anything_but_parse_or_be_refused(text: str) -> None:
    with contextlib.suppress(EndpointError):
        assert isinstance(parse_endpoint(text), Endpoint)
