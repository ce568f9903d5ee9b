"""Counters of neighbours, and the filter of their clocks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from transport.errors import Reason
from transport.link.peers import ClockFilter, Peer, PeerTable
from transport.messages.clock_body import ClockAnswer
from transport.messages.header import Header, PacketKind


def header(seq: int, *, kind: PacketKind = PacketKind.MEAS, boot: int = 1, sender: int = 2) -> Header:
    return Header(kind, sender, boot, seq, 0, 0, 0, 0, 0, 0)


def test_a_neighbour_never_heard() -> None:
    peer = Peer()
    assert peer.age_s(5.0) is None
    assert peer.as_dict(5.0) == {"received": 0, "lost": 0, "restarts": 0, "rejected": 0}


def test_gaps_in_the_numbers_are_losses() -> None:
    peer = Peer()
    for seq in (10, 11, 14):
        peer.accepted(header(seq), now=seq * 0.1)
    assert (peer.received, peer.lost) == (3, 2)
    assert peer.age_s(2.0) == pytest.approx(0.6)
    # a packet that was only late is no loss
    peer.accepted(header(12), now=2.0)
    assert (peer.received, peer.lost) == (4, 1)


def test_kinds_are_numbered_each_for_itself() -> None:
    peer = Peer()
    for seq in (1, 2, 3):
        peer.accepted(header(seq), 0.0)
        peer.accepted(header(10 * seq, kind=PacketKind.INFO), 0.0)
    assert peer.lost == 18


def test_a_restart_begins_new_numbers_and_keeps_the_count() -> None:
    peer = Peer()
    for seq, boot in ((5, 1), (8, 1), (1, 2), (2, 2)):
        peer.accepted(header(seq, boot=boot), 0.0)
    assert (peer.lost, peer.restarts, peer.received) == (2, 1, 4)


@given(st.lists(st.integers(0, 60), min_size=1, unique=True), st.randoms(use_true_random=False))
def test_losses_do_not_depend_on_the_order_of_arrival(numbers: list[int], shuffler) -> None:
    shuffled = list(numbers)
    shuffler.shuffle(shuffled)
    peer = Peer()
    for seq in shuffled:
        peer.accepted(header(seq), 0.0)
    assert peer.lost == max(numbers) - min(numbers) + 1 - len(numbers)


def test_the_table_attributes_what_it_can() -> None:
    table = PeerTable([3, 2])
    table.accepted(header(1), now=1.0)
    table.rejected(2, Reason.REPLAY)
    table.rejected(3, Reason.REPLAY, 2)
    table.rejected(9, Reason.UNKNOWN_SENDER)
    table.rejected(None, Reason.WRONG_KEY)
    assert [agent_id for agent_id, _ in table.items()] == [2, 3]
    assert 2 in table
    assert 9 not in table
    assert table.rejections() == {"wrong_key": 1, "unknown_sender": 1, "replay": 3}
    assert table.unattributed.total == 2


def answers(offset_s: float, count: int, seed: int = 0) -> list[tuple[ClockAnswer, int]]:
    """Questions once a second over a link with 1 ms each way and queues of 5 ms on average on top."""
    rng = np.random.default_rng(seed)
    out = []
    for i in range(count):
        asked, there, away, back = i * 1.0, 0.001 + rng.exponential(0.005), 2e-4, 0.001 + rng.exponential(0.005)
        received = asked + there + offset_s
        ns = [round(t * 1e9) for t in (asked, received, received + away, asked + there + away + back)]
        out.append((ClockAnswer(ns[0], ns[1], ns[2]), ns[3]))
    return out


def test_a_symmetric_exchange_gives_the_exact_offset() -> None:
    clock = ClockFilter()
    assert clock.offset_s is None
    assert clock.round_trip_s is None
    clock.add(ClockAnswer(1_000, 8_000, 9_000), 5_000)  # 1.5 us each way, 5.5 us ahead
    assert clock.offset_s == pytest.approx(5.5e-6)
    assert clock.round_trip_s == pytest.approx(3e-6)


@pytest.mark.parametrize("offset_s", [-3600.0, 0.0, 0.02])
def test_queues_hardly_disturb_the_offset(offset_s: float) -> None:
    errors_filtered, errors_plain = [], []
    for seed in range(30):
        clock = ClockFilter()
        plain = []
        for answer, returned_ns in answers(offset_s, 30, seed):
            clock.add(answer, returned_ns)
            single = ClockFilter()
            single.add(answer, returned_ns)
            plain.append(single.offset_s)
        assert clock.offset_s is not None
        errors_filtered.append(clock.offset_s - offset_s)
        errors_plain.append(plain[-1] - offset_s)
    # THEN well under the queues, and much better than a single question
    assert np.std(errors_filtered) < 0.0008
    assert np.std(errors_filtered) < 0.3 * np.std(errors_plain)


def test_the_filter_follows_a_stepped_clock_and_ignores_the_impossible() -> None:
    clock = ClockFilter()
    for answer, returned_ns in answers(0.0, 30) + answers(5.0, 30):
        clock.add(answer, returned_ns)
    assert clock.offset_s == pytest.approx(5.0, abs=0.003)
    before = clock.offset_s
    clock.add(ClockAnswer(10_000, 0, 0), 5_000)
    assert clock.offset_s == before
