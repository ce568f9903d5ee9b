"""The byte link to the autopilot on asyncio: UDP, TCP, serial; reopened by itself.

Nothing is parsed here. Received bytes go to a callback that says whether they held a frame of the autopilot:
a UDP link that listens answers whoever sent the last one that did.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from agent.config.endpoints import Endpoint, LinkKind
from agent.errors import OPENING_FAULTS, LinkError, cause_of

REOPEN_S = 1.0
DIAL_TIMEOUT_S = 10.0
READ_BYTES = 4096
MAX_WRITE_BUFFER_BYTES = 64 * 1024
RECEIVE_BUFFER_BYTES = 1 << 20
"""Of a UDP socket: a moment without the processor must not lose samples (a small datagram takes almost 1 kB)."""
LIVENESS = {"TCP_KEEPIDLE": 5, "TCP_KEEPINTVL": 2, "TCP_KEEPCNT": 3, "TCP_USER_TIMEOUT": 10_000}
"""Socket options, where there are such: an end that vanished is noticed after some 10 s, not after 15 minutes."""

OnData = Callable[[bytes], bool]
"""Takes received bytes, tells whether a frame of the autopilot was in them; raises nothing."""


class MavlinkLink(ABC):
    """A link that is open, or trying to be, until it is closed."""

    def __init__(self, endpoint: Endpoint, on_data: OnData) -> None:
        self.endpoint = endpoint
        self._on_data = on_data
        self.opened = 0
        """How often the link was (re)opened."""
        self.dropped = 0
        """Frames that could not be sent."""
        self.peer = ""
        """Where frames go to, empty while that is unknown."""

    @property
    def datagrams(self) -> bool:
        """Whether reads keep the boundaries of writes."""
        return self.endpoint.kind in (LinkKind.UDP_IN, LinkKind.UDP_OUT)

    @property
    def description(self) -> str:
        """What the link does, in the words that end arguments about directions."""
        doing = "listening on" if self.endpoint.kind in (LinkKind.UDP_IN, LinkKind.TCP_IN) else "sending to"
        return f"{doing} {self.endpoint}" + (f", peer {self.peer}" if self.peer else ", nobody there yet")

    def counters(self) -> dict[str, int]:
        """What this side counts."""
        return {"mavlink tx dropped": self.dropped, "mavlink opened": self.opened}

    @abstractmethod
    async def open(self) -> None:
        """Open the link; raises `LinkError` if that can never work (port taken, no such device)."""

    @abstractmethod
    def send(self, frame: bytes) -> None:
        """Send one frame; dropped and counted if the link is not ready."""

    @abstractmethod
    def renew(self) -> None:
        """Nothing comes any more: drop a connection, whose other end may have gone unnoticed; it is made again."""

    @abstractmethod
    async def close(self) -> None:
        """Close the link for good; raises nothing for a link that failed."""


def create_link(endpoint: Endpoint, on_data: OnData) -> MavlinkLink:
    """The link of an endpoint, not opened yet."""
    if endpoint.kind in (LinkKind.UDP_IN, LinkKind.UDP_OUT):
        return UdpLink(endpoint, on_data)
    if endpoint.kind is LinkKind.SERIAL:
        return SerialLink(endpoint, on_data)
    return TcpLink(endpoint, on_data)


class UdpLink(MavlinkLink, asyncio.DatagramProtocol):
    """UDP, bound (in) or connected (out)."""

    _transport: asyncio.DatagramTransport | None = None
    _remote: Any = None
    _paused = False

    @property
    def port(self) -> int:
        """The local port, also where the configuration says 0."""
        assert self._transport is not None
        return int(self._transport.get_extra_info("sockname")[1])

    async def open(self) -> None:
        address = (self.endpoint.host, self.endpoint.port)
        listening = self.endpoint.kind is LinkKind.UDP_IN
        loop = asyncio.get_running_loop()
        try:
            if listening:
                self._transport, _ = await loop.create_datagram_endpoint(lambda: self, local_addr=address)
            else:
                self._transport, _ = await loop.create_datagram_endpoint(lambda: self, remote_addr=address)
        except OPENING_FAULTS as error:
            raise _unusable(self.endpoint, error) from error
        socket_of_link: socket.socket = self._transport.get_extra_info("socket")
        socket_of_link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        self.opened += 1
        if not listening:
            self.peer = f"{address[0]}:{address[1]}"

    def pause_writing(self) -> None:
        """The socket's buffer is full: what comes now is dropped, not queued."""
        self._paused = True

    def resume_writing(self) -> None:
        """The socket takes datagrams again."""
        self._paused = False

    def datagram_received(self, data: bytes, addr: Any) -> None:
        if self._on_data(data) and addr != self._remote and self.endpoint.kind is LinkKind.UDP_IN:
            self._remote = addr
            self.peer = f"{addr[0]}:{addr[1]}"

    def error_received(self, exc: Exception) -> None:
        self.dropped += 1  # nobody listens over there yet

    def send(self, frame: bytes) -> None:
        transport = self._transport
        if transport is None or self._paused:
            self.dropped += 1
        elif self.endpoint.kind is LinkKind.UDP_OUT:
            transport.sendto(frame)
        elif self._remote is not None:
            transport.sendto(frame, self._remote)
        else:
            self.dropped += 1

    def renew(self) -> None:
        """There is no connection."""

    async def close(self) -> None:
        if self._transport is not None:
            self._transport.close()
            self._transport = None


class TcpLink(MavlinkLink):
    """TCP, to a server (out, dialled again whenever it fails) or as one (in, the newest client wins)."""

    _server: asyncio.Server | None = None
    _writer: asyncio.StreamWriter | None = None
    _task: asyncio.Task[None] | None = None

    @property
    def port(self) -> int:
        """The local port of a server, also where the configuration says 0."""
        assert self._server is not None
        return int(self._server.sockets[0].getsockname()[1])

    async def open(self) -> None:
        host, port = self.endpoint.host, self.endpoint.port
        if self.endpoint.kind is LinkKind.TCP_OUT:
            self._check_host()
            self._task = asyncio.create_task(self._dial(), name=f"mavlink {self.endpoint}")
            return
        try:
            self._server = await asyncio.start_server(self._serve, host, port)
        except OPENING_FAULTS as error:
            raise _unusable(self.endpoint, error) from error

    def _check_host(self) -> None:
        """Refuse what can be neither name nor address; a name is looked up whenever it is dialled."""
        try:
            self.endpoint.host.encode("idna")
            socket.inet_pton(socket.AF_INET, self.endpoint.host)
        except OSError:  # not an address of IPv4
            return
        except ValueError as error:
            raise _unusable(self.endpoint, error) from error

    async def _dial(self) -> None:
        while True:
            try:
                async with asyncio.timeout(DIAL_TIMEOUT_S):
                    reader, writer = await asyncio.open_connection(self.endpoint.host, self.endpoint.port)
            except OPENING_FAULTS:
                self.dropped += 1
            else:
                await self._serve(reader, writer)
            await asyncio.sleep(REOPEN_S)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.renew()
        self._writer = writer
        self.opened += 1
        host, port = (writer.get_extra_info("peername") or ("gone", 0))[:2]  # it may have failed already
        self.peer = f"{host}:{port}"
        try:
            _watch(writer.get_extra_info("socket"))
            while data := await reader.read(READ_BYTES):
                self._on_data(data)
        except OSError:  # also TimeoutError, "no route to host": the network is gone, not the link
            self.dropped += 1
        finally:
            writer.transport.abort()
            if self._writer is writer:
                self._writer, self.peer = None, ""

    def send(self, frame: bytes) -> None:
        if self._writer is None or self._writer.transport.get_write_buffer_size() > MAX_WRITE_BUFFER_BYTES:
            self.dropped += 1
        else:
            self._writer.write(frame)

    def renew(self) -> None:
        if self._writer is not None:
            self._writer.transport.abort()  # closing would wait until the other end has taken what is unsent

    async def close(self) -> None:
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
        if self._server is not None:
            self._server.close()
        if self._writer is not None:
            self.renew()
            with contextlib.suppress(OSError):  # that of a connection which has failed
                await self._writer.wait_closed()


class SerialLink(MavlinkLink):
    """A serial device, reopened every second after it fails or is unplugged."""

    _port: Any = None
    _reopen: asyncio.TimerHandle | None = None

    async def open(self) -> None:
        try:
            self._open_device()
        except OPENING_FAULTS as error:
            raise _unusable(self.endpoint, error) from error

    def _open_device(self) -> None:
        import serial  # only where there is a serial port: it takes time to load

        self._port = serial.Serial(self.endpoint.host, self.endpoint.port, timeout=0, write_timeout=0, exclusive=True)
        self.opened += 1
        self.peer = self.endpoint.host
        asyncio.get_running_loop().add_reader(self._port.fileno(), self._read)

    def _read(self) -> None:
        try:
            data = os.read(self._port.fileno(), READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._on_data(data)
        else:
            self._fail()

    def _fail(self) -> None:
        """Drop the device and try again in a while."""
        self._release()
        self._reopen = asyncio.get_running_loop().call_later(REOPEN_S, self._try_again)

    def _try_again(self) -> None:
        try:
            self._open_device()
        except OPENING_FAULTS:
            self.dropped += 1
            self._fail()

    def _release(self) -> None:
        if self._port is not None:
            asyncio.get_running_loop().remove_reader(self._port.fileno())
            self._port.close()
            self._port, self.peer = None, ""

    def send(self, frame: bytes) -> None:
        if self._port is None:
            self.dropped += 1
            return
        try:
            written = os.write(self._port.fileno(), frame)
        except BlockingIOError:
            written = 0
        except OSError:
            written = 0
            self._fail()
        if written < len(frame):  # the receiver resynchronises on the next frame
            self.dropped += 1

    def renew(self) -> None:
        """A device that is unplugged says so."""

    async def close(self) -> None:
        if self._reopen is not None:
            self._reopen.cancel()
        self._release()


def _watch(connection: Any) -> None:
    """Have the system notice that the other end of a connection has vanished."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in LIVENESS.items():
        if hasattr(socket, name):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def _unusable(endpoint: Endpoint, error: Exception) -> LinkError:
    return LinkError(
        f"mavlink {endpoint}: cannot be opened: {cause_of(error)}; "
        "expected a free port or an existing device that no other program uses"
    )
