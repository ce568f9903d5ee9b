"""Packets end to end without a network: round trips, forging, replay, wrong fleet, key, sender, version."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
from nacl.signing import SigningKey

from transport.errors import EncodeError, Reason, Rejected, SettingsError
from transport.link.streams import Stream, key_expression
from transport.messages.agreement_body import Agreement
from transport.messages.clock_body import ClockAnswer
from transport.messages.estimate_body import FleetEstimate
from transport.messages.header import HEADER, HEADER_BYTES, MAX_DATAGRAM_BYTES, VERSION, PacketKind, fleet_hash
from transport.messages.information_body import Information
from transport.messages.measurement_body import (
    AccelerationMeasurement,
    Measurements,
    PositionMeasurement,
    RangeMeasurement,
    SpeedMeasurement,
    encode_measurements,
)
from transport.messages.report_body import Diagnostics
from transport.security.auth import UNSIGNED, Signing, Trust, sign, verify
from transport.security.opening import Opener
from transport.security.replay_guard import ReplayGuard
from transport.security.sealing import Message, Packet, Sealer

FLEET = "test"
ROSTER = (1, 2, 3, 4)
KEYS = {agent_id: SigningKey(bytes([agent_id]) * 32) for agent_id in ROSTER}
TRUST = {agent_id: (key.verify_key,) for agent_id, key in KEYS.items()}
T_NS = 1_800_000_000_000_000_000

MEASUREMENTS = Measurements(
    9, (SpeedMeasurement(2, 9, 1.5, 0.25), RangeMeasurement(2, 9, 3, 5.0, 0.25), SpeedMeasurement(3, 8, 2.5, 0.25))
)
ESTIMATE = FleetEstimate(9, 0, (2, 3), np.arange(12.0), np.ones(12), (0, 1), np.eye(6))


def information(n: int, tick: int = 9) -> Information:
    return Information(tick, 1, tick - 1, 6, tuple(range(1, n + 1)), np.eye(6 * n), np.zeros(6 * n))


class Receiver:
    """Agent 1 of the fleet, with a log of what it refused."""

    def __init__(
        self, trust: Trust = TRUST, freshness_s: float | None = None, replay: ReplayGuard | None = None
    ) -> None:
        self.refused: list[Reason] = []
        self.opener = Opener(
            FLEET,
            ROSTER,
            trust,
            own_id=1,
            freshness_s=freshness_s,
            replay=replay,
            on_rejected=lambda key, rejected: self.refused.append(rejected.reason),
        )

    def open(
        self,
        packet: bytes | Packet,
        *,
        sender: int = 2,
        stream: Stream = Stream.MEAS,
        now: float = 0.0,
        t_ns: int = T_NS,
    ):
        if isinstance(packet, Packet):
            stream, packet = packet.stream, packet.data
        return self.opener.open(key_expression(FLEET, sender, stream), packet, now=now, unix_ns=t_ns)


def sealer(agent_id: int = 2, *, boot: int = 5, fleet: str = FLEET, signing: Signing | None = None) -> Sealer:
    return Sealer(fleet, agent_id, boot=boot, signing=signing or KEYS[agent_id])


def sealed(message: Message = MEASUREMENTS, **options: object) -> bytes:
    (packet,) = sealer(**options).seal(message, t_ns=T_NS)  # type: ignore[arg-type]
    return packet.data


def resealed(packet: bytes, at: int, value: bytes) -> bytes:
    """A measurement packet whose sender changed bytes and signed them properly."""
    changed = packet[:at] + value + packet[at + len(value) : -64]
    key = key_expression(FLEET, 2, Stream.MEAS)
    return changed + sign(KEYS[2], key, changed[:HEADER_BYTES], changed[HEADER_BYTES:])


MESSAGES: list[tuple[Message, Stream]] = [
    (MEASUREMENTS, Stream.MEAS),
    (Measurements(0, ()), Stream.MEAS),
    (Agreement({"fleet.period_s": "0.1"}), Stream.AGREE),
    (Diagnostics(2, "NOMINAL", gauges={"age_s": 0.5}), Stream.DIAG),
    (ClockAnswer(1, 2, 3), Stream.CLOCK),
]


@pytest.mark.parametrize(("message", "stream"), MESSAGES)
@pytest.mark.parametrize("signed", [True, False])
def test_messages_come_back(message: Message, stream: Stream, signed: bool) -> None:
    (packet,) = sealer(signing=None if signed else UNSIGNED).seal(message, t_ns=T_NS)
    assert packet.stream is stream
    receiver = Receiver(trust=TRUST if signed else UNSIGNED)
    received = receiver.open(packet, now=3.5)
    assert received is not None
    assert (received.sender, received.seq, received.sent_ns, received.received_s) == (2, 1, T_NS, 3.5)
    assert received.message == message


def test_estimates_and_information_come_back() -> None:
    receiver, sender = Receiver(), sealer()
    (packet,) = sender.seal(ESTIMATE, t_ns=T_NS)
    received = receiver.open(packet)
    np.testing.assert_array_equal(received.message.mean, ESTIMATE.mean)
    np.testing.assert_array_equal(received.message.own_covariance, np.eye(6))
    for n, datagrams in ((3, 1), (4, 2)):
        packets = sender.seal(information(n), t_ns=T_NS)
        assert len(packets) == datagrams
        assert all(len(packet.data) <= MAX_DATAGRAM_BYTES for packet in packets)
        *first, received = [receiver.open(packet) for packet in packets]
        assert first == [None] * (datagrams - 1)
        np.testing.assert_array_equal(received.message.information, np.eye(6 * n))
    assert receiver.refused == []
    assert receiver.opener.peers[2].received == 4


def test_a_full_measurement_packet_keeps_the_datagram_limit_and_counts_the_rest() -> None:
    records = tuple(PositionMeasurement(2, t, (1.0, 2.0, 3.0), (1.0, 1.0, 1.0)) for t in range(99, -1, -1))
    sender = sealer()
    (packet,) = sender.seal(Measurements(99, records), t_ns=T_NS)
    assert len(packet.data) <= MAX_DATAGRAM_BYTES
    received = Receiver().open(packet)
    assert len(received.message.records) + sender.left_out == 100
    assert [record.tick for record in received.message.records][:3] == [99, 98, 97]


def test_ill_conditioned_pairs_travel_in_float64_by_themselves() -> None:
    matrix = np.diag(np.geomspace(1e-9, 1.0, 18)) + 0.0
    matrix[0, 1] = matrix[1, 0] = 0.9999999 * np.sqrt(matrix[0, 0] * matrix[1, 1])
    message = Information(9, 0, 9, 6, (1, 2, 3), matrix, np.ones(18))
    packets = sealer().seal(message, t_ns=T_NS)
    assert len(packets) == 2
    receiver = Receiver()
    received = [receiver.open(packet) for packet in packets][-1]
    np.testing.assert_array_equal(received.message.information, matrix)


# --- refusals ----------------------------------------------------------------------------------------------


def field_at(name: str) -> int:
    """Byte at which a header field starts."""
    formats = {
        "magic": "2s", "version": "B", "kind": "B", "sender": "H", "flags": "B", "round": "B", "boot": "I",
        "seq": "I", "tick": "I", "n": "H", "body_bytes": "H", "t_ns": "q", "fleet": "I", "agreement": "I",
    }  # fmt: skip
    before = list(formats)[: list(formats).index(name)]
    return struct.calcsize("<" + "".join(formats[field] for field in before))


def header_with(name: str, value: bytes) -> Callable[[bytes], bytes]:
    return lambda packet: packet[: field_at(name)] + value + packet[field_at(name) + len(value) :]


@pytest.mark.parametrize(
    ("tamper", "reason"),
    [
        (lambda p: b"", Reason.TOO_SHORT),
        (lambda p: p[:39], Reason.TOO_SHORT),
        (lambda p: p + b"\0" * 100_000, Reason.TOO_LONG),
        (lambda p: p[:-1], Reason.BAD_LENGTH),
        (lambda p: p + b"\0", Reason.BAD_LENGTH),
        (lambda p: p[:-64], Reason.UNSIGNED),
        (lambda p: p[:-64] + bytes(64), Reason.BAD_SIGNATURE),
        (header_with("magic", b"XX"), Reason.BAD_MAGIC),
        (header_with("version", b"\x01"), Reason.BAD_VERSION),
        (header_with("version", b"\x03"), Reason.BAD_VERSION),
        (header_with("kind", b"\x0a"), Reason.UNKNOWN_KIND),
        (header_with("kind", b"\x00"), Reason.UNKNOWN_KIND),
        (header_with("kind", b"\x03"), Reason.WRONG_KEY),
        (header_with("sender", b"\x03\x00"), Reason.WRONG_KEY),
        (header_with("sender", b"\x00\x00"), Reason.UNKNOWN_SENDER),
        (header_with("flags", b"\x02"), Reason.BAD_FLAGS),
        (header_with("body_bytes", b"\xff\xff"), Reason.TOO_LONG),
        (header_with("fleet", b"\0\0\0\0"), Reason.WRONG_FLEET),
        (header_with("tick", b"\x0a"), Reason.BAD_SIGNATURE),
        (header_with("agreement", b"\x0a"), Reason.BAD_SIGNATURE),
        (header_with("boot", b"\xff\xff\xff\xff"), Reason.BAD_SIGNATURE),
        (header_with("seq", b"\xff"), Reason.BAD_SIGNATURE),
        (header_with("t_ns", b"\xff"), Reason.BAD_SIGNATURE),
        (lambda p: p[:60] + bytes([p[60] ^ 1]) + p[61:], Reason.BAD_SIGNATURE),
    ],
)
def test_tampered_packets_are_refused_and_change_nothing(tamper, reason: Reason) -> None:
    receiver, packet = Receiver(), sealed()
    assert receiver.open(tamper(packet)) is None
    assert receiver.refused == [reason]
    assert receiver.opener.peers[2].rejections.as_dict() == {reason.value: 1}
    assert receiver.opener.replay.state == {}
    # THEN the honest packet is still accepted
    assert receiver.open(packet) is not None


@pytest.mark.parametrize(
    ("key", "reason"),
    [
        ("cl/v1/test/agent/003/meas", Reason.WRONG_KEY),
        ("cl/v1/test/agent/002/est", Reason.WRONG_KEY),
        ("cl/v1/other/agent/002/meas", Reason.WRONG_KEY),
        ("cl/v1/test/agent/002/meas/x", Reason.WRONG_KEY),
        ("cl/v1/test/agent/2/meas", Reason.WRONG_KEY),
        ("", Reason.WRONG_KEY),
    ],
)
def test_a_packet_under_another_key_is_refused(key: str, reason: Reason) -> None:
    receiver = Receiver()
    assert receiver.opener.open(key, sealed(), now=0.0, unix_ns=T_NS) is None
    assert receiver.opener.peers.rejections() == {reason.value: 1}
    assert receiver.opener.peers[2].last_received_s is None


def test_a_member_cannot_speak_for_another_member() -> None:
    # GIVEN agent 3 that signs with its own key what claims to be of agent 2
    receiver = Receiver()
    assert receiver.open(sealed(agent_id=2, signing=KEYS[3])) is None
    # or that sends its own packet on agent 2's key
    assert receiver.open(sealed(agent_id=3), sender=2) is None
    assert receiver.refused == [Reason.BAD_SIGNATURE, Reason.WRONG_KEY]


def test_strangers_our_own_id_and_other_fleets_are_refused() -> None:
    receiver = Receiver()
    stranger = Sealer(FLEET, 9, boot=1, signing=SigningKey.generate())
    assert receiver.open(stranger.seal(MEASUREMENTS, t_ns=T_NS)[0], sender=9) is None
    assert receiver.open(sealed(agent_id=1), sender=1) is None
    assert receiver.open(sealed(fleet="other")) is None
    assert receiver.refused == [Reason.UNKNOWN_SENDER, Reason.OWN_ID, Reason.WRONG_FLEET]
    assert receiver.opener.peers.unattributed.as_dict() == {"unknown_sender": 1, "own_id": 1}


def test_a_packet_cannot_be_replayed_as_another_stream() -> None:
    # GIVEN bytes that would be read as a clock's answer; THEN the signature binds them to the stream they came on
    receiver = Receiver()
    diagnostics = sealed(Diagnostics(2, "ok"))
    assert receiver.open(header_with("kind", bytes([PacketKind.CLOCK]))(diagnostics), stream=Stream.CLOCK) is None
    assert receiver.refused == [Reason.BAD_SIGNATURE]


def test_duplicates_and_replays_are_refused_in_any_order() -> None:
    receiver, sender = Receiver(), sealer()
    packets = [sender.seal(MEASUREMENTS, t_ns=T_NS)[0] for _ in range(100)]
    assert receiver.open(packets[70]) is not None
    assert receiver.open(packets[70]) is None
    assert receiver.open(packets[7]) is not None  # late, but within the window of 64
    assert receiver.open(packets[7]) is None
    assert receiver.open(packets[6]) is None  # older than the window
    assert receiver.open(packets[99]) is not None
    assert receiver.open(packets[70]) is None  # still remembered after the window has moved on
    assert receiver.open(packets[69]) is not None
    assert receiver.refused == [Reason.DUPLICATE, Reason.DUPLICATE, Reason.REPLAY, Reason.DUPLICATE]


def test_packets_of_an_earlier_start_are_replays_on_every_stream() -> None:
    receiver = Receiver()
    old, new = sealer(boot=5), sealer(boot=6)
    old_diagnostics = old.seal(Diagnostics(2, "ok"), t_ns=T_NS)[0]
    assert receiver.open(new.seal(MEASUREMENTS, t_ns=T_NS)[0]) is not None
    assert receiver.open(old.seal(MEASUREMENTS, t_ns=T_NS)[0]) is None
    assert receiver.open(old_diagnostics) is None
    assert receiver.refused == [Reason.REPLAY, Reason.REPLAY]


def test_a_restarted_sender_is_taken_back_at_once() -> None:
    receiver = Receiver()
    before = sealer(boot=5)
    for _ in range(3):
        assert receiver.open(before.seal(MEASUREMENTS, t_ns=T_NS)[0]) is not None
    assert receiver.open(sealer(boot=6).seal(MEASUREMENTS, t_ns=T_NS)[0]) is not None
    assert receiver.opener.peers[2].restarts == 1


def test_a_restarted_receiver_with_its_replay_state_refuses_old_packets() -> None:
    first = Receiver()
    packet = sealed()
    assert first.open(packet) is not None
    second = Receiver(replay=ReplayGuard(first.opener.replay.state))
    assert second.open(packet) is None
    assert second.refused == [Reason.DUPLICATE]


def test_a_signed_jump_of_numbers_is_harmless() -> None:
    receiver, packet = Receiver(), sealed()
    assert receiver.open(packet) is not None
    jump = resealed(packet, field_at("seq"), b"\xff\xff\xff\xff")
    tracemalloc.start()
    try:
        assert receiver.open(jump) is not None
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()
    (seen,) = receiver.opener.replay.state.values()
    assert (seen.newest, seen.window) == (2**32 - 1, 1)


def test_a_signature_holds_under_its_own_key_expression_only() -> None:
    packet = sealed()
    verify(TRUST[2], key_expression(FLEET, 2, Stream.MEAS), packet)
    for other in (key_expression(FLEET, 3, Stream.MEAS), key_expression("f2", 2, Stream.MEAS)):
        with pytest.raises(Rejected):
            verify(TRUST[2], other, packet)


@pytest.mark.parametrize(
    ("skew_s", "accepted"), [(0.0, True), (1.9, True), (-1.9, True), (2.1, False), (-2.1, False)]
)
def test_clocks_too_far_apart(skew_s: float, accepted: bool) -> None:
    receiver = Receiver(freshness_s=2.0)
    received = receiver.open(sealed(), t_ns=T_NS + round(skew_s * 1e9))
    assert (received is not None) is accepted
    assert receiver.refused == ([] if accepted else [Reason.STALE])


def said(tick: int, speed_mps: float) -> list[Message]:
    """What a drone says in a tick: measurements and information."""
    records = (SpeedMeasurement(2, tick, speed_mps, 0.25), RangeMeasurement(2, tick, 3, 5.0, 0.25))
    vector = np.full(18, speed_mps)
    return [Measurements(tick, records), Information(tick, 0, tick - 1, 6, (1, 2, 3), np.eye(18), vector)]


def test_a_member_that_repeats_itself_is_refused_until_it_says_something_new() -> None:
    # GIVEN a member with a good key that says the same of five ticks, with new numbers and stamps, then something new
    receiver, sender = Receiver(), sealer()
    opened = []
    for tick, speed_mps in enumerate([1.0, 2.0, 3.0, 3.0, 3.0, 3.0, 3.0, 4.0], start=9):
        packets = [packet for message in said(tick, speed_mps) for packet in sender.seal(message, t_ns=T_NS)]
        opened.append([receiver.open(packet) is not None for packet in packets])
    # THEN what comes for the third time is refused, and what is new is not
    assert opened == [[True, True]] * 4 + [[False, False]] * 3 + [[True, True]]
    assert receiver.refused == [Reason.REPEATED] * 6


def test_a_member_without_anything_to_say_may_repeat_it() -> None:
    receiver, sender = Receiver(), sealer()
    for tick in range(9, 30):
        (packet,) = sender.seal(Measurements(tick, (SpeedMeasurement(2, tick, 1.0, 0.25),)), t_ns=T_NS)
        assert receiver.open(packet) is not None
        (packet,) = sender.seal(Measurements(tick, (), 1), t_ns=T_NS)
        assert receiver.open(packet) is not None
        unknown = tuple(AccelerationMeasurement(2, tick - k, (0.0, 0.0, 0.0), (1.3, 1.3, 1.3)) for k in range(3))
        (packet,) = sender.seal(Measurements(tick, unknown, 2), t_ns=T_NS)
        assert receiver.open(packet) is not None


def test_a_properly_signed_bad_body_is_refused() -> None:
    # GIVEN a member that signs garbage: the signature is good, the numbers are not
    receiver, packet = Receiver(), sealed()
    assert receiver.open(resealed(packet, HEADER_BYTES, b"\xff")) is None
    assert receiver.open(sealed(Diagnostics(3, "ok")), stream=Stream.DIAG) is None
    assert receiver.refused == [Reason.MALFORMED, Reason.OUT_OF_RANGE]
    assert receiver.opener.peers[2].received == 0
    assert receiver.opener.peers[2].age_s(9.0) is None


def test_both_keys_are_accepted_while_one_is_rotated() -> None:
    new = SigningKey.generate()
    receiver = Receiver(trust={**TRUST, 2: (new.verify_key, KEYS[2].verify_key)})
    assert receiver.open(sealed(boot=5)) is not None
    assert receiver.open(sealed(boot=6, signing=new)) is not None
    assert Receiver().open(sealed(boot=6, signing=new)) is None


def test_unsigned_packets_only_where_they_were_asked_for() -> None:
    unsigned = sealed(signing=UNSIGNED)
    signed_only, laboratory = Receiver(), Receiver(trust=UNSIGNED)
    assert signed_only.open(unsigned) is None
    assert signed_only.refused == [Reason.UNSIGNED]
    assert laboratory.open(unsigned) is not None
    assert laboratory.open(sealed(boot=6)) is None
    assert laboratory.refused == [Reason.BAD_LENGTH]


def test_a_missing_public_key_is_a_fault_of_the_configuration() -> None:
    with pytest.raises(SettingsError, match=r"no public key for agents \[3, 4\]"):
        Opener(FLEET, ROSTER, {2: TRUST[2]}, own_id=1)


def test_lost_parts_are_counted_at_their_sender() -> None:
    receiver = Receiver()
    receiver.open(sealer().seal(information(4), t_ns=T_NS)[0], now=0.0)
    receiver.opener.expire(5.0)
    assert receiver.opener.peers[2].rejections.as_dict() == {"part_expired": 1}


def test_what_does_not_fit_a_header_is_not_sent() -> None:
    with pytest.raises(EncodeError, match="header"):
        sealer().seal(Measurements(2**32, ()), t_ns=T_NS)
    with pytest.raises(SettingsError, match="agent id 1000"):
        Sealer(FLEET, 1000, boot=1, signing=UNSIGNED)
    with pytest.raises(SettingsError, match="fleet name 'A B'"):
        Sealer("A B", 1, boot=1, signing=UNSIGNED)


def test_the_header_is_forty_bytes_as_specified() -> None:
    assert HEADER.size == HEADER_BYTES == 40
    packet = sealed()
    assert packet[:4] == b"CL\x02\x01"
    assert HEADER.unpack_from(packet)[3:10] == (2, 0, 0, 5, 1, 9, 3)


def test_who_shares_something_else_is_refused_and_remembered_but_may_say_what() -> None:
    # GIVEN a receiver that was given something else than the sender
    opener = Opener(FLEET, ROSTER, TRUST, own_id=1, agreement=7)
    honest = Sealer(FLEET, 2, boot=5, signing=KEYS[2], agreement=7)
    other = Sealer(FLEET, 2, boot=6, signing=KEYS[2], agreement=8)

    def opened(by: Sealer, message: Message, signed_by: SigningKey | None = None) -> Message | None:
        (packet,) = by.seal(message, t_ns=T_NS)
        data = packet.data
        if signed_by is not None:
            key = key_expression(FLEET, 2, packet.stream)
            data = data[:-64] + sign(signed_by, key, data[:HEADER_BYTES], data[HEADER_BYTES:-64])
        received = opener.open(key_expression(FLEET, 2, packet.stream), data, now=3.0, unix_ns=T_NS)
        return None if received is None else received.message

    # THEN what nobody signed is not remembered, what it measured is refused, and what it says of itself is not
    assert opened(honest, MEASUREMENTS) == MEASUREMENTS
    assert opened(other, MEASUREMENTS, KEYS[3]) is None
    assert opener.peers[2].disagreed_s is None
    assert opened(other, MEASUREMENTS) is None
    assert opener.peers[2].disagreed_s == 3.0
    assert opened(other, Agreement({"a": "b"})) == Agreement({"a": "b"})
    assert opener.peers.rejections() == {"bad_signature": 1, "disagrees": 1}


def version_one(message: Measurements, signing: Signing) -> bytes:
    """A packet as daemons sealed them before version 2."""
    body = encode_measurements(message).body
    head = struct.pack(
        "<2sBBHHIIIHHqII", b"CL", 1, 1, 2, 0, 5, 1, message.tick, message.exchange, len(message.records), T_NS,
        len(body), fleet_hash(FLEET),
    )  # fmt: skip
    seal = (
        sign(signing, key_expression(FLEET, 2, Stream.MEAS), head, body) if isinstance(signing, SigningKey) else b""
    )
    return head + body + seal


@pytest.mark.parametrize("signed", [True, False])
def test_a_daemon_of_version_one_is_refused_and_told_of_but_its_log_can_be_opened(signed: bool) -> None:
    trust = TRUST if signed else UNSIGNED
    old = version_one(MEASUREMENTS, KEYS[2] if signed else UNSIGNED)
    receiver = Receiver(trust)
    assert receiver.open(old, now=4.0) is None
    assert receiver.refused == [Reason.BAD_VERSION]
    assert receiver.opener.peers[2].version == (1, 4.0)
    of_a_log = Opener(FLEET, ROSTER, trust, own_id=1, agreement=None, recorded=True)
    for packet in (old, sealed(boot=6) if signed else sealed(boot=6, signing=UNSIGNED)):
        received = of_a_log.open(key_expression(FLEET, 2, Stream.MEAS), packet, now=0.0, unix_ns=T_NS)
        assert received is not None
        assert received.message == MEASUREMENTS


def test_a_daemon_of_version_one_refuses_ours_by_its_version() -> None:
    # GIVEN the check that daemons of version 1 have: magic, then the byte behind it
    magic, version = struct.unpack_from("<2sB", sealed())
    assert magic == b"CL"
    assert version == VERSION != 1


def test_rejections_name_their_reason_and_what_was_found() -> None:
    assert str(Rejected(Reason.BAD_VERSION, "version 2, expected 1")) == "bad_version: version 2, expected 1"
    assert str(Rejected(Reason.REPLAY)) == "replay"
