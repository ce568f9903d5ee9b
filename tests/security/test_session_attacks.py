"""Attacks over real sessions on loopback against an agent's radio: who gets in, and what is counted."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
import zenoh
from nacl.signing import SigningKey

from agent.config.tables import FleetConfig
from agent.radio.radio import Listener, Radio
from agent.radio.security import agent_session, driver_session, host_start, observer_session
from tests.security.conftest import MakeFleet
from tests.support.ports import bound
from transport.link.session import Handlers, Session, open_session
from transport.link.session_settings import SessionSettings, TlsSettings, zenoh_config
from transport.link.streams import Stream, key_expression
from transport.messages.clock_body import ClockAnswer, decode_clock_question
from transport.messages.measurement_body import Measurements, SpeedMeasurement
from transport.messages.uwb_body import UwbFrame, UwbRange, encode_uwb_json
from transport.security.certificate_files import Member, authority_path
from transport.security.certificates import issue, make_authority
from transport.security.envelope import Envelopes
from transport.security.keys import load_secret
from transport.security.opening import Opener
from transport.security.sealing import Sealer
from transport.security.shared_keys import load_group_keys
from transport.security.uwb_seal import UwbSeal

BOUND_S = 30.0
BOOT = 2_000_000_000
SALT = bytes(8)


class Target:
    """Agent 1 of a fleet as its daemon holds it: the radio, and the opener behind it."""

    def __init__(self, config: FleetConfig, base: Path) -> None:
        listener = Listener(self._on_packet, self._on_uwb, lambda _: None, self._on_clock, lambda _: None)
        self.radio = Radio(config, 1, base, listener)
        identity = self.radio.identity
        self.sealer = Sealer(config.fleet.name, 1, boot=identity.boot, signing=identity.signing)
        self.ranged: asyncio.Queue[bytes] = asyncio.Queue()
        fleet, freshness_s = config.fleet.name, config.security.freshness_s
        self.opener = Opener(fleet, config.ids, identity.trust, own_id=1, freshness_s=freshness_s)
        self.heard: asyncio.Queue[int] = asyncio.Queue()
        self.clock_answers: list[ClockAnswer] = []
        self.ticks: list[int] = []

    def _on_packet(self, key: str, data: bytes, arrived_s: float, unix_ns: int) -> None:
        received = self.opener.open(key, data, now=arrived_s, unix_ns=unix_ns)
        if received is not None and isinstance(received.message, ClockAnswer):
            self.clock_answers.append(received.message)
        if received is not None and isinstance(received.message, Measurements):
            self.heard.put_nowait(received.message.tick)
            self.ticks.append(received.message.tick)

    def _on_clock(self, question: bytes, arrived_ns: int) -> bytes:
        answer = ClockAnswer(decode_clock_question(question), arrived_ns, max(time.time_ns(), arrived_ns))
        return self.sealer.seal(answer, t_ns=time.time_ns())[0].data

    def _on_uwb(self, payload: bytes, _arrived_s: float) -> None:
        self.ranged.put_nowait(payload)

    def rejected(self) -> dict[str, int]:
        """Packets refused, by reason, as the daemon reports them."""
        by_radio = {name[9:]: n for name, n in self.radio.counters().items() if name.startswith("rejected ")}
        return by_radio | self.opener.peers.rejections()


@contextlib.asynccontextmanager
async def target(config: FleetConfig, base: Path) -> AsyncIterator[Target]:
    one = Target(config, base)
    await one.radio.open()
    try:
        yield one
    finally:
        await one.radio.close()


@contextlib.asynccontextmanager
async def lawless(
    settings: SessionSettings, config: FleetConfig, agent_id: int | None, handlers: Handlers | None = None
) -> AsyncIterator[Session]:
    """A session that keeps to no access control of its own, and is not seen as an agent unless it announces."""
    table = zenoh_config(settings, config.fleet.name, agent_id, config.ids)
    table.insert_json5("access_control", '{"enabled": false}')
    opened = await asyncio.to_thread(zenoh.open, table)
    session = Session(opened, config.fleet.name, agent_id, handlers or Handlers(lambda *_: None), 100)
    try:
        yield session
    finally:
        await session.close()


def dialling(config: FleetConfig, base: Path, agent_id: int) -> SessionSettings:
    """An agent's session that only dials agent 1."""
    tls = agent_session(config, agent_id, base).tls
    return SessionSettings(connect=config.listen(1), tls=tls)


def measurements(tick: int) -> Measurements:
    return Measurements(tick, (SpeedMeasurement(2, tick, 1.5, 0.25),))


class Voice:
    """Seals packets as somebody, with keys and numbers of our choice."""

    def __init__(
        self,
        config: FleetConfig,
        base: Path,
        agent_id: int = 2,
        *,
        signed_by: int | None = None,
        boot: int = BOOT,
        fleet: str | None = None,
        group_keys: tuple[bytes, ...] | None = None,
        t_off_s: float = 0.0,
    ) -> None:
        folder = base / config.security.keys
        signing: SigningKey = load_secret(folder, signed_by or agent_id)
        self._sealer = Sealer(fleet or config.fleet.name, agent_id, boot=boot, signing=signing)
        keys = group_keys or load_group_keys(folder)
        self._envelopes = Envelopes(keys, agent_id, boot=boot, salt=SALT) if config.security.encrypt else None
        self._fleet, self._agent_id = config.fleet.name, agent_id
        self._key = key_expression(config.fleet.name, agent_id, Stream.MEAS)
        self._t_off_s = t_off_s

    def packet(self, tick: int) -> bytes:
        (packet,) = self._sealer.seal(measurements(tick), t_ns=time.time_ns() + round(self._t_off_s * 1e9))
        return packet.data

    def clock_answer(self, answer: ClockAnswer) -> bytes:
        (packet,) = self._sealer.seal(answer, t_ns=time.time_ns())
        key = key_expression(self._fleet, self._agent_id, Stream.CLOCK)
        return packet.data if self._envelopes is None else self._envelopes.close(key, packet.data)

    def __call__(self, tick: int) -> bytes:
        data = self.packet(tick)
        return data if self._envelopes is None else self._envelopes.close(self._key, data)


async def put_until_heard(session: Session, one: Target, make: Callable[[int], bytes], tick: int) -> None:
    """Put a member's good packets of a tick until one is heard: subscriptions take a moment to get around."""
    end_s = time.monotonic() + BOUND_S
    heard = None
    while heard != tick:  # those of an earlier tick may still have been under way
        assert time.monotonic() < end_s, "the member itself is not heard"
        session.publish(Stream.MEAS, make(tick))
        with contextlib.suppress(TimeoutError):
            heard = await asyncio.wait_for(one.heard.get(), 0.2)


async def counted(session: Session, one: Target, data: bytes, claimed: int) -> set[str]:
    """Put a packet under an agent's key until it is refused, since a busy link drops some; the reasons counted."""
    before, end_s = one.rejected(), time.monotonic() + BOUND_S
    while one.rejected() == before:
        assert time.monotonic() < end_s, "the packet is not refused"
        session.publish(Stream.MEAS, data, agent_id=claimed)
        for _ in range(20):
            if one.rejected() == before:
                await asyncio.sleep(0.01)
    after = one.rejected()
    return {reason for reason, count in after.items() if count != before.get(reason, 0)}


async def settle(session: Session, one: Target, good: Voice, tick: int) -> None:
    """Wait for what is under way: a stream keeps its order, so a good packet comes after it."""
    while not one.heard.empty():
        one.heard.get_nowait()
    await put_until_heard(session, one, good, tick)


async def send_until_heard(one: Target, heard: asyncio.Queue[Any]) -> Any:
    """Have agent 1 send until it is heard."""
    end_s = time.monotonic() + BOUND_S
    while time.monotonic() < end_s:
        one.radio.send(one.sealer.seal(measurements(6), t_ns=time.time_ns()))
        with contextlib.suppress(TimeoutError):
            return await asyncio.wait_for(heard.get(), 0.2)
    raise AssertionError("agent 1 is not heard")


async def test_strangers_get_no_link_to_a_field_fleet(make_fleet: MakeFleet, tmp_path: Path) -> None:
    # GIVEN agent 1 of a field fleet; someone with the authority's certificate but none of its own, someone with a
    # certificate of that name from another authority, and someone who speaks plain TCP
    config, base = make_fleet("field", "fleet.edges=[[1,2]]")
    keys, rogue = base / config.security.keys, tmp_path / "rogue"
    rogue.mkdir(mode=0o700)
    make_authority(rogue, config.fleet.name, unix_s=time.time())
    issue(rogue, Member(config.fleet.name, 3), ["127.0.0.1"], unix_s=time.time())
    mine = Member(config.fleet.name, 3)
    foreign = TlsSettings(
        str(authority_path(keys)), str(mine.certificate(rogue)), str(mine.private_key(rogue))
    )
    endpoint = config.listen(1)[0]
    nameless = zenoh_config(SessionSettings(connect=(endpoint,), tls=foreign), config.fleet.name, 3, config.ids)
    bare = {"root_ca_certificate": str(authority_path(keys)), "verify_name_on_connect": True}
    nameless.insert_json5("transport/link/tls", json.dumps(bare))
    nameless.insert_json5("access_control", '{"enabled": false}')
    async with target(config, base) as one, contextlib.AsyncExitStack() as stack:
        opened = await asyncio.to_thread(zenoh.open, nameless)
        bare_session = Session(opened, config.fleet.name, 3, Handlers(lambda *_: None), 100)
        stack.push_async_callback(bare_session.close)
        plain = SessionSettings(connect=(endpoint.replace("tls/", "tcp/"),))
        foreigner = SessionSettings(connect=(endpoint,), tls=foreign)
        strangers = [
            bare_session,
            await stack.enter_async_context(lawless(foreigner, config, 3)),
            await stack.enter_async_context(lawless(plain, config, 3)),
        ]
        # WHEN a member comes after them, and is heard
        two = await stack.enter_async_context(lawless(dialling(config, base, 2), config, 2))
        await put_until_heard(two, one, Voice(config, base), 7)
        # THEN none of the strangers has a link
        assert [stranger.connected() for stranger in strangers] == [0, 0, 0]
        assert two.connected() == 1
        assert one.rejected() == {}


async def test_a_member_of_a_field_fleet_cannot_speak_under_anothers_key(make_fleet: MakeFleet) -> None:
    config, base = make_fleet("field", "fleet.edges=[[1,2],[1,3]]")
    as_three = Voice(config, base, 3)  # even the right signature does not help on the wrong link
    async with target(config, base) as one, lawless(dialling(config, base, 2), config, 2) as two:
        await put_until_heard(two, one, Voice(config, base), 7)
        two.publish(Stream.MEAS, as_three(8), agent_id=3)
        await put_until_heard(two, one, Voice(config, base, boot=BOOT + 1), 9)
        assert one.opener.peers[3].received == 0
        assert one.rejected() == {}


async def test_an_observers_certificate_hears_and_puts_nothing(make_fleet: MakeFleet) -> None:
    # GIVEN an observer without manners at agent 1, listening to its estimates
    config, base = make_fleet("field", "fleet.edges=[[1,2],[1,3]]")
    heard: asyncio.Queue[str] = asyncio.Queue()
    seen = asyncio.Event()
    handlers = Handlers(lambda key, *_: heard.put_nowait(key), lambda *_: seen.set())
    settings = SessionSettings(connect=config.listen(1), tls=observer_session(config, base).tls)
    async with target(config, base) as one, contextlib.AsyncExitStack() as stack:
        observer = await stack.enter_async_context(lawless(settings, config, None, handlers))
        observer.subscribe(1, (Stream.DIAG, Stream.MEAS))
        observer.announce()
        await asyncio.wait_for(seen.wait(), BOUND_S)
        # WHEN it puts packets of agents 2 and 3 that are good in every way
        for agent_id in (2, 3):
            observer.publish(Stream.MEAS, Voice(config, base, agent_id)(5), agent_id=agent_id)
        # THEN it hears agent 1, and agent 1 hears the member only
        key = await send_until_heard(one, heard)
        assert key == key_expression(config.fleet.name, 1, Stream.MEAS)
        two = await stack.enter_async_context(lawless(dialling(config, base, 2), config, 2))
        await put_until_heard(two, one, Voice(config, base, boot=BOOT + 1), 7)
        assert observer.connected() == 1
        assert set(one.ticks) == {7}


Attack = Callable[[FleetConfig, Path, Voice], Any]


def from_an_old_boot(config: FleetConfig, base: Path, _good: Voice) -> tuple[int, bytes]:
    return 2, Voice(config, base, boot=BOOT - 1)(8)


def signed_by_another_member(config: FleetConfig, base: Path, _good: Voice) -> tuple[int, bytes]:
    return 3, Voice(config, base, 3, signed_by=2)(8)


def of_another_fleet(config: FleetConfig, base: Path, _good: Voice) -> tuple[int, bytes]:
    return 2, Voice(config, base, fleet="other")(8)


def held_back(config: FleetConfig, base: Path, _good: Voice) -> tuple[int, bytes]:
    return 2, Voice(config, base, boot=BOOT + 1, t_off_s=-60.0)(8)


def with_a_wrong_group_key(config: FleetConfig, base: Path, _good: Voice) -> tuple[int, bytes]:
    return 2, Voice(config, base, boot=BOOT + 1, group_keys=(bytes(32),))(8)


def not_encrypted(config: FleetConfig, base: Path, _good: Voice) -> tuple[int, bytes]:
    return 2, Voice(config, base, boot=BOOT + 1).packet(8)


def one_bit_changed(_config: FleetConfig, _base: Path, good: Voice) -> tuple[int, bytes]:
    data = bytearray(good(8))
    data[-1] ^= 1
    return 2, bytes(data)


def own_packet_under_anothers_key(_config: FleetConfig, _base: Path, good: Voice) -> tuple[int, bytes]:
    return 3, good(8)


ATTACKS: list[tuple[Attack, str, str]] = [
    # (attack, reason where packets are signed, reason where they are encrypted too)
    (from_an_old_boot, "replay", "replay"),
    (signed_by_another_member, "bad_signature", "bad_signature"),
    (of_another_fleet, "wrong_fleet", "wrong_fleet"),
    (held_back, "stale", "stale"),
    (own_packet_under_anothers_key, "wrong_key", "wrong_group_key"),
    (one_bit_changed, "bad_signature", "wrong_group_key"),
    (with_a_wrong_group_key, "", "wrong_group_key"),
    (not_encrypted, "", "unencrypted"),
]


@pytest.mark.parametrize("encrypt", [False, True], ids=["signed", "encrypted"])
async def test_a_hostile_member_without_tls_is_refused_and_counted(make_fleet: MakeFleet, encrypt: bool) -> None:
    # GIVEN agent 1 of a lossy_field fleet on TCP, and a member that was heard
    overrides = ["transport.link=tcp", "fleet.edges=[[1,2],[1,3]]", f"security.encrypt={str(encrypt).lower()}"]
    config, base = make_fleet("lossy_field", *overrides)
    good = Voice(config, base)
    captured: list[bytes] = []

    def capture(tick: int) -> bytes:
        captured.append(good(tick))
        return captured[-1]

    async with target(config, base) as one, lawless(dialling(config, base, 2), config, 2) as two:
        await put_until_heard(two, one, capture, 7)
        # WHEN it attacks in every way THEN each attack is counted under its reason and no other
        for attack, signed_reason, encrypted_reason in ATTACKS:
            reason = encrypted_reason if encrypt else signed_reason
            if reason:
                claimed, data = attack(config, base, good)
                assert await counted(two, one, data, claimed) == {reason}
                await settle(two, one, good, 7)
        assert await counted(two, one, captured[-1], 2) == {"duplicate"}
        # AND nothing of it got through, and the member is heard as before when it speaks well again
        assert one.ticks == [7] * len(one.ticks)
        await put_until_heard(two, one, good, 9)
        assert one.opener.peers[3].received == 0


async def test_a_clocks_answer_to_somebody_elses_question_is_refused_and_counted(make_fleet: MakeFleet) -> None:
    # GIVEN agent 1, and who answers it with what agent 2 said a second ago to another question: signed all the same
    config, base = make_fleet("lossy_field", "transport.link=tcp", "fleet.edges=[[1,2]]")
    two, off_ns = Voice(config, base), [1_000_000_000]

    def answer(question: bytes, arrived_ns: int) -> bytes:
        return two.clock_answer(ClockAnswer(decode_clock_question(question) - off_ns[0], arrived_ns, arrived_ns))

    handlers = Handlers(lambda *_: None, on_clock_question=answer)
    async with target(config, base) as one, lawless(dialling(config, base, 2), config, 2, handlers) as asked:
        asked.announce()
        end_s = time.monotonic() + BOUND_S
        # WHEN agent 1 asks THEN it is refused
        while not one.rejected():
            assert time.monotonic() < end_s, "no answer came"
            await one.radio.ask_clocks()
        assert set(one.rejected()) == {"wrong_answer"}
        assert one.clock_answers == []
        # and an answer to its own question is taken
        off_ns[0] = 0
        while not one.clock_answers:
            assert time.monotonic() < end_s, "no answer is taken"
            await one.radio.ask_clocks()


async def test_what_goes_over_the_air_is_encrypted(make_fleet: MakeFleet) -> None:
    config, base = make_fleet("lossy_field", "transport.link=tcp", "fleet.edges=[[1,2]]")
    heard: asyncio.Queue[bytes] = asyncio.Queue()
    handlers = Handlers(lambda _key, payload, _arrived_s: heard.put_nowait(payload))
    async with target(config, base) as one, lawless(dialling(config, base, 2), config, 2, handlers) as two:
        two.subscribe(1, (Stream.MEAS,))
        await put_until_heard(two, one, Voice(config, base), 7)
        air = await send_until_heard(one, heard)
        assert b"CL" not in air[:36]
        opened = Envelopes(load_group_keys(base / config.security.keys), None).open(
            key_expression(config.fleet.name, 1, Stream.MEAS), air
        )
        assert opened[:2] == b"CL"


def range_frame(seq: int, range_m: float) -> bytes:
    """What a driver of agent 1 publishes."""
    return encode_uwb_json(UwbFrame(seq, "unix", time.time_ns(), (UwbRange(2, range_m, 0.05),), 1))


async def put_ranges_until(session: Session, frame: bytes, happened: Callable[[], bool]) -> None:
    """Put a frame on agent 1's UWB key until something comes of it."""
    end_s = time.monotonic() + BOUND_S
    while not happened():
        assert time.monotonic() < end_s, "nothing comes of the frames"
        session.publish(Stream.UWB, frame, agent_id=1)
        await asyncio.sleep(0.05)


@pytest.mark.parametrize("link", ["tcp", "udp", "multilink"])
async def test_ranges_that_do_not_come_from_the_drones_own_driver_are_refused_and_counted(
    make_fleet: MakeFleet, link: str
) -> None:
    # GIVEN agent 1 of a lossy_field fleet, its devices on one port and its radio on another
    with bound(socket.SOCK_STREAM) as devices, bound(socket.SOCK_STREAM) as on_radio:
        places = [f'agents.1.listen=["tcp/127.0.0.1:{devices}"]', "agents.1.radio=127.0.0.1"]
    places += [f"transport.radio_port={on_radio}", f"transport.link={link}", "fleet.edges=[[1,2]]"]
    config, base = make_fleet("lossy_field", *places)
    radio = config.listen(1)[-1:]  # datagrams, where there are any
    async with target(config, base) as one, contextlib.AsyncExitStack() as stack:
        counted = one.radio.counters
        # WHEN a stranger without any key puts ranges on its key over the radio, and a member seals its own likewise
        stranger = await stack.enter_async_context(lawless(SessionSettings(connect=radio), config, None))
        await put_ranges_until(
            stranger, range_frame(1, 777.0), lambda: counted().get("rejected uwb unsigned", 0) > 0
        )
        foreign = UwbSeal(load_secret(base / config.security.keys, 2), host_start())
        sealed = foreign.close(key_expression(config.fleet.name, 1, Stream.UWB), range_frame(2, 888.0))
        await put_ranges_until(stranger, sealed, lambda: counted().get("rejected uwb bad_signature", 0) > 0)
        # THEN nothing of it is measured, while the drone's own driver is heard
        assert one.ranged.empty()
        driver = await open_session(
            driver_session(config, 1, base), config.fleet.name, 1, config.ids, Handlers(lambda *_: None)
        )
        stack.push_async_callback(driver.close)
        own = range_frame(3, 9.0)
        await put_ranges_until(driver, own, lambda: not one.ranged.empty())
        assert one.ranged.get_nowait() == own
