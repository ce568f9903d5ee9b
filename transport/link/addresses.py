"""Host names and Zenoh endpoints as text: what can be one, before anything is opened."""

from __future__ import annotations

import ipaddress
import re

SECURE_LINKS = ("tls", "quic")
PLAIN_LINKS = ("tcp", "udp")
MAX_PORT = 65535
ALL_LINKS = SECURE_LINKS + PLAIN_LINKS
_LABEL = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?")
_MAX_NAME = 253


def is_host(text: str) -> bool:
    """Whether a text is an IP address or could be a host's name; nobody is asked for it."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        labels = text.removesuffix(".").split(".")
        named = all(map(_LABEL.fullmatch, labels)) and len(text) <= _MAX_NAME
        return named and not labels[-1].isdigit()  # four numbers that are no address are no name either
    return True


def endpoint_fault(endpoint: str, links: tuple[str, ...] = ALL_LINKS, *, lowest: int = 0) -> str | None:
    """What a Zenoh endpoint such as ``tcp/192.168.7.3:7447?rel=1`` would have to have, ``None`` if it has it all.

    ``links`` are the transports that are allowed; ports begin at ``lowest`` (0: any free one, where one listens).
    """
    link, _, rest = endpoint.partition("/")
    address = rest.partition("?")[0].partition("#")[0]
    host, colon, port = address.rpartition(":")
    if link not in links or not colon:
        return f"one of {', '.join(f'{name}/HOST:PORT' for name in links)}"
    bare = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    if not is_host(bare) or (":" in bare and bare == host):
        return "a host's name or address (IPv6 in brackets)"
    if not re.fullmatch(r"[0-9]{1,5}", port) or not lowest <= int(port) <= MAX_PORT:
        return f"a port {lowest}..{MAX_PORT}"
    return None
