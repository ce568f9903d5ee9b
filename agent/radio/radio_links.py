"""Which Zenoh endpoints an agent has on the radio, by the kind of link; docs/links.md says which serves where."""

from __future__ import annotations

from typing import Literal

RadioLink = Literal["tcp", "udp", "multilink"]
LOOPBACK = "127.0.0.1"


def radio_endpoints(link: RadioLink, host: str, port: int, *, secure: bool = False) -> tuple[str, ...]:
    """Endpoints that neighbours dial, the same as are listened on.

    A multilink is a stream for what has to arrive (declarations, presence, measurements) and datagrams for rounds.
    ``secure`` makes streams TLS; there are no secure datagrams.
    """
    stream, datagrams = f"{'tls' if secure else 'tcp'}/{host}:{port}", f"udp/{host}:{port}"
    if link == "multilink":
        return f"{stream}?rel=1", f"{datagrams}?rel=0"
    return (stream,) if link == "tcp" else (datagrams,)
