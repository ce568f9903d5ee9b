"""Proof of origin: relays pass records on or leave them out, and cannot do anything else to them."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nacl.signing import SigningKey

from transport.errors import Reason, Rejected
from transport.messages.header import MAX_DATAGRAM_BODY_BYTES
from transport.messages.measurement_body import (
    Measurement,
    Measurements,
    RangeMeasurement,
    SpeedMeasurement,
    as_sent,
    decode_measurements,
    encode_measurements,
)
from transport.messages.proofs import Proof, Prover, genuine, origin

ROSTER = frozenset(range(1, 8))
KEYS = {agent: SigningKey(bytes([agent]) * 32) for agent in ROSTER}
TRUST = {agent: (key.verify_key,) for agent, key in KEYS.items()}
FLEET, AGREEMENT = 11, 22


def prover(agent: int, agreement: int = AGREEMENT, fleet: int = FLEET) -> Prover:
    return Prover(agent, fleet, agreement, KEYS[agent])


def speed(owner: int, tick: int, value: float = 1.5) -> Measurement:
    return as_sent(SpeedMeasurement(owner, tick, value, 0.25))


def told(relay: int, records: list[Measurement], proofs: tuple[Proof, ...] = (), tick: int = 20) -> Measurements:
    """What is taken out of a relay's packet of these records."""
    sent = encode_measurements(Measurements(tick, tuple(records), proofs=proofs), prover=prover(relay))
    assert len(sent.body) <= MAX_DATAGRAM_BODY_BYTES
    return decode_measurements(sent.body, tick=tick, count=sent.count, roster=ROSTER, proven=True)


def covered(message: Measurements) -> set[tuple[int, int]]:
    """Owner and tick of the records that are proven."""
    good, _ = genuine(message.proofs or (), TRUST, fleet=FLEET, agreement=AGREEMENT)
    proven = {(proof.owner, digest) for proof in good for digest in proof.digests}
    return {(record.observer, record.tick) for record in message.records if origin(record) in proven}


def bad(proofs: tuple[Proof, ...]) -> int:
    return genuine(proofs, TRUST, fleet=FLEET, agreement=AGREEMENT)[1]


@settings(max_examples=60, deadline=None)
@given(
    st.dictionaries(st.integers(2, 7), st.sets(st.integers(10, 20), min_size=1, max_size=4), min_size=1),
    st.data(),
)
def test_what_relays_pass_on_stays_proven_whatever_they_leave_out(
    ticks_of: dict[int, set[int]], data: st.DataObject
) -> None:
    # GIVEN owners whose packets hold records of several ticks
    records: list[Measurement] = []
    proofs: list[Proof] = []
    for owner, ticks in ticks_of.items():
        own = [speed(owner, tick, 1.0 + owner) for tick in sorted(ticks)]
        first = told(owner, own)
        assert covered(first) == {(owner, tick) for tick in ticks}
        records += first.records
        proofs += first.proofs or ()
    # WHEN one relay passes some of them on, and another one some of those
    for relay in (1, 2):
        chosen = data.draw(st.lists(st.sampled_from(records), unique_by=lambda record: record.identity, min_size=1))
        message = told(relay, chosen, tuple(proofs))
        # THEN as many as fit arrive, all of them proven
        assert covered(message) == {(record.observer, record.tick) for record in message.records}
        assert bad(message.proofs or ()) == 0
        records = [record for record in message.records if record.observer != relay] or records
        proofs = [*(message.proofs or ()), *proofs]


def test_one_proof_covers_the_ticks_of_a_packet_and_costs_a_signature() -> None:
    records = [speed(2, tick) for tick in range(14, 21)]
    alone = encode_measurements(Measurements(20, tuple(records)))
    proven = encode_measurements(Measurements(20, tuple(records)), prover=prover(2))
    assert len(proven.body) == len(alone.body) + 4 + len(records) + 64
    # AND what a relay leaves out of it costs a digest
    (proof,) = told(2, records).proofs or ()
    part = encode_measurements(Measurements(20, tuple(records[3:]), proofs=(proof,)), prover=prover(1))
    assert len(part.body) == len(encode_measurements(Measurements(20, tuple(records[3:]))).body) + 4 + 4 + 3 * 8 + 64


def test_records_that_do_not_fit_with_their_proofs_are_left_out() -> None:
    # GIVEN more owners than a packet has room for
    records = [speed(owner, tick) for owner in range(2, 8) for tick in range(1, 21)]
    proofs = [told(owner, [record for record in records if record.observer == owner]) for owner in range(2, 8)]
    message = told(1, records, tuple(proof for each in proofs for proof in each.proofs or ()))
    assert 20 < len(message.records) < len(records)
    assert list(message.records) == records[: len(message.records)]
    assert covered(message) == {(record.observer, record.tick) for record in message.records}


@pytest.mark.parametrize(
    "forged",
    [
        pytest.param(speed(3, 20, 1.75), id="another value"),
        pytest.param(speed(3, 19, 1.5), id="another tick"),
        pytest.param(as_sent(RangeMeasurement(3, 20, 4, 1.5, 0.25)), id="another kind"),
        pytest.param(as_sent(SpeedMeasurement(3, 20, 1.5, 0.0625)), id="a smaller sigma"),
        pytest.param(as_sent(SpeedMeasurement(3, 20, 1.5, 0.25, offset_s=0.01)), id="another instant"),
        pytest.param(speed(4, 20, 1.5), id="another owner"),
    ],
)
def test_what_a_relay_makes_of_a_record_is_not_proven(forged: Measurement) -> None:
    # GIVEN a genuine record of 3 and its proof in the hands of relay 2
    (proof,) = told(3, [speed(3, 20)]).proofs or ()
    # WHEN it claims that the proof covers something else, and signs that itself as well
    claimed = Proof(forged.observer, tuple(sorted((forged.digest, *proof.digests))), proof.signature)
    for proofs in ((), (proof,), (claimed,), (replace(claimed, digests=(forged.digest,)),)):
        message = told(2, [forged], proofs)
        assert covered(message) == set()
    by_itself = replace(prover(2).prove((forged.digest,)), owner=forged.observer)
    message = told(2, [forged], (by_itself,))
    assert covered(message) == set()
    assert bad(message.proofs or ()) == 1


def test_a_member_proves_nothing_of_others_by_signing_their_digests() -> None:
    forged = speed(3, 20, 99.0)
    message = told(2, [speed(2, 20), forged])
    lie = prover(2).prove((forged.digest, *(digest for proof in message.proofs or () for digest in proof.digests)))
    (encoded,) = told(2, [speed(2, 20)], (lie,)).proofs or ()
    assert encoded.owner == 2
    assert origin(forged) not in {(proof.owner, digest) for proof in (lie,) for digest in proof.digests}


@pytest.mark.parametrize("elsewhere", [prover(3, agreement=23), prover(3, fleet=12)])
def test_proofs_hold_in_their_own_fleet_and_for_their_own_agreement(elsewhere: Prover) -> None:
    record = speed(3, 20)
    assert covered(told(2, [record], (elsewhere.prove((record.digest,)),))) == set()


def body_with(proof: bytes) -> bytes:
    return encode_measurements(Measurements(20, (speed(2, 20),))).body + proof


@pytest.mark.parametrize(
    "proof",
    [
        b"\x02",
        b"\x02\x00\x01\x00",
        b"\x02\x00\x01\x00\x00" + bytes(63),
        b"\x02\x00\x00\x00" + bytes(64),
        b"\x02\x00\x01\x00\x01" + bytes(64),
        b"\x03\x00\x01\x00\x00" + bytes(64),
        b"\x02\x00\x01\xff\x00" + bytes(64),
        b"\x02\x00\x01\x00\x00" + bytes(65),
        b"\x00\x00\x00\x02" + bytes(7),
        b"\x00\x00\x00\x01" + bytes(4) + b"\x02",
    ],
)
def test_what_is_no_proof_is_refused(proof: bytes) -> None:
    with pytest.raises(Rejected) as refused:
        decode_measurements(body_with(proof), tick=20, count=1, roster=ROSTER, proven=True)
    assert refused.value.reason is Reason.MALFORMED


def test_where_nobody_proves_nothing_may_follow_the_records() -> None:
    with pytest.raises(Rejected):
        decode_measurements(body_with(b"\0"), tick=20, count=1, roster=ROSTER)
