"""Injected faults: their statistics, their order, their repeatability."""

from __future__ import annotations

import math
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from transport.link.channel import Channel, ChannelSettings, LinkFaults, Outage

PERIOD_S = 0.01


def delivered(
    faults: LinkFaults, packets: int = 20_000, seed: int = 1, period_s: float = PERIOD_S
) -> list[tuple[int, float]]:
    """(number, delivery time) of packets sent one a period over one link, in order of delivery."""
    channel: Channel[int] = Channel({2: faults}, {2: np.random.default_rng(seed)})
    out: list[tuple[int, float]] = []
    for number in range(packets):
        channel.offer(2, number, number * period_s)
    while (due_s := channel.next_due()) is not None:
        out += [(number, due_s) for _, number in channel.due(due_s)]
    assert channel.lost[2] + len({number for number, _ in out}) == packets
    return out


def test_a_perfect_link_delivers_everything_at_once_and_in_order() -> None:
    assert delivered(LinkFaults(), 100) == [(i, i * PERIOD_S) for i in range(100)]


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.3, 0.9, 1.0])
def test_bernoulli_loss(loss: float) -> None:
    share = len(delivered(LinkFaults(loss=loss))) / 20_000
    assert share == pytest.approx(1 - loss, abs=4 * math.sqrt(loss * (1 - loss) / 20_000))


def test_bursts_have_the_length_and_share_of_gilbert_and_elliott() -> None:
    # GIVEN bursts that start with 2 % and end with 20 % per packet
    heard = {number for number, _ in delivered(LinkFaults(burst_start=0.02, burst_end=0.2))}
    lost = [number not in heard for number in range(20_000)]
    starts = sum(now and not before for before, now in zip([False, *lost], lost, strict=False))
    # THEN 0.02/(0.02+0.2) is lost, in runs of five on average (5 and 10 % are some four sigma)
    assert sum(lost) / 20_000 == pytest.approx(0.02 / 0.22, rel=0.2)
    assert sum(lost) / starts == pytest.approx(5.0, rel=0.15)


def test_delays_have_the_mean_that_was_asked_for() -> None:
    faults = LinkFaults(delay_s=0.05, delay_exponential_s=0.02, delay_uniform_s=0.04)
    delays = np.array([due_s - number * PERIOD_S for number, due_s in delivered(faults)])
    assert delays.min() >= 0.05
    assert delays.mean() == pytest.approx(0.05 + 0.02 + 0.02, abs=4 * 0.024 / math.sqrt(20_000))


def test_random_delays_reorder_unless_the_link_keeps_order() -> None:
    jitter = LinkFaults(delay_exponential_s=0.05)
    numbers = [number for number, _ in delivered(jitter, 1000)]
    assert numbers != sorted(numbers)
    stream = delivered(msgspec.structs.replace(jitter, in_order=True), 1000)
    assert [number for number, _ in stream] == list(range(1000))
    assert all(due_s >= number * PERIOD_S for number, due_s in stream)


def test_held_back_packets_are_overtaken() -> None:
    out = delivered(LinkFaults(reorder=0.1, reorder_delay_s=0.015), 10_000)
    overtaken = sum(a > b for (a, _), (b, _) in pairwise(out))
    assert overtaken == pytest.approx(1000 * 0.9, rel=0.15)


def test_duplicates_come_as_often_as_asked() -> None:
    assert len(delivered(LinkFaults(duplicate=0.25))) == pytest.approx(25_000, abs=4 * 61)


def test_a_copy_has_a_delay_of_its_own() -> None:
    out = delivered(LinkFaults(duplicate=1.0, delay_uniform_s=0.1), 2000)
    times: dict[int, list[float]] = {}
    for number, due_s in out:
        times.setdefault(number, []).append(due_s - number * PERIOD_S)
    # THEN it comes after the first as often as its own delay is the longer one, else right with it
    later = [copy > first for first, copy in times.values()]
    assert np.mean(later) == pytest.approx(0.5, abs=0.05)
    assert max(copy for _, copy in times.values()) <= 0.1


def test_an_outage_is_a_window_of_one_direction() -> None:
    # GIVEN agent 1 that does not hear agent 2 from 1 s to 2 s
    settings_1 = ChannelSettings(outages=(Outage(1.0, 2.0, (2,)),))
    into_1: Channel[float] = Channel.seeded(settings_1, seed=0, receiver=1, neighbours=[2, 3])
    into_2: Channel[float] = Channel.seeded(ChannelSettings(), seed=0, receiver=2, neighbours=[1])
    times = [0.0, 0.99, 1.0, 1.99, 2.0]
    for now in times:
        into_1.offer(2, now, now)
        into_1.offer(3, now, now)
        into_2.offer(1, now, now)
    # THEN the others are heard all the time
    heard = into_1.due(10.0)
    assert [now for neighbour, now in heard if neighbour == 2] == [0.0, 0.99, 2.0]
    assert [now for neighbour, now in heard if neighbour == 3] == times
    assert [now for _, now in into_2.due(10.0)] == times
    assert into_1.lost == {2: 2, 3: 0}


def test_an_outage_of_all_and_neighbours_with_faults_of_their_own() -> None:
    faults = ChannelSettings(outages=(Outage(0.0, 1.0),), per_neighbour={"3": LinkFaults(loss=0.0)})
    channel: Channel[str] = Channel.seeded(faults, seed=0, receiver=1, neighbours=[2, 3])
    channel.offer(2, "a", 0.5)
    channel.offer(3, "b", 0.5)
    assert channel.due(0.5) == [(3, "b")]


def test_nothing_is_due_before_its_time() -> None:
    channel: Channel[str] = Channel.seeded(ChannelSettings(delay_s=0.1), seed=0, receiver=1, neighbours=[2])
    assert channel.next_due() is None
    channel.offer(2, "a", 1.0)
    assert channel.next_due() == pytest.approx(1.1)
    assert channel.due(1.09) == []
    assert channel.due(1.11) == [(2, "a")]


@settings(max_examples=30)
@given(st.integers(0, 2**31), st.integers(1, 999), st.floats(0, 0.9))
def test_one_seed_one_fate(seed: int, receiver: int, loss: float) -> None:
    faults = ChannelSettings(loss=loss, delay_exponential_s=0.01, duplicate=0.1)

    def fate() -> list[tuple[int, int]]:
        channel: Channel[int] = Channel.seeded(faults, seed=seed, receiver=receiver, neighbours=[1, 2])
        for number in range(50):
            channel.offer(1 + number % 2, number, number * 0.01)
        return channel.due(1e9)

    assert fate() == fate()


def test_links_are_independent_of_each_other_and_of_other_settings() -> None:
    # GIVEN the same seed with and without a delay and with another neighbour in between
    def lost(settings_: ChannelSettings, neighbours: list[int]) -> set[int]:
        channel: Channel[int] = Channel.seeded(settings_, seed=5, receiver=1, neighbours=neighbours)
        for number in range(500):
            for neighbour in neighbours:
                channel.offer(neighbour, number, number * 0.01)
        return set(range(500)) - {number for neighbour, number in channel.due(1e9) if neighbour == 3}

    plain = lost(ChannelSettings(loss=0.3), [3])
    assert plain == lost(ChannelSettings(loss=0.3, delay_s=0.2, duplicate=0.5), [2, 3])
    assert plain < lost(ChannelSettings(loss=0.5), [3])


def test_the_two_directions_and_the_neighbours_lose_different_packets() -> None:
    def heard(receiver: int, neighbour: int) -> list[int]:
        settings_ = ChannelSettings(loss=0.5)
        channel: Channel[int] = Channel.seeded(settings_, seed=5, receiver=receiver, neighbours=[neighbour])
        for number in range(64):
            channel.offer(neighbour, number, 0.0)
        return [number for _, number in channel.due(0.0)]

    assert len({tuple(heard(*link)) for link in ((1, 2), (2, 1), (1, 3), (3, 2))}) == 4


def test_changed_faults_leave_what_is_under_way_and_the_draws_alone() -> None:
    # GIVEN two links of one seed, one of which is told of an outage half way
    faults = ChannelSettings(loss=0.3, delay_s=0.05)
    silent = msgspec.structs.replace(faults, outages=(Outage(5.0, 7.0),))
    plain: Channel[int] = Channel.seeded(faults, seed=3, receiver=1, neighbours=[2])
    changed: Channel[int] = Channel.seeded(faults, seed=3, receiver=1, neighbours=[2])
    for number in range(1000):
        now = number * 0.01
        if number == 500:
            changed.change(silent)
        plain.offer(2, number, now)
        changed.offer(2, number, now)
    # THEN both have the same fate but for the outage
    heard = {number for _, number in plain.due(99.0)}
    assert {number for _, number in changed.due(99.0)} == {n for n in heard if not 500 <= n < 700}
    assert plain.lost[2] < changed.lost[2]


@pytest.mark.parametrize(
    "table",
    [
        {"loss": 1.1},
        {"loss": -0.1},
        {"delay_s": -1.0},
        {"burst_end": 0.0},
        {"lost": 0.1},
        {"outages": [{"from_s": 2.0, "until_s": 1.0}]},
        {"per_neighbour": {"two": {"loss": 0.1}}},
    ],
)
def test_bad_settings_are_refused(table: dict[str, object]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(table, ChannelSettings)
