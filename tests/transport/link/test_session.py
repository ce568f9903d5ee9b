"""Real Zenoh sessions on loopback: everything waits for an event, with a bound on every wait."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from collections.abc import AsyncIterator, Sequence
from typing import Any

import numpy as np
import pytest
from nacl.signing import SigningKey

from tests.support.ports import free_ports
from transport.errors import SessionError
from transport.link.peers import ClockFilter
from transport.link.rounds import RoundBarrier
from transport.link.session import Handlers, Session, open_session
from transport.link.session_settings import SessionSettings
from transport.link.streams import Stream, key_expression
from transport.messages.clock_body import (
    ClockAnswer,
    decode_clock_question,
    encode_clock_question,
)
from transport.messages.information_body import Information
from transport.messages.measurement_body import Measurements, RangeMeasurement
from transport.messages.uwb_body import UwbFrame, UwbRange, decode_uwb, encode_uwb_json
from transport.security.opening import Opener, Received
from transport.security.sealing import Sealer

FLEET, BOUND_S = "loopback", 15.0
SECRETS = {agent_id: SigningKey(bytes([agent_id]) * 32) for agent_id in (1, 2, 3)}
TRUST = {agent_id: (secret.verify_key,) for agent_id, secret in SECRETS.items()}


class Node:
    """One agent: session, sealing, opening; what arrives can be waited for."""

    def __init__(self, agent_id: int | None, ports: dict[int, int], **settings: Any) -> None:
        self.agent_id = agent_id
        listen = (f"tcp/127.0.0.1:{ports[agent_id]}",) if agent_id in ports else ()
        dialled = [port for other, port in ports.items() if agent_id is None or other < agent_id]
        connect = tuple(f"tcp/127.0.0.1:{port}" for port in dialled)
        self.settings = SessionSettings(listen=listen, connect=connect, **settings)
        self.samples: asyncio.Queue[tuple[str, bytes, float]] = asyncio.Queue()
        self.presence: asyncio.Queue[tuple[int, bool]] = asyncio.Queue()
        self.opener = Opener(FLEET, (1, 2, 3), TRUST, own_id=agent_id)
        self.sealer = Sealer(FLEET, agent_id, boot=1, signing=SECRETS[agent_id]) if agent_id else None
        self.session: Session

    async def start(self, listen_to: Sequence[tuple[int, Stream]] = ()) -> None:
        handlers = Handlers(
            lambda key, payload, arrived_s: self.samples.put_nowait((key, payload, arrived_s)),
            lambda agent_id, alive: self.presence.put_nowait((agent_id, alive)),
            self.on_clock_question,
        )
        self.session = await open_session(self.settings, FLEET, self.agent_id, (1, 2, 3), handlers)
        for agent_id, stream in listen_to:
            self.session.subscribe(agent_id, [stream])
        self.session.announce()

    def on_clock_question(self, question: bytes, arrived_ns: int) -> bytes:
        assert self.sealer is not None
        answer = ClockAnswer(decode_clock_question(question), arrived_ns, max(arrived_ns, time.time_ns()))
        return self.sealer.seal(answer, t_ns=answer.answered_ns)[0].data

    def send(self, message: Measurements | Information) -> None:
        assert self.sealer is not None
        for packet in self.sealer.seal(message, t_ns=time.time_ns()):
            assert self.session.publish(packet.stream, packet.data)

    async def received(self) -> Received:
        while True:
            key, payload, arrived_s = await asyncio.wait_for(self.samples.get(), BOUND_S)
            message = self.opener.open(key, payload, now=arrived_s, unix_ns=time.time_ns())
            if message is not None:
                return message

    async def sees(self, agent_id: int, alive: bool) -> None:
        while await asyncio.wait_for(self.presence.get(), BOUND_S) != (agent_id, alive):
            pass


@contextlib.asynccontextmanager
async def fleet(size: int, streams: Sequence[Stream], **settings: Any) -> AsyncIterator[list[Node]]:
    """Agents 1..size, all neighbours, each listening to the streams of all others and seeing them."""
    ids = range(1, size + 1)
    ports = dict(zip(ids, free_ports(socket.SOCK_STREAM, size), strict=True))
    nodes = [Node(agent_id, ports, **settings) for agent_id in ids]
    try:
        for node in nodes:
            await node.start([(other, stream) for other in ids if other != node.agent_id for stream in streams])
        for node in nodes:
            seen = set()
            while seen < set(ids) - {node.agent_id}:
                agent_id, alive = await asyncio.wait_for(node.presence.get(), BOUND_S)
                seen |= {agent_id} if alive else set()
        yield nodes
    finally:
        for node in nodes:
            if hasattr(node, "session"):
                await node.session.close()


async def test_three_agents_exchange_measurements_and_consensus_rounds() -> None:
    async with fleet(3, [Stream.MEAS, Stream.INFO]) as nodes:
        # WHEN everyone sends measurements THEN everyone has everyone else's, exactly once
        for node in nodes:
            assert node.agent_id is not None
            other = node.agent_id % 3 + 1
            node.send(Measurements(5, (RangeMeasurement(node.agent_id, 5, other, 10.0, 0.25),)))
        for node in nodes:
            got = [await node.received() for _ in range(2)]
            assert {g.sender for g in got} == {1, 2, 3} - {node.agent_id}
            assert all(g.message.records[0].range_m == 10.0 for g in got)  # type: ignore[union-attr]
        # WHEN three rounds follow, with pairs that need float64 and so two datagrams each
        for round_ in range(3):
            barriers = []
            for node in nodes:
                pair = Information(5, round_, 4, 6, (1, 2, 3), np.eye(18) * (round_ + 1), np.ones(18))
                for packet in node.sealer.seal(pair, t_ns=1, double=True):  # type: ignore[union-attr]
                    node.session.publish(packet.stream, packet.data)
                barrier: RoundBarrier[Information] = RoundBarrier(3)
                barrier.open(5, round_, {1, 2, 3} - {node.agent_id}, BOUND_S)
                barriers.append(barrier)
            # THEN every round completes, with the pairs of that round
            for node, barrier in zip(nodes, barriers, strict=True):
                while not barrier.complete():
                    got_one = await node.received()
                    assert isinstance(got_one.message, Information)
                    barrier.put(got_one.sender, got_one.message.tick, got_one.message.round, got_one.message)
                assert all(m.information[0, 0] == round_ + 1 for m in barrier.close().values())
        for node in nodes:
            assert node.opener.peers.rejections() == {}
            assert (node.session.shed, node.session.failed) == (0, 0)
            assert node.session.connected() == 2
            assert {peer.lost for _, peer in node.opener.peers.items()} == {0}


async def test_a_stream_and_a_datagram_link_to_one_neighbour() -> None:
    # GIVEN two agents joined by a TCP link for what is reliable and a UDP link for the rest
    tcp, udp = free_ports(socket.SOCK_STREAM, 2)
    endpoints = (f"tcp/127.0.0.1:{tcp}?rel=1", f"udp/127.0.0.1:{udp}?rel=0")
    one, two = Node(1, {}), Node(2, {})
    one.settings, two.settings = SessionSettings(listen=endpoints), SessionSettings(connect=endpoints)
    try:
        await one.start([(2, Stream.MEAS), (2, Stream.INFO)])
        await two.start()
        await two.sees(1, True)
        # THEN packets of either sort arrive
        pair = Information(1, 0, 1, 6, (1,), np.eye(6), np.ones(6))
        for message, kind in ((Measurements(1, ()), Measurements), (pair, Information)):
            two.send(message)
            assert isinstance((await one.received()).message, kind)
    finally:
        for node in (one, two):
            if hasattr(node, "session"):
                await node.session.close()


async def test_only_what_was_subscribed_to_is_received() -> None:
    async with fleet(2, [Stream.INFO]) as (one, two):
        two.send(Measurements(1, ()))
        two.send(Information(1, 0, 1, 6, (1,), np.eye(6), np.ones(6)))
        received = await one.received()
        assert isinstance(received.message, Information)
        assert one.samples.empty()


async def test_leaving_and_returning_is_seen_at_once() -> None:
    async with fleet(2, [Stream.MEAS]) as (one, two):
        await two.session.close()
        await two.session.close()
        await one.sees(2, False)
        # a closed session takes nothing, says so, and raises nothing
        assert not two.session.publish(Stream.MEAS, b"")
        assert two.session.failed == 1
        # WHEN it returns with a later start THEN its packets are accepted without any ceremony
        await two.start([(1, Stream.MEAS)])
        two.sealer = Sealer(FLEET, 2, boot=2, signing=SECRETS[2])
        await one.sees(2, True)
        two.send(Measurements(7, ()))
        received = await one.received()
        assert (received.sender, received.message) == (2, Measurements(7, ()))


async def test_the_clock_of_a_neighbour_is_asked_and_the_answer_is_signed() -> None:
    async with fleet(2, []) as (one, _two):
        clock = ClockFilter()
        for _ in range(5):
            asked_ns = time.time_ns()
            answer = await one.session.ask_clock(2, encode_clock_question(asked_ns), timeout_s=BOUND_S)
            assert answer is not None
            packet, returned_ns = answer
            key = key_expression(FLEET, 2, Stream.CLOCK)
            received = one.opener.open(key, packet, now=0.0, unix_ns=returned_ns)
            assert received is not None
            assert isinstance(received.message, ClockAnswer)
            assert received.message.asked_ns == asked_ns
            clock.add(received.message, returned_ns)
        # THEN one and the same clock is found to be one: the offset is within half the round trip
        assert clock.offset_s is not None
        assert clock.round_trip_s is not None
        assert abs(clock.offset_s) <= clock.round_trip_s / 2 + 1e-6
        # and nobody answers for an agent that is not there
        assert await one.session.ask_clock(3, encode_clock_question(1)) is None


async def test_a_uwb_driver_feeds_its_agent_and_an_observer_watches() -> None:
    (port,) = free_ports(socket.SOCK_STREAM, 1)
    agent, driver = Node(1, {1: port}), Node(None, {1: port})
    try:
        await agent.start([(1, Stream.UWB)])
        await driver.start([(1, Stream.MEAS)])
        await driver.sees(1, True)
        frame = UwbFrame(1, "mono", 5, (UwbRange(2, 7.5, 0.1),), observer=1)
        assert driver.session.publish(Stream.UWB, encode_uwb_json(frame), agent_id=1)
        key, payload, _ = await asyncio.wait_for(agent.samples.get(), BOUND_S)
        assert key == key_expression(FLEET, 1, Stream.UWB)
        assert decode_uwb(payload) == frame
        agent.send(Measurements(3, ()))
        received = await driver.received()
        assert received.message == Measurements(3, ())
        with pytest.raises(ValueError, match="no streams of its own"):
            driver.session.publish(Stream.MEAS, b"")
    finally:
        for node in (agent, driver):
            await node.session.close()


async def test_a_flood_is_shed_and_counted_and_what_follows_arrives() -> None:
    # GIVEN an agent with room for 64 packets, whose event loop is busy while more garbage comes than that
    (port,) = free_ports(socket.SOCK_STREAM, 1)
    agent, attacker = Node(1, {1: port}, inbox_packets=64), Node(None, {1: port})
    try:
        await agent.start([(2, Stream.INFO), (2, Stream.MEAS)])
        await attacker.start()
        await attacker.sees(1, True)
        sent, give_up_s = 0, time.monotonic() + BOUND_S
        while agent.session.shed == 0 and time.monotonic() < give_up_s:
            attacker.session.publish(Stream.INFO, sent.to_bytes(4, "little") * 50, agent_id=2)
            sent += 1
        # WHEN the loop runs again THEN the inbox is emptied, and an honest packet still gets through
        honest = Sealer(FLEET, 2, boot=1, signing=SECRETS[2]).seal(Measurements(3, ()), t_ns=1)[0].data

        async def send_until_heard() -> Received:
            heard = asyncio.ensure_future(agent.received())
            while not heard.done():
                attacker.session.publish(Stream.MEAS, honest, agent_id=2)
                await asyncio.wait([heard], timeout=0.05)
            return heard.result()

        received = await asyncio.wait_for(send_until_heard(), BOUND_S)
        assert received.message == Measurements(3, ())
        refused = agent.opener.peers.rejections()
        assert set(refused) <= {"bad_magic", "duplicate"}
        assert refused["bad_magic"] >= 64
        assert agent.session.shed > 0
    finally:
        for node in (agent, attacker):
            await node.session.close()


async def test_a_failing_handler_stops_nothing() -> None:
    (port,) = free_ports(socket.SOCK_STREAM, 1)
    agent, other = Node(1, {1: port}), Node(None, {1: port})
    failures: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _loop, context: failures.append(context))
    try:
        good = agent.samples

        class Failing(asyncio.Queue[tuple[str, bytes, float]]):
            def put_nowait(self, item: tuple[str, bytes, float]) -> None:
                if item[1] == b"bad":
                    raise RuntimeError("handler")
                good.put_nowait(item)

        agent.samples = Failing()
        await agent.start([(2, Stream.MEAS)])
        await other.start()
        await other.sees(1, True)
        for payload in (b"bad", b"good"):
            other.session.publish(Stream.MEAS, payload, agent_id=2)
        assert (await asyncio.wait_for(good.get(), BOUND_S))[1] == b"good"
        assert [str(failure["exception"]) for failure in failures] == ["handler"]
    finally:
        for node in (agent, other):
            await node.session.close()


async def test_a_taken_port_is_one_clear_error() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(SessionError, match=rf"127\.0\.0\.1:{port}.*Address already in use") as error:
            await Node(1, {1: port}).start()
    assert "is the port taken" in str(error.value)
    assert ".rs:" not in str(error.value)


async def test_an_absent_neighbour_does_not_hold_up_the_start() -> None:
    # GIVEN agent 2 that dials agent 1, which comes up later
    ports = dict(zip((1, 2), free_ports(socket.SOCK_STREAM, 2), strict=True))
    one, two = Node(1, ports), Node(2, ports)
    try:
        await two.start([(1, Stream.MEAS)])
        assert two.session.connected() == 0
        await one.start()
        await one.sees(2, True)
        one.send(Measurements(1, ()))
        assert (await two.received()).sender == 1
    finally:
        for node in (one, two):
            if hasattr(node, "session"):
                await node.session.close()
