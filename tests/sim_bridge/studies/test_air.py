"""The radio of a study: each condition does to packets what it is called."""

from __future__ import annotations

import numpy as np
import pytest

from sim_bridge.studies.air import Air, bursty, channel_seed, fu_channel, lossy
from sim_bridge.virtual.virtual_fleet import Parcel

AGENTS = (1, 2, 3)
PERIOD_S = 0.1
START_S = 100.0
PACKETS = 4000
SIGMA = 4.0 / np.sqrt(PACKETS)
"""Four standard deviations of a share of all packets, at most."""


def arrivals(air: Air, receiver: int = 0, sender: int = 1, *, seed: int = 1, from_tick: int = 0) -> list[list[float]]:
    """For each of many packets, a tick apart, how many ticks late its copies arrive."""
    channel = air.channel(receiver, AGENTS, PERIOD_S, START_S, seed)
    late: list[list[float]] = [[] for _ in range(PACKETS)]
    for number in range(PACKETS):
        now_s = START_S + (from_tick + number + 1.0) * PERIOD_S
        channel.offer(AGENTS[sender], Parcel(AGENTS[sender], str(number), b"", now_s), now_s)
        while (due_s := channel.next_due()) is not None:
            for _, parcel in channel.due(due_s):
                late[int(parcel.key)].append((due_s - parcel.arrived_s) / PERIOD_S)
    return late


def lost(found: list[list[float]]) -> np.ndarray:
    return np.array([not each for each in found])


def test_whole_links_bring_everything_at_once() -> None:
    assert arrivals(Air()) == [[0.0]] * PACKETS


def test_bernoulli_loss_has_its_probability_and_repeats_by_seed() -> None:
    one = lost(arrivals(lossy(0.3)))
    assert one.mean() == pytest.approx(0.3, abs=SIGMA)
    assert (one == lost(arrivals(lossy(0.3)))).all()
    assert (one != lost(arrivals(lossy(0.3), seed=2))).any()
    assert (one != lost(arrivals(lossy(0.3), sender=2))).any()  # each link draws for itself


def test_bursts_have_their_share_and_their_length() -> None:
    found = lost(arrivals(bursty(0.2, 5.0)))
    assert found.mean() == pytest.approx(0.2, abs=4 * SIGMA)  # neighbouring packets are not independent
    begins = found[1:] & ~found[:-1]
    assert found[1:].sum() / begins.sum() == pytest.approx(5.0, rel=0.2)


def test_delays_are_in_ticks() -> None:
    late = np.array(arrivals(Air(delay_ticks=2.0, spread_ticks=3.0)))
    assert late.min() >= 2.0
    assert late.max() <= 5.0
    assert late.mean() == pytest.approx(3.5, abs=3 * SIGMA)


def test_the_fu_channel() -> None:
    found = arrivals(fu_channel())
    assert lost(found).mean() == pytest.approx(0.3, abs=SIGMA)
    late = np.array([each[0] for each in found if each])
    assert set(np.unique(np.round(late, 6))) == {0.0, 1.0}
    assert (late > 0.5).mean() == pytest.approx(3 / 7, abs=2 * SIGMA)


def test_a_one_way_link() -> None:
    air = Air(deaf=((0, 1),))
    assert lost(arrivals(air, 0, 1)).all()
    assert not lost(arrivals(air, 1, 0)).any()
    assert not lost(arrivals(air, 0, 2)).any()


def test_a_partition_cuts_both_ways_for_the_packets_of_its_ticks_and_heals() -> None:
    air = Air(cut=((0, 1), 10, 20))
    for receiver, sender in ((0, 2), (2, 1)):
        found = lost(arrivals(air, receiver, sender))
        assert not found[:10].any()
        assert found[10:20].all()
        assert not found[20:].any()
    assert not lost(arrivals(air, 0, 1)).any()


def test_a_channel_seed_is_of_seed_and_run() -> None:
    assert channel_seed(1, 2) == channel_seed(1, 2)
    assert len({channel_seed(seed, run) for seed in range(4) for run in range(4)}) == 16
