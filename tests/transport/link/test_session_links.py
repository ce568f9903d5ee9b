"""Sessions over streams and datagrams, and subscriptions declared anew where the first declaration was lost."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import AsyncIterator, Callable
from typing import cast

import pytest

from tests.support.ports import free_port
from transport.link.session import Handlers, Session, open_session
from transport.link.session_settings import SessionSettings
from transport.link.streams import Stream, key_expression

FLEET, BOUND_S, POLL_S = "links", 15.0, 0.01


class Node:
    """One session and what it got."""

    def __init__(self, agent_id: int | None, settings: SessionSettings) -> None:
        self.agent_id, self.settings = agent_id, settings
        self.got: list[tuple[str, bytes]] = []
        self.session: Session

    async def start(self, *listen_to: tuple[int, Stream]) -> None:
        handlers = Handlers(lambda key, payload, _arrived_s: self.got.append((key, payload)))
        self.session = await open_session(self.settings, FLEET, self.agent_id, (1, 2), handlers)
        for agent_id, stream in listen_to:
            self.session.subscribe(agent_id, [stream])
        self.session.announce()


async def until(condition: Callable[[], bool], act: Callable[[], object] = lambda: None) -> None:
    """Act until something has happened; fails the test if it does not."""
    end_s = time.monotonic() + BOUND_S
    while not condition():
        assert time.monotonic() < end_s, f"not seen within {BOUND_S:g} s"
        act()
        await asyncio.sleep(POLL_S)


class Air(asyncio.DatagramProtocol):
    """Datagrams between a dialler and a listener, through here; nothing passes while it is ``jammed``."""

    def __init__(self, listener: tuple[str, int]) -> None:
        self.jammed = False
        self.dropped: list[int] = []
        self._listener = listener
        self._dialler: tuple[str, int] | None = None
        self._transport: asyncio.DatagramTransport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.DatagramTransport, transport)

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        if addr != self._listener:
            self._dialler = addr
        target = self._dialler if addr == self._listener else self._listener
        if self.jammed:
            self.dropped.append(len(data))
        elif target is not None:
            self._transport.sendto(data, target)


Start = Callable[..., "asyncio.Future[Node]"]


@pytest.fixture
async def start() -> AsyncIterator[Callable[..., object]]:
    nodes: list[Node] = []

    async def started(agent_id: int | None, settings: SessionSettings, *listen_to: tuple[int, Stream]) -> Node:
        node = Node(agent_id, settings)
        await node.start(*listen_to)
        nodes.append(node)
        return node

    yield started
    for node in nodes:
        await node.session.close()


def settings(link: str, port: int, agent_id: int) -> SessionSettings:
    """Agent 1 listens, agent 2 dials."""
    endpoint = (f"{link}/127.0.0.1:{port}",)
    return SessionSettings(listen=endpoint) if agent_id == 1 else SessionSettings(connect=endpoint)


@pytest.mark.parametrize("link", ["udp", "tcp"])
async def test_packets_go_both_ways_over_every_link(link: str, start: Start) -> None:
    port = free_port(socket.SOCK_STREAM if link == "tcp" else socket.SOCK_DGRAM)
    one = await start(1, settings(link, port, 1), (2, Stream.MEAS))
    two = await start(2, settings(link, port, 2), (1, Stream.INFO))
    largest = bytes(1200)
    await until(lambda: bool(two.got), lambda: one.session.publish(Stream.INFO, largest))
    await until(lambda: bool(one.got), lambda: two.session.publish(Stream.MEAS, b"two"))
    assert two.got[0] == (key_expression(FLEET, 1, Stream.INFO), largest)
    assert one.got[0] == (key_expression(FLEET, 2, Stream.MEAS), b"two")


@pytest.mark.parametrize("link", ["udp", "tcp"])
async def test_a_subscription_declared_anew_is_heard_on(link: str, start: Start) -> None:
    # GIVEN two agents one of which hears the other
    port = free_port(socket.SOCK_STREAM if link == "tcp" else socket.SOCK_DGRAM)
    one = await start(1, settings(link, port, 1))
    two = await start(2, settings(link, port, 2), (1, Stream.MEAS), (1, Stream.INFO))
    for stream in (Stream.MEAS, Stream.INFO):
        await until(lambda: bool(two.got), lambda stream=stream: one.session.publish(stream, b"before"))  # type: ignore[misc]
        two.got.clear()
    # WHEN it declares its subscriptions anew, several times
    for _ in range(3):
        two.session.resubscribe(1)
    two.session.resubscribe(7)
    # THEN both go on, each packet handed over once
    for stream in (Stream.MEAS, Stream.INFO):
        await until(lambda: bool(two.got), lambda stream=stream: one.session.publish(stream, b"after"))  # type: ignore[misc]
        key = key_expression(FLEET, 1, stream)
        for payload in (b"once", b"end"):
            one.session.publish(stream, payload)
        await until(lambda key=key: (key, b"end") in two.got)  # type: ignore[misc]
        assert two.got.count((key, b"once")) == 1
        two.got.clear()
    assert two.session.failed == 0


async def test_a_declaration_that_was_lost_is_made_up_for(start: Start) -> None:
    # GIVEN two agents linked by datagrams, one of which subscribes while the air is jammed
    ports = [free_port(socket.SOCK_DGRAM) for _ in range(2)]
    loop = asyncio.get_running_loop()
    ends, air = await loop.create_datagram_endpoint(
        lambda: Air(("127.0.0.1", ports[0])), local_addr=("127.0.0.1", ports[1])
    )
    try:
        one = await start(1, settings("udp", ports[0], 1))
        two = await start(2, settings("udp", ports[1], 2), (1, Stream.INFO))
        await until(lambda: bool(two.got), lambda: one.session.publish(Stream.INFO, b"linked"))
        air.jammed = True
        two.session.subscribe(1, [Stream.MEAS])
        await until(lambda: bool(air.dropped))
        air.jammed = False
        # THEN the link lives and carries what was declared before, but not this
        two.got.clear()
        heard = key_expression(FLEET, 1, Stream.INFO), b"lives"

        def say() -> None:
            one.session.publish(Stream.MEAS, b"unheard")
            one.session.publish(Stream.INFO, b"lives")

        await until(lambda: two.got.count(heard) >= 10, say)
        assert set(two.got) == {heard}
        # WHEN it is declared anew, THEN it is heard
        two.session.resubscribe(1)
        await until(lambda: (key_expression(FLEET, 1, Stream.MEAS), b"unheard") in two.got, say)
    finally:
        ends.close()


async def test_after_the_end_nothing_is_declared_anew(start: Start) -> None:
    two = await start(2, settings("tcp", free_port(socket.SOCK_STREAM), 1), (1, Stream.MEAS))
    await two.session.close()
    two.session.resubscribe(1)
    assert two.session.failed == 0
