"""The round barrier in virtual time."""

from __future__ import annotations

import tracemalloc
from itertools import islice

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from transport.link.rounds import PacketOutcome, RoundBarrier


def barrier(rounds: int = 3) -> RoundBarrier[str]:
    made: RoundBarrier[str] = RoundBarrier(rounds)
    made.advance(10)
    return made


def test_a_round_ends_when_everybody_has_spoken() -> None:
    b = barrier()
    b.open(10, 0, {2, 3}, deadline_s=1.0)
    assert not b.done(0.0)
    assert b.put(3, 10, 0, "c") is PacketOutcome.KEPT
    assert not b.done(0.5)
    assert b.put(2, 10, 0, "b") is PacketOutcome.KEPT
    assert b.done(0.5)
    assert list(b.close().items()) == [(2, "b"), (3, "c")]


def test_a_round_ends_at_its_deadline_whatever_is_missing() -> None:
    b = barrier()
    b.open(10, 0, {2, 3}, deadline_s=1.0)
    b.put(2, 10, 0, "b")
    assert not b.done(0.999)
    assert b.done(1.0)
    assert b.close() == {2: "b"}


def test_nobody_to_wait_for() -> None:
    b = barrier()
    b.open(10, 0, (), deadline_s=1.0)
    assert b.done(0.0)
    assert b.close() == {}


def test_a_deadline_in_the_past_does_not_block() -> None:
    b = barrier()
    b.open(10, 0, {2}, deadline_s=-5.0)
    assert b.done(0.0)
    assert b.close() == {}


def test_packets_may_come_before_their_round() -> None:
    b = barrier()
    assert b.put(2, 10, 1, "early") is PacketOutcome.KEPT
    assert b.put(2, 12, 0, "next") is PacketOutcome.KEPT
    b.open(10, 0, {2}, 1.0)
    assert not b.complete()
    b.close()
    b.open(10, 1, {2}, 2.0)
    assert b.complete()
    assert b.close() == {2: "early"}
    b.open(12, 0, {2}, 3.0)
    assert b.close() == {2: "next"}


def test_late_duplicate_and_wild_packets_are_told_apart_and_not_used() -> None:
    b = barrier(rounds=2)
    b.open(10, 0, {2, 3}, 1.0)
    b.put(2, 10, 0, "first")
    assert b.put(2, 10, 0, "second") is PacketOutcome.DUPLICATE
    assert b.close() == {2: "first"}
    assert b.put(3, 10, 0, "late") is PacketOutcome.LATE
    assert b.put(3, 9, 1, "older") is PacketOutcome.LATE
    assert b.put(3, 13, 0, "far ahead") is PacketOutcome.WILD
    assert b.put(3, 10, 2, "no such round") is PacketOutcome.WILD
    b.open(11, 0, {2, 3}, 1.0)
    assert b.close() == {}


def test_a_neighbour_that_is_gone_is_not_waited_for() -> None:
    b = barrier()
    b.open(10, 0, {2, 3}, 1.0)
    b.put(2, 10, 0, "b")
    b.forget(3)
    assert b.done(0.0)


def test_strangers_do_not_end_a_round_and_are_not_handed_out() -> None:
    b = barrier()
    b.open(10, 0, {2}, 1.0)
    b.put(7, 10, 0, "stranger")
    assert not b.done(0.0)
    assert b.close() == {}


def test_rounds_only_go_forward() -> None:
    b = barrier(rounds=2)
    b.open(10, 1, (), 1.0)
    with pytest.raises(ValueError, match="still open"):
        b.advance(11)
    b.close()
    with pytest.raises(ValueError, match="no round is open"):
        b.close()
    for tick, round_ in ((10, 1), (10, 0), (9, 0), (11, 2), (11, -1)):
        with pytest.raises(ValueError, match="cannot be opened"):
            b.open(tick, round_, (), 1.0)


def test_skipped_ticks_leave_nothing_behind() -> None:
    # GIVEN a neighbour that goes on sending while we open no round for a thousand ticks
    b: RoundBarrier[bytearray] = RoundBarrier(3)
    tracemalloc.start()
    try:
        for tick in range(11, 1011):
            b.advance(tick)
            for round_ in range(3):
                assert b.put(2, tick, round_, bytearray(10_000)) is PacketOutcome.KEPT
        # THEN no more is held than what may still be asked for
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()
    b.open(1010, 0, {2}, 0.0)
    assert b.complete()


@settings(max_examples=200)
@given(st.lists(st.tuples(st.integers(2, 5), st.integers(8, 14), st.integers(-1, 3)), max_size=80))
def test_whatever_comes_every_packet_kept_is_handed_out_once(packets: list[tuple[int, int, int]]) -> None:
    b: RoundBarrier[tuple[int, int, int]] = RoundBarrier(2)
    b.advance(10)
    kept: list[tuple[int, int, int]] = []
    handed_out: list[tuple[int, int, int]] = []
    feed = iter(packets)
    for tick in (10, 11, 12):
        for round_ in range(2):
            b.open(tick, round_, {2, 3, 4, 5}, deadline_s=tick + round_ / 2)
            kept += [packet for packet in islice(feed, 8) if b.put(*packet, packet) is PacketOutcome.KEPT]
            assert b.done(tick + round_ / 2)
            got = b.close()
            assert all(packet == (sender, tick, round_) for sender, packet in got.items())
            handed_out += got.values()
    # all rounds up to tick 12 were opened, and nobody was refused a place for later ones
    assert sorted(handed_out) == sorted(packet for packet in kept if packet[1] <= 12)
    assert len(set(kept)) == len(kept)
    assert all(10 <= tick <= 14 and 0 <= round_ < 2 for _, tick, round_ in kept)
