"""Information pairs: round trips, splitting, reassembly in any order, refusals, bounded memory."""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from transport.errors import EncodeError, Reason, Rejected
from transport.messages.header import MAX_DATAGRAM_BODY_BYTES
from transport.messages.information_body import (
    Information,
    InformationPart,
    decode_part,
    encode_information,
    float32_suffices,
    part_count,
)
from transport.messages.reassembly import Reassembler

TICK, ROUND = 700, 2


def pair(agents: tuple[int, ...], seed: int = 0, condition: float = 1e3) -> Information:
    rng = np.random.default_rng(seed)
    dimension = 6 * len(agents)
    basis, _ = np.linalg.qr(rng.standard_normal((dimension, dimension)))
    matrix = basis * np.geomspace(1.0, condition, dimension) @ basis.T
    matrix = 0.5 * (matrix + matrix.T)
    return Information(TICK, ROUND, TICK - 2, 6, agents, matrix, matrix @ rng.standard_normal(dimension))


def parts_of(message: Information, *, double: bool, fleet_size: int = 20) -> list[InformationPart]:
    n = len(message.agents)
    bodies = encode_information(message, double=double)
    return [decode_part(b, tick=TICK, agents=n, double=double, fleet_size=fleet_size) for b in bodies]


class Collector:
    """A reassembler that knows agents 1..20, and the parts it gave up."""

    def __init__(self, **options: float) -> None:
        self.expired: Counter[int] = Counter()
        self.reassembler = Reassembler(range(1, 21), self._count, **options)  # type: ignore[arg-type]

    def _count(self, sender: int, parts: int) -> None:
        self.expired[sender] += parts

    def add(self, part: InformationPart, *, sender: int = 1, tick: int = TICK) -> Information | None:
        return self.reassembler.add(sender, tick, ROUND, part, 0.0)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(1, 20), min_size=1, max_size=8, unique=True),
    st.integers(0, 1000),
    st.booleans(),
    st.randoms(use_true_random=False),
)
def test_a_pair_comes_back_from_its_parts_in_any_order(agents, seed, double, shuffler) -> None:
    message = pair(tuple(agents), seed)
    parts = parts_of(message, double=double)
    shuffler.shuffle(parts)
    collector = Collector()
    results = [collector.add(part) for part in parts]
    # THEN only the last part completes it, ids, ticks and rank are exact, numbers to their precision
    assert results[:-1] == [None] * (len(parts) - 1)
    received = results[-1]
    assert received is not None
    assert (received.tick, received.round, received.state_tick) == (TICK, ROUND, TICK - 2)
    assert (received.rank, received.agents) == (6, tuple(agents))
    exactness = 0.0 if double else 1e-7
    np.testing.assert_allclose(received.information, message.information, rtol=exactness, atol=0)
    np.testing.assert_allclose(received.vector, message.vector, rtol=exactness, atol=0)
    assert (received.information == received.information.T).all()
    collector.reassembler.expire(1e9)
    assert not collector.expired  # nothing of it is held any longer


@pytest.mark.parametrize(("agents", "single", "double"), [(3, 1, 2), (4, 2, 3), (5, 2, 4), (6, 3, 6)])
def test_the_number_of_datagrams(agents: int, single: int, double: int) -> None:
    assert part_count(agents, double=False) == single
    assert part_count(agents, double=True) == double
    for body in encode_information(pair(tuple(range(1, agents + 1))), double=True):
        assert len(body) <= MAX_DATAGRAM_BODY_BYTES


def test_float32_where_conditioning_allows() -> None:
    well, badly = pair((1, 2, 3), condition=1e4), pair((1, 2, 3), condition=1e9)
    assert float32_suffices(well.information)
    assert not float32_suffices(badly.information)
    # the units of the states do not matter
    scale = np.diag(np.tile([1e4, 1e4, 1e4, 1e-3, 1e-3, 1e-3], 3))
    assert float32_suffices(scale @ well.information @ scale)
    assert not float32_suffices(np.diag([1e30, 1.0]) * 1e30)
    assert not float32_suffices(np.zeros((6, 6)))


@pytest.mark.parametrize("missing", range(3))
def test_a_lost_part_makes_nothing_but_a_count(missing: int) -> None:
    # GIVEN a pair of three parts of which one is lost
    collector = Collector(expiry_s=1.0)
    parts = parts_of(pair(tuple(range(1, 7))), double=False)
    assert len(parts) == 3
    assert all(collector.add(part) is None for i, part in enumerate(parts) if i != missing)
    # WHEN its time is over THEN the two others are counted and forgotten
    collector.reassembler.expire(1.0)
    assert not collector.expired
    collector.reassembler.expire(1.01)
    assert collector.expired == {1: 2}
    collector.reassembler.expire(9.0)
    assert collector.expired == {1: 2}


def test_a_flood_of_first_parts_costs_only_its_sender() -> None:
    # GIVEN one honest half of a pair, and a member that opens ten thousand pairs and finishes none
    collector = Collector(max_sets=8, expiry_s=1e9)
    first, second = parts_of(pair((1, 2, 3, 4)), double=False)
    assert collector.add(first, sender=2) is None
    for tick in range(TICK, TICK + 10_000):
        collector.add(first, sender=3, tick=tick)
    # THEN memory is bounded, and the honest pair is still completed
    assert collector.expired == {3: 9992}
    assert collector.add(second, sender=2) is not None
    collector.reassembler.expire(2e9)
    assert collector.expired == {3: 10_000}


def test_parts_that_contradict_each_other_are_refused() -> None:
    collector = Collector()
    first, second = parts_of(pair((1, 2, 3, 4)), double=False)
    collector.add(first)
    with pytest.raises(Rejected) as refused:
        collector.add(replace(second, rank=5))
    assert refused.value.reason is Reason.PART_MISMATCH
    with pytest.raises(Rejected) as refused:
        collector.add(first)
    assert refused.value.reason is Reason.DUPLICATE
    assert collector.add(second) is not None


def refused_content(content_of: bytes) -> Reason:
    """Why a pair of agents 1 and 2 in float32 with this content is refused."""
    body = struct.pack("<HHHH", 0, 1, 6, 2) + content_of
    part = decode_part(body, tick=TICK, agents=2, double=False, fleet_size=3)
    with pytest.raises(Rejected) as refused:
        Reassembler({1, 2, 3}, lambda sender, parts: None).add(1, TICK, ROUND, part, 0.0)
    return refused.value.reason


def content(ids: tuple[int, int], vector: np.ndarray, matrix: np.ndarray) -> bytes:
    numbers = np.concatenate((vector, matrix[np.triu_indices(12)])).astype("<f4")
    return np.asarray(ids, "<u2").tobytes() + numbers.tobytes()


def test_bad_pairs_are_refused_with_their_reason() -> None:
    good, zero = np.eye(12), np.zeros(12)
    nan = zero.copy()
    nan[3] = np.nan
    infinite, huge, indefinite, semidefinite = (good.copy() for _ in range(4))
    infinite[2, 2], huge[2, 2], semidefinite[2, 2] = np.inf, 1e30, 0.0
    indefinite[0, 1] = indefinite[1, 0] = 1.5
    assert refused_content(content((1, 2), nan, good)) is Reason.NOT_FINITE
    assert refused_content(content((1, 2), zero, infinite)) is Reason.NOT_FINITE
    assert refused_content(content((1, 2), zero, huge)) is Reason.OUT_OF_RANGE
    assert refused_content(content((1, 2), zero, indefinite)) is Reason.NOT_POSITIVE_DEFINITE
    assert refused_content(content((1, 2), zero, semidefinite)) is Reason.NOT_POSITIVE_DEFINITE
    assert refused_content(content((1, 2), zero, -good)) is Reason.NOT_POSITIVE_DEFINITE
    assert refused_content(content((1, 4), zero, good)) is Reason.UNKNOWN_AGENT
    assert refused_content(content((1, 1), zero, good)) is Reason.UNKNOWN_AGENT


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda body: body[:-1], Reason.WRONG_DIMENSION),
        (lambda body: body + b"\0", Reason.WRONG_DIMENSION),
        (lambda body: body[:7], Reason.MALFORMED),
        (lambda body: struct.pack("<H", 1) + body[2:], Reason.WRONG_DIMENSION),
        (lambda body: body[:2] + struct.pack("<H", 2) + body[4:], Reason.WRONG_DIMENSION),
        (lambda body: body[:4] + struct.pack("<H", 19) + body[6:], Reason.OUT_OF_RANGE),
        (lambda body: body[:6] + struct.pack("<H", TICK + 1) + body[8:], Reason.OUT_OF_RANGE),
    ],
)
def test_bad_parts_are_refused_before_their_numbers_are_looked_at(change, reason: Reason) -> None:
    (body,) = encode_information(pair((1, 2, 3)), double=False)
    with pytest.raises(Rejected) as refused:
        decode_part(change(body), tick=TICK, agents=3, double=False, fleet_size=3)
    assert refused.value.reason is reason


@pytest.mark.parametrize("agents", [0, 4, 60_000])
def test_a_pair_of_more_agents_than_the_fleet_has_is_refused(agents: int) -> None:
    (body,) = encode_information(pair((1, 2, 3)), double=False)
    with pytest.raises(Rejected) as refused:
        decode_part(body, tick=TICK, agents=agents, double=False, fleet_size=3)
    assert refused.value.reason is Reason.WRONG_DIMENSION


def test_no_bad_pair_is_sent() -> None:
    good = pair((1, 2))
    bad_matrix = good.information.copy()
    bad_matrix[0, 0] = np.nan
    for bad in (
        replace(good, information=bad_matrix),
        replace(good, information=-good.information),
        replace(good, vector=good.vector * np.inf),
        replace(good, vector=good.vector[:-1]),
        replace(good, information=good.information[:-1]),
        replace(good, agents=(1, 1)),
        replace(good, agents=()),
        replace(good, agents=(1, 1000)),
        replace(good, state_tick=TICK + 1),
        replace(good, rank=13),
    ):
        with pytest.raises(EncodeError, match="information"), np.errstate(invalid="ignore"):
            encode_information(bad, double=True)
