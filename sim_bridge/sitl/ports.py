"""The bridge's port for MAVSDK and ground stations: whoever speaks to it is answered, several at a time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, cast

from sim_bridge.autopilot.udp_autopilot import MAX_DATAGRAM_BYTES, Address, PortError

CLIENT_TIMEOUT_S = 10.0
"""A client that has been silent for this long is forgotten."""
MAX_CLIENTS = 8


class ClientPort(asyncio.DatagramProtocol):
    """One autopilot's port for clients; ``listeners`` are sent to unasked and never forgotten."""

    def __init__(self, on_data: Callable[[bytes], None], listeners: tuple[Address, ...] = ()) -> None:
        self._on_data = on_data
        self._listeners = listeners
        self._heard_s: dict[Address, float] = {}
        self._transport: asyncio.DatagramTransport | None = None
        self.send_errors = 0
        self.refused = 0
        """Datagrams of clients beyond the most that are served."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the socket."""
        self._transport = cast(asyncio.DatagramTransport, transport)

    def datagram_received(self, data: bytes, addr: Address) -> None:
        """Hand on, and remember who spoke."""
        if addr not in self._heard_s and len(self.clients) >= MAX_CLIENTS:
            self.refused += 1
            return
        self._heard_s[addr] = asyncio.get_running_loop().time()
        self._on_data(data)

    def error_received(self, exc: Exception) -> None:
        """A client has gone."""
        self.send_errors += 1

    @property
    def clients(self) -> list[Address]:
        """Who spoke lately."""
        oldest_s = asyncio.get_running_loop().time() - CLIENT_TIMEOUT_S
        self._heard_s = {address: heard_s for address, heard_s in self._heard_s.items() if heard_s >= oldest_s}
        return list(self._heard_s)

    def send(self, frames: list[bytes]) -> None:
        """Send frames to all of them, in as few datagrams as fit."""
        if self._transport is None or self._transport.is_closing():
            return
        addresses = dict.fromkeys((*self._listeners, *self.clients))
        if addresses:
            for datagram in packed(frames):
                for address in addresses:
                    self._transport.sendto(datagram, address)

    def close(self) -> None:
        """Close the socket; more calls do nothing."""
        if self._transport is not None:
            self._transport.close()


def packed(frames: list[bytes]) -> list[bytes]:
    """Whole frames in datagrams of at most `MAX_DATAGRAM_BYTES` (unless one alone is longer)."""
    datagrams = [b""]
    for frame in frames:
        if datagrams[-1] and len(datagrams[-1]) + len(frame) > MAX_DATAGRAM_BYTES:
            datagrams.append(b"")
        datagrams[-1] += frame
    return [datagram for datagram in datagrams if datagram]


async def open_client_port(
    host: str, port: int, on_data: Callable[[bytes], None], listeners: tuple[Address, ...] = ()
) -> ClientPort:
    """Bind it; raises `PortError` for a port that is taken."""
    loop = asyncio.get_running_loop()
    local: Any = (host, port)
    try:
        _, opened = await loop.create_datagram_endpoint(lambda: ClientPort(on_data, listeners), local_addr=local)
    except OSError as error:
        raise PortError(
            f"sitl bridge: cannot open UDP {host}:{port} for MAVSDK and ground stations: "
            f"{error.strerror or error}; is another bridge running?"
        ) from error
    return opened
