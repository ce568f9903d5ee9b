"""Real byte links on loopback: UDP both ways, TCP both ways, a serial line made of a pseudo terminal."""

from __future__ import annotations

import asyncio
import os
import pty
import socket
import tty
from collections.abc import Awaitable, Callable

import pytest

from agent.endpoints import Endpoint, LinkKind
from agent.errors import LinkError
from agent.mavlink_link import SerialLink, TcpLink, UdpLink, create_link

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
    monkeypatch.setattr("agent.mavlink_link.REOPEN_S", 0.02)


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


async def test_a_serial_link_reads_writes_and_survives_unplugging(quick_reopen: None) -> None:
    pytest.importorskip("serial", reason="serial links need the extra [serial]")
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
