"""A hundred thousand hostile packets: nothing unsound is accepted, nothing but counts comes of the rest."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields

import numpy as np
import pytest
from nacl.signing import SigningKey

from transport.errors import Rejected
from transport.link.streams import key_expression
from transport.messages.agreement_body import Agreement
from transport.messages.clock_body import ClockAnswer
from transport.messages.estimate_body import FleetEstimate
from transport.messages.far_body import FarReport, FarReports
from transport.messages.header import HEADER, HEADER_BYTES, STREAM_OF_KIND, PacketKind
from transport.messages.information_body import Information
from transport.messages.measurement_body import (
    AccelerationMeasurement,
    AnchorRangeMeasurement,
    Measurements,
    PositionMeasurement,
    RangeMeasurement,
    SpeedMeasurement,
    VelocityMeasurement,
)
from transport.messages.report_body import Diagnostics
from transport.messages.uwb_body import UwbFrame, UwbRange, decode_uwb, encode_uwb_binary, encode_uwb_json
from transport.messages.window_body import WindowStates
from transport.security.auth import UNSIGNED, Signing, Trust
from transport.security.opening import Opener
from transport.security.sealing import Message, Sealer

FLEET, ROSTER, SENDER = "test", (1, 2, 3, 4), 2
SECRETS = {agent_id: SigningKey(bytes([agent_id]) * 32) for agent_id in ROSTER}
TRUST = {agent_id: (key.verify_key,) for agent_id, key in SECRETS.items()}
ONES = (1.0, 1.0, 1.0)

MESSAGES: list[Message] = [
    Measurements(
        9,
        (
            PositionMeasurement(2, 9, (1.0, 2.0, 3.0), ONES, ONES),
            VelocityMeasurement(2, 9, (1.0, 2.0, 3.0), ONES),
            SpeedMeasurement(2, 9, 1.5, 0.25),
            RangeMeasurement(2, 9, 3, 5.0, 0.25, 1.0),
            AnchorRangeMeasurement(3, 8, (1.0, 2.0, 3.0), 4.0, 0.25),
            AccelerationMeasurement(3, 8, (0.1, 0.2, 0.3), ONES),
        ),
    ),
    Information(9, 1, 8, 6, (1, 2), np.eye(12) + 0.5, np.ones(12)),
    Information(9, 0, 8, 6, (1, 2, 3, 4), np.eye(24) + 0.5, np.ones(24)),
    WindowStates(9, 1, 7, 2, (1, 2), np.arange(36.0).reshape(3, 12)),
    FleetEstimate(9, 0, (2, 3), np.arange(12.0), np.ones(12), (0, 1), np.eye(6)),
    FarReports(9, (FarReport(2, 9, 0, ONES, ONES, ONES, ONES), FarReport(4, 3, 3, ONES, ONES, ONES, ONES))),
    Agreement({"fleet.period_s": "0.1", "fleet.edges": "1-2 2-3"}),
    Diagnostics(2, "NOMINAL", ("why",), {"received": 3}, {"age_s": 0.5}),
    ClockAnswer(1, 2, 3),
]


def samples(signing: Signing) -> list[tuple[str, bytes]]:
    """(key, packet) of every message, from a sender whose numbers are far along."""
    sealer = Sealer(FLEET, SENDER, boot=5, signing=signing)
    packets = [packet for message in MESSAGES for packet in sealer.seal(message, t_ns=1)]
    return [(key_expression(FLEET, SENDER, packet.stream), packet.data) for packet in packets]


def opener(trust: Trust) -> Opener:
    return Opener(FLEET, ROSTER, trust, own_id=1)


def mutations(packet: bytes, rng: np.random.Generator, count: int, first_byte: int = 0) -> Iterator[bytes]:
    """Packets with one to four bits flipped, or bytes cut, added, overwritten."""
    for _ in range(count):
        changed = bytearray(packet)
        match rng.integers(6):
            case 0:
                del changed[rng.integers(len(changed)) :]
            case 1:
                changed += rng.bytes(int(rng.integers(1, 40)))
            case 2:
                at = int(rng.integers(first_byte, len(changed)))
                changed[at : at + 8] = rng.bytes(8)
            case _:
                for bit in rng.integers(8 * first_byte, 8 * len(changed), rng.integers(1, 5)):
                    changed[bit // 8] ^= 1 << bit % 8
        if changed != packet:
            yield bytes(changed)


def assert_sound(message: Message | None) -> None:
    """Whatever was accepted speaks of the fleet in finite numbers."""
    match message:
        case Measurements():
            for record in message.records:
                numbers = [getattr(record, f.name) for f in fields(record) if "half" not in f.name]
                assert np.isfinite(np.hstack(numbers)).all()
                assert record.observer in ROSTER
                assert 0 <= record.tick <= message.tick
        case Information():
            assert set(message.agents) <= set(ROSTER)
            assert np.isfinite(message.vector).all()
            np.linalg.cholesky(message.information)
        case WindowStates():
            assert set(message.agents) <= set(ROSTER)
            assert np.isfinite(message.path).all()
            assert message.path.shape[1] == 6 * len(message.agents)
            assert message.state_tick + len(message.path) - 1 <= message.tick
        case FleetEstimate():
            assert set(message.agents) <= set(ROSTER)
            assert np.isfinite(message.mean).all()
            assert (message.variance >= 0).all()
        case FarReports():
            for report in message.reports:
                state = (*report.position_m, *report.velocity_mps)
                sigmas = (*report.position_sigma_m, *report.velocity_sigma_mps)
                assert np.isfinite((*state, *sigmas)).all()
                assert min(sigmas) > 0.0
                assert report.agent in ROSTER
                assert 0 <= report.tick <= message.tick
        case Diagnostics():
            assert message.agent_id == SENDER
        case Agreement():
            assert all(name.isprintable() and value.isprintable() for name, value in message.settings.items())
        case _:
            assert message is None or isinstance(message, ClockAnswer)


def total(counts: Opener) -> int:
    return sum(counts.peers.rejections().values())


def test_no_mutation_of_a_signed_packet_is_accepted() -> None:
    # GIVEN 20 000 packets of all kinds, each with something changed
    rng, o, fed = np.random.default_rng(1), opener(TRUST), 0
    originals = samples(SECRETS[SENDER])
    for key, packet in originals:
        for changed in mutations(packet, rng, 20_000 // len(originals)):
            assert o.open(key, changed, now=0.0, unix_ns=1) is None
            fed += 1
    # THEN every single one was refused and counted, none left a trace, and the originals are accepted
    assert total(o) == fed > 19_000
    assert o.replay.state == {}
    assert o.peers[SENDER].received == 0
    for key, packet in originals:
        o.open(key, packet, now=0.0, unix_ns=1)
    assert o.peers[SENDER].received == len(originals)


def test_what_an_unsigned_fleet_accepts_is_at_least_sound() -> None:
    # GIVEN 70 000 mutated packets where nothing but the checks of header and body protects us
    rng, fed, accepted = np.random.default_rng(2), 0, 0
    originals = samples(UNSIGNED)
    for key, packet in originals:
        o = opener(UNSIGNED)
        for number, changed in enumerate(mutations(packet, rng, 70_000 // len(originals), first_byte=HEADER_BYTES)):
            # as an attacker would: a fresh number and a matching length
            fields_ = list(HEADER.unpack_from(changed)) if len(changed) >= HEADER_BYTES else None
            if fields_ is not None:
                fields_[7], fields_[10] = number, (len(changed) - HEADER_BYTES) & 0xFFFF
                changed = HEADER.pack(*fields_) + changed[HEADER_BYTES:]
            received = o.open(key, changed, now=number * 1e-3, unix_ns=1)
            assert_sound(received.message if received else None)
            fed += 1
            accepted += received is not None
        o.expire(1e9)
        assert total(o) + o.peers[SENDER].received >= 0.93 * (70_000 // len(originals))
    assert fed > 68_000
    assert 0 < accepted < fed


@pytest.mark.parametrize("trust", [TRUST, UNSIGNED])
def test_random_bytes_are_refused(trust: Trust) -> None:
    # GIVEN 40 000 packets of random bytes, half of them behind a correct beginning
    rng, o = np.random.default_rng(3), opener(trust)
    keys = [key_expression(FLEET, SENDER, stream) for stream in STREAM_OF_KIND.values()]
    beginning = samples(UNSIGNED)[0][1][:HEADER_BYTES]
    for number in range(20_000):
        junk = rng.bytes(int(rng.integers(0, 200)))
        key = keys[number % len(keys)]
        assert o.open(key, junk, now=0.0, unix_ns=1) is None
        assert o.open(key, beginning + junk, now=0.0, unix_ns=1) is None
    # THEN all are counted
    assert total(o) == 40_000
    assert o.replay.state == {} or trust is UNSIGNED


def test_random_keys_are_refused() -> None:
    rng, o = np.random.default_rng(4), opener(TRUST)
    (key, packet), *_ = samples(SECRETS[SENDER])
    for _ in range(2_000):
        at = int(rng.integers(len(key)))
        other = key[:at] + chr(int(rng.integers(32, 0x2FF))) + key[at + 1 :]
        if other != key:
            assert o.open(other, packet, now=0.0, unix_ns=1) is None


def test_uwb_frames_are_sound_or_refused() -> None:
    rng = np.random.default_rng(5)
    frame = UwbFrame(7, "unix", 5, (UwbRange(1, 5.0, 0.1, 0.5, -78.0, -80.0), UwbRange(3, 7.0)), observer=2)
    for payload in (encode_uwb_json(frame), encode_uwb_binary(frame)):
        for changed in mutations(payload, rng, 10_000):
            try:
                decoded = decode_uwb(changed)
            except Rejected:
                continue
            for r in decoded.ranges:
                assert 0 < r.range_m <= 2000
                assert r.sigma_m is None or 0 < r.sigma_m <= 2000
                assert 1 <= r.other <= 65535


def test_every_kind_of_packet_was_fuzzed() -> None:
    kinds = {PacketKind(packet[3]) for _, packet in samples(UNSIGNED)}
    assert kinds == set(PacketKind)
