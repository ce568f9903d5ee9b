"""A fake autopilot's UDP socket: thin asyncio shell."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from typing import Any, cast

from agent.config.endpoints import Endpoint, LinkKind

MAX_DATAGRAM_BYTES = 1400
"""Several frames share a datagram up to this size, as autopilots do."""

Address = tuple[str | Any, int]
Accept = Callable[[bytes], tuple[list[bytes], bool]]
"""A datagram in; the frames in answer, and whether it held a valid frame."""


class PortError(OSError):
    """A socket that cannot be opened; the message names the address and what to do."""


class AutopilotPort(asyncio.DatagramProtocol):
    """Sends to the configured remote until a valid frame comes from elsewhere, then to that sender."""

    def __init__(self, remote: Address | None, accept: Accept) -> None:
        self.remote = remote
        self._accept = accept
        self._transport: asyncio.DatagramTransport | None = None
        self.send_errors = 0
        """Datagrams that this host could not send (no route, buffers full)."""
        self.unsent = 0
        """Frames for nobody: no remote was configured and none has spoken."""

    @property
    def local(self) -> Address:
        """The address bound."""
        if self._transport is None:
            raise PortError("simulated autopilot: its socket is not open")
        host, port = self._transport.get_extra_info("sockname")[:2]
        return host, port

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the socket."""
        self._transport = cast(asyncio.DatagramTransport, transport)

    def datagram_received(self, data: bytes, addr: Address) -> None:
        """Hand over, answer."""
        frames, valid = self._accept(data)
        if valid:
            self.remote = addr
        self.send(frames)

    def error_received(self, exc: Exception) -> None:
        """A datagram was not sent; the next may be."""
        self.send_errors += 1

    def send(self, frames: list[bytes]) -> None:
        """Send frames in as few datagrams as fit."""
        if self._transport is None or self._transport.is_closing():
            return
        if self.remote is None:
            self.unsent += len(frames)
            return
        waiting = b""
        for frame in frames:
            if waiting and len(waiting) + len(frame) > MAX_DATAGRAM_BYTES:
                self._transport.sendto(waiting, self.remote)
                waiting = b""
            waiting += frame
        if waiting:
            self._transport.sendto(waiting, self.remote)

    def close(self) -> None:
        """Close the socket; more calls do nothing."""
        if self._transport is not None:
            self._transport.close()


async def open_port(daemon: Endpoint, accept: Accept) -> AutopilotPort:
    """The socket opposite to a daemon's link: sends to where a ``udpin`` listens, binds where a ``udpout`` sends.

    Raises `PortError` for other links and for an address that is taken.
    """
    if daemon.kind is LinkKind.UDP_IN:
        host = "127.0.0.1" if daemon.host in ("", "0.0.0.0") else daemon.host
        local, remote = ("0.0.0.0" if host != "127.0.0.1" else host, 0), (host, daemon.port)
    elif daemon.kind is LinkKind.UDP_OUT:
        local, remote = (daemon.host, daemon.port), None
    else:
        raise PortError(
            f"simulated autopilot: expected a daemon link udpin:HOST:PORT or udpout:HOST:PORT, found {daemon}"
        )
    loop = asyncio.get_running_loop()
    try:
        if remote is not None:  # a name is looked up once, not for every datagram
            found = await loop.getaddrinfo(*remote, family=socket.AF_INET, type=socket.SOCK_DGRAM)
            remote = (str(found[0][4][0]), remote[1])
        _, port = await loop.create_datagram_endpoint(lambda: AutopilotPort(remote, accept), local_addr=local)
    except OSError as error:
        raise PortError(
            f"simulated autopilot of {daemon}: cannot open UDP {local[0]}:{local[1]}: {error.strerror or error}; "
            "is another simulator or autopilot running there, or the name unknown?"
        ) from error
    return port
