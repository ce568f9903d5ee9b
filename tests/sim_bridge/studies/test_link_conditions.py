"""Link conditions of the studies."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.settings import EstimatorSettings
from sim_bridge.studies.link_conditions import (
    with_bursts,
    with_delay,
    with_duplicates,
    with_fu_channel,
    with_loss,
    with_one_way,
    with_partition,
)
from sim_bridge.studies.lockstep import run_lockstep
from sim_bridge.studies.relay import RecordRelay
from sim_bridge.studies.study_scenario import Scenario

RECORDING = Scenario("K5", samples=2000).record(0, 0)
SETTINGS = EstimatorSettings(kind="dmhe_shared", window=4, rounds=2, share_inputs="fleet", relay_hops=2)
SIGMA = 4.0 / np.sqrt(RECORDING.received.size)
"""Four standard deviations of a share of all packets, at most."""


def test_bernoulli_loss_has_its_probability_and_repeats_by_seed() -> None:
    one = with_loss(RECORDING, 0.3, np.random.default_rng(1))
    assert one.received.mean() == pytest.approx(0.7, abs=SIGMA)
    assert (one.received == with_loss(RECORDING, 0.3, np.random.default_rng(1)).received).all()
    assert RECORDING.received.all()


def test_bursts_have_their_share_and_their_length() -> None:
    lost = ~with_bursts(RECORDING, 0.2, 5.0, np.random.default_rng(2)).received
    assert lost.mean() == pytest.approx(0.2, abs=10 * SIGMA)  # neighbouring ticks are not independent
    begins = lost[1:] & ~lost[:-1]
    assert lost[1:].sum() / begins.sum() == pytest.approx(5.0, rel=0.1)


def test_delays() -> None:
    assert (with_delay(RECORDING, 2).delay_ticks == 2).all()
    spread = with_delay(RECORDING, 1, 3, np.random.default_rng(3)).delay_ticks
    assert set(np.unique(spread)) == {1, 2, 3, 4}


def test_the_fu_channel() -> None:
    fu = with_fu_channel(RECORDING, np.random.default_rng(4))
    on_time = fu.received & (fu.delay_ticks == 0)
    late = fu.received & (fu.delay_ticks == 1)
    assert on_time.mean() == pytest.approx(0.4, abs=SIGMA)
    assert late.mean() == pytest.approx(0.3, abs=SIGMA)
    assert (on_time | late | ~fu.received).all()


def test_a_partition_cuts_both_ways_and_heals() -> None:
    cut = with_partition(RECORDING, (0, 1), 10, 20).received
    assert not cut[10:20, 0, 2].any()
    assert not cut[10:20, 2, 0].any()
    assert cut[10:20, 0, 1].all()
    assert cut[10:20, 2, 4].all()
    assert cut[:10].all()
    assert cut[20:].all()


def test_a_one_way_link() -> None:
    one_way = with_one_way(RECORDING, 0, 1).received
    assert not one_way[:, 0, 1].any()
    assert one_way[:, 1, 0].all()


def test_duplicates_have_their_share_and_are_not_used_twice() -> None:
    doubled = with_duplicates(RECORDING, 0.4, np.random.default_rng(8))
    assert doubled.doubled.mean() == pytest.approx(0.4, abs=SIGMA)
    # GIVEN the same flight over links that lose, with and without second copies
    lossy = with_loss(Scenario(samples=14).record(0, 0), 0.3, np.random.default_rng(1))
    twice = with_duplicates(lossy, 0.6, np.random.default_rng(2))
    relay = RecordRelay(twice, SETTINGS)
    arrived = [(each.slot, each.tick) for tick in range(15) for each in relay.exchange(tick)[1]]
    assert len(arrived) > len(set(arrived))  # they do reach the estimator
    # THEN the estimates are the same, bit by bit
    for settings in (SETTINGS, EstimatorSettings()):
        one, other = run_lockstep(lossy, settings), run_lockstep(twice, settings)
        np.testing.assert_array_equal(one.mean, other.mean)
        np.testing.assert_array_equal(one.cov_diag, other.cov_diag)


def test_a_partition_may_cut_ranges_too() -> None:
    parted = with_partition(RECORDING, (0, 1), 5, 9, ranges=True)
    assert np.isnan(parted.ranges[5:9, 0, 2]).all()
    assert np.isnan(parted.ranges[5:9, 4, 1]).all()
    for ticks, pair in ((slice(5, 9), (0, 1)), (slice(5, 9), (3, 2)), (slice(9, 12), (0, 2))):
        np.testing.assert_array_equal(parted.ranges[ticks, *pair], RECORDING.ranges[ticks, *pair])
    kept = with_partition(RECORDING, (0, 1), 5, 9)
    np.testing.assert_array_equal(kept.ranges, RECORDING.ranges)
