"""Real byte links on loopback: UDP both ways, TCP both ways, a serial line made of a pseudo terminal."""

from __future__ import annotations

import asyncio
import errno
import os
import pty
import socket
import tty
from collections.abc import Awaitable, Callable

import pytest

from agent.config.endpoints import Endpoint, LinkKind
from agent.errors import LinkError
from agent.mavlink.link import SerialLink, TcpLink, UdpLink, create_link

HOST = "127.0.0.1"
PATIENCE_S = 10.0


class Inbox:
    """Collects what arrives; what starts with ``M`` counts as a valid frame."""

    def __init__(self) -> None:
        self.data: list[bytes] = []
        self.arrived = asyncio.Event()

    def __call__(self, data: bytes) -> bool:
        self.data.append(data)
        self.arrived.set()
        return data.startswith(b"M")

    async def wait(self) -> bytes:
        await asyncio.wait_for(self.arrived.wait(), PATIENCE_S)
        self.arrived.clear()
        return b"".join(self.data)


async def until(condition: Callable[[], bool]) -> None:
    """Let the loop turn until something holds."""

    async def poll() -> None:
        while not condition():
            await asyncio.sleep(0)

    await asyncio.wait_for(poll(), PATIENCE_S)


async def udp_pair(inbox: Inbox, other: Inbox) -> tuple[UdpLink, UdpLink]:
    listening = UdpLink(Endpoint(LinkKind.UDP_IN, HOST, 0), inbox)
    await listening.open()
    sending = UdpLink(Endpoint(LinkKind.UDP_OUT, HOST, listening.port), other)
    await sending.open()
    return listening, sending


async def test_a_listening_udp_link_answers_the_last_valid_sender() -> None:
    inbox, first_inbox, second_inbox = Inbox(), Inbox(), Inbox()
    listening, first = await udp_pair(inbox, first_inbox)
    listening.send(b"nobody yet")
    assert listening.dropped == 1
    assert "nobody there yet" in listening.description
    first.send(b"M1")
    await inbox.wait()
    assert first.endpoint.kind is LinkKind.UDP_OUT
    assert "peer 127.0.0.1" in listening.description
    second = UdpLink(Endpoint(LinkKind.UDP_OUT, HOST, listening.port), second_inbox)
    await second.open()
    second.send(b"garbage")
    await inbox.wait()
    listening.send(b"to the first")
    assert await first_inbox.wait() == b"to the first"
    second.send(b"M2")
    await inbox.wait()
    listening.send(b"to the second")
    assert await second_inbox.wait() == b"to the second"
    for link in (listening, first, second):
        await link.close()


async def test_a_taken_port_is_one_clear_line() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind((HOST, 0))
        endpoint = Endpoint(LinkKind.UDP_IN, HOST, taken.getsockname()[1])
        with pytest.raises(LinkError, match=f"mavlink {endpoint}: cannot be opened: .*in use; expected a free port"):
            await create_link(endpoint, Inbox()).open()


async def test_a_device_that_is_not_there_is_one_clear_line() -> None:
    endpoint = Endpoint(LinkKind.SERIAL, "/dev/no-such-device", 57600)
    with pytest.raises(LinkError, match="mavlink serial:/dev/no-such-device:57600: cannot be opened"):
        await create_link(endpoint, Inbox()).open()


@pytest.fixture
def quick_reopen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agent.mavlink.link.REOPEN_S", 0.02)


async def test_tcp_links_talk_and_the_dialling_one_comes_back(quick_reopen: None) -> None:
    inbox, other = Inbox(), Inbox()
    server = TcpLink(Endpoint(LinkKind.TCP_IN, HOST, 0), inbox)
    await server.open()
    port = server.port
    client = TcpLink(Endpoint(LinkKind.TCP_OUT, HOST, port), other)
    await client.open()
    await until(lambda: bool(client.peer))
    client.send(b"M hello")
    assert await inbox.wait() == b"M hello"
    server.send(b"M answer")
    assert await other.wait() == b"M answer"
    await server.close()
    await until(lambda: not client.peer)
    client.send(b"lost")
    assert client.dropped >= 1
    again = TcpLink(Endpoint(LinkKind.TCP_IN, HOST, port), inbox)
    await again.open()
    await until(lambda: client.opened == 2)
    client.send(b"M again")
    await until(lambda: b"M again" in b"".join(inbox.data))
    await client.close()
    await again.close()


@pytest.mark.parametrize("number", [errno.ETIMEDOUT, errno.EHOSTUNREACH, errno.ECONNRESET])
async def test_a_connection_that_the_network_ends_is_dialled_again(quick_reopen: None, number: int) -> None:
    # GIVEN a link to a server
    server = TcpLink(Endpoint(LinkKind.TCP_IN, HOST, 0), Inbox())
    await server.open()
    client = TcpLink(Endpoint(LinkKind.TCP_OUT, HOST, server.port), Inbox())
    await client.open()
    await until(lambda: bool(client.peer))
    # WHEN the system gives the connection up, as it does for an end that no longer acknowledges
    assert client._writer is not None
    client._writer.transport.get_protocol().connection_lost(OSError(number, os.strerror(number)))
    # THEN that is counted and it is dialled again, and the end of the link is an orderly one
    await until(lambda: client.opened == 2)
    assert client.dropped >= 1
    await client.close()
    await server.close()


async def test_a_connection_is_watched_by_the_system() -> None:
    server = TcpLink(Endpoint(LinkKind.TCP_IN, HOST, 0), Inbox())
    await server.open()
    client = TcpLink(Endpoint(LinkKind.TCP_OUT, HOST, server.port), Inbox())
    await client.open()
    await until(lambda: bool(client.peer and server.peer))
    for link in (client, server):
        assert link._writer is not None
        connection = link._writer.get_extra_info("socket")
        await until(lambda c=connection: bool(c.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)))  # type: ignore[misc]
        await link.close()


async def test_an_end_that_takes_nothing_any_more_is_let_go_without_waiting_for_it() -> None:
    # GIVEN a client that reads nothing, and more sent to it than the system buffers
    server = TcpLink(Endpoint(LinkKind.TCP_IN, HOST, 0), Inbox())
    await server.open()
    stuck = [socket.create_connection((HOST, server.port)) for _ in range(1)]
    await until(lambda: bool(server.peer))

    def fill() -> bool:
        server.send(bytes(60_000))
        return bool(server.dropped)

    await until(fill)
    # WHEN it is renewed THEN the connection is gone, and a new one serves
    server.renew()
    await until(lambda: not server.peer)
    stuck.append(socket.create_connection((HOST, server.port)))
    await until(lambda: server.opened == 2)
    server.dropped = 0
    await until(fill)
    # and closing does not wait either
    await asyncio.wait_for(server.close(), PATIENCE_S)
    for connection in stuck:
        connection.close()


@pytest.mark.parametrize("kind", [LinkKind.UDP_IN, LinkKind.UDP_OUT, LinkKind.TCP_IN, LinkKind.TCP_OUT])
@pytest.mark.parametrize("host", ["..bad", "x" * 64 + ".example", "nul\0"])
async def test_what_is_neither_name_nor_address_is_one_clear_line(kind: LinkKind, host: str) -> None:
    link = create_link(Endpoint(kind, host, 5760), Inbox())
    with pytest.raises(LinkError, match=f"mavlink {kind}:.*:5760: cannot be opened: "):
        await link.open()
    await link.close()


async def test_a_serial_link_reads_writes_and_survives_unplugging(quick_reopen: None) -> None:
    master, slave = pty.openpty()
    tty.setraw(master)
    inbox = Inbox()
    link = SerialLink(Endpoint(LinkKind.SERIAL, os.ttyname(slave), 57600), inbox)
    await link.open()
    os.close(slave)
    os.write(master, b"M in")
    assert await inbox.wait() == b"M in"
    link.send(b"M out")
    assert os.read(master, 100) == b"M out"
    os.close(master)  # unplugged
    await until(lambda: not link.peer)
    link.send(b"nowhere")
    assert link.dropped >= 1
    await link.close()


@pytest.mark.parametrize(
    ("kind", "expected"),
    [(LinkKind.UDP_IN, UdpLink), (LinkKind.TCP_OUT, TcpLink), (LinkKind.SERIAL, SerialLink)],
)
async def test_each_kind_of_address_has_its_link(kind: LinkKind, expected: Callable[..., Awaitable[None]]) -> None:
    link = create_link(Endpoint(kind, HOST, 1), Inbox())
    assert type(link) is expected
    assert link.datagrams == (expected is UdpLink)
