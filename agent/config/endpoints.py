"""Addresses of MAVLink links, in both spellings that users know.

pymavlink writes ``udpin:host:port``, ``tcp:host:port`` and ``/dev/ttyUSB0,921600``; MAVSDK writes
``udpin://host:port``, ``tcpout://host:port`` and ``serial:///dev/ttyUSB0:921600``. *in* binds and waits for
the other side, *out* sends to it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum

from agent.errors import EndpointError
from transport.link.addresses import is_host

SPELLINGS = (
    "udpin:HOST:PORT, udpout:HOST:PORT, tcpin:HOST:PORT, tcpout:HOST:PORT (each also as scheme://HOST:PORT) "
    "or serial:DEVICE:BAUD"
)
DEFAULT_BAUD = 57600


class LinkKind(StrEnum):
    """Transport of a MAVLink link and who opens it."""

    UDP_IN = "udpin"
    UDP_OUT = "udpout"
    TCP_IN = "tcpin"
    TCP_OUT = "tcpout"
    SERIAL = "serial"


SCHEMES = {
    "udp": LinkKind.UDP_IN,
    "udpin": LinkKind.UDP_IN,
    "udpout": LinkKind.UDP_OUT,
    "tcp": LinkKind.TCP_OUT,
    "tcpin": LinkKind.TCP_IN,
    "tcpout": LinkKind.TCP_OUT,
}


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Where a MAVLink link is opened: host and port, or device and baud rate."""

    kind: LinkKind
    host: str
    """Host name or address; the device path of a serial link."""
    port: int
    """UDP or TCP port; the baud rate of a serial link."""

    def __str__(self) -> str:
        return f"{self.kind}:{self.host}:{self.port}"


def parse_endpoint(text: str) -> Endpoint:
    """Read an address in either spelling; raises `EndpointError` saying what is wrong with it."""
    if text.startswith("/dev/"):
        return _serial(text, text)
    scheme, separator, rest = text.partition(":")
    rest = rest.removeprefix("//")
    if scheme == "serial" and separator:
        return _serial(rest, text)
    if scheme not in SCHEMES or not separator:
        raise EndpointError(f"{text!r}, which names no transport of MAVLink")
    host, _, port = rest.rpartition(":")
    if not re.fullmatch(r"[0-9]{1,5}", port) or int(port) > 65535:
        raise EndpointError(f"{text!r}, whose port {port!r} is not 0..65535")
    host = host.strip("[]")
    if host and not is_host(host):
        raise EndpointError(f"{text!r}, whose host {host!r} is no address and no name")
    if not host and SCHEMES[scheme] in (LinkKind.UDP_OUT, LinkKind.TCP_OUT):
        raise EndpointError(f"{text!r}, which has no host to connect to")
    return Endpoint(SCHEMES[scheme], host or "0.0.0.0", int(port))


def _serial(device_and_baud: str, text: str) -> Endpoint:
    device, _, baud = re.match(r"(.*?)([:,]([^:,]*))?$", device_and_baud).group(1, 2, 3)  # type: ignore[union-attr]
    if not device:
        raise EndpointError(f"{text!r}, which has no device such as /dev/ttyUSB0")
    if baud is None:
        return Endpoint(LinkKind.SERIAL, device, DEFAULT_BAUD)
    if not baud.isdigit() or not 1200 <= int(baud) <= 12_000_000:
        raise EndpointError(f"{text!r}, whose baud rate {baud!r} is not 1200..12000000")
    return Endpoint(LinkKind.SERIAL, device, int(baud))
