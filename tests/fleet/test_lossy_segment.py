"""Daemons on a segment that really loses and delays frames: warm, and cold, when the first handshakes are lost too.

The long runs, link by link, are `tests.fleet.measure_links`; docs/links.md has their figures.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from agent.config.reading import load_config
from fleetloc.report.fleet_results import FleetResults, load_results
from fleetloc.run.lockstep_run import fly_in_lockstep
from tests.support.fleet_process import until
from tests.support.lossnet.delivery import Delivery, delivery, heard_so_far
from tests.support.lossnet.flight import LossyFlight, why_not
from tests.support.machine import Witness, check_on_time, witnessed
from tests.support.own_error import SMOOTH_PATHS, own_nees, own_position_complaints

ROOT = Path(__file__).parents[2]
LINE3 = ROOT / "configs" / "line3.toml"
LOSSY_RADIO = ROOT / "configs" / "links" / "lossy_radio.toml"
OVERRIDES = ["fleet.edges=[[1,2],[1,3],[2,3]]", *SMOOTH_PATHS]
"""Everybody a neighbour of everybody, on paths on which a covariance should be right."""
LOSS, DELAY_S = 0.3, 0.05
FLIGHT_S = 8.0
MAX_SIGMA_FACTOR = 1.25

pytestmark = [
    pytest.mark.slow,
    pytest.mark.realtime,
    pytest.mark.skipif(why_not() is not None, reason=str(why_not())),
]


@dataclass(frozen=True)
class Flown:
    """One flight: what was delivered, subscriptions repeated, how late the machine was, and the estimates.

    ``sigma_m`` is the median of the own positions' 1-sigma per axis; ``off`` says whose were further off than that.
    """

    found: Delivery
    repeated: int
    results: FleetResults
    witness: Witness
    off: list[str]

    @property
    def sigma_m(self) -> float:
        return median_sigma_m(self.results)

    def net_age_s(self, percent: float) -> float:
        """Percentile of the packets' ages at arrival, without what the machine itself was late by on their way."""
        ages_s, sent_s = np.array(self.found.ages_s), np.array(self.found.sent_s)
        late_s = [self.witness.lost_s(sent, sent + age) for sent, age in zip(sent_s, ages_s, strict=True)]
        return float(np.percentile(ages_s - late_s, percent))


def median_sigma_m(results: FleetResults) -> float:
    """Of the ticks with an estimate, all agents' and axes' together."""
    return float(np.median(np.concatenate([track.own_sigma_m[track.known].ravel() for track in results.tracks])))


def everybody_met(flight: LossyFlight) -> bool:
    """Whether every daemon has heard every other one, by their flight logs."""
    return all(heard_so_far(flight.out, one) == set(flight.ids) - {one} for one in flight.ids)


def fly(out: Path, *, cold: bool) -> Flown:
    """Fly line3 once everybody has met: before the faults begin or, cold, under them."""
    with LossyFlight(LINE3, out, OVERRIDES, [LOSSY_RADIO]) as flight, witnessed(out) as witness:
        if cold:
            flight.set_faults(loss=LOSS, delay_s=DELAY_S)
        flight.start_daemons()
        until(lambda: everybody_met(flight), "daemons that have all met")
        if not cold:
            flight.set_faults(loss=LOSS, delay_s=DELAY_S)
        begin_s = time.time()
        flight.fly(FLIGHT_S)
        end_s = time.time()
        flight.report()
        repeated = sum(flight.counters(agent_id)["counters"]["subscriptions repeated"] for agent_id in flight.ids)
        pairs = list(permutations(flight.ids, 2))
    config = load_config(LINE3, OVERRIDES)
    results = load_results(config, out)
    start_s = results.start_unix_s
    squared = {
        agent_id: own_nees(config, out, agent_id, start_s, start_s + results.duration_s) for agent_id in config.ids
    }
    off = [line for agent_id, each in squared.items() for line in own_position_complaints(f"agent {agent_id}", each)]
    return Flown(delivery(out, pairs, begin_s, end_s), repeated, results, Witness(witness), off)


@pytest.fixture(scope="module")
def lossless_sigma_m(tmp_path_factory: pytest.TempPathFactory) -> float:
    """Of the same flight in virtual time without a loss."""
    out = tmp_path_factory.mktemp("lossless")
    config = load_config(LINE3, [*OVERRIDES, f"sim.duration_s={FLIGHT_S}"])
    fly_in_lockstep(config, out)
    return median_sigma_m(load_results(config, out))


def test_a_fleet_that_met_before_flies_through_a_radio_that_loses_a_third(
    tmp_path: Path, lossless_sigma_m: float
) -> None:
    # GIVEN links that are up WHEN 30 % of all frames are lost from then on and the rest is 50 ms late
    flown = fly(tmp_path, cold=False)
    found = flown.found
    # THEN every pair hears what one frame's chance leaves, and nothing waits for what was lost
    assert found.dead == 0
    assert min(found.share.values()) > 0.5
    assert found.mean == pytest.approx(1 - LOSS, abs=0.08)
    assert found.age_s(10) >= DELAY_S - 0.001
    assert flown.net_age_s(90) < 4 * DELAY_S
    # AND estimates are in time and as good as without a loss
    check_on_time(flown.results, flown.witness)
    assert flown.off == []
    assert flown.sigma_m <= MAX_SIGMA_FACTOR * lossless_sigma_m


def test_a_fleet_that_starts_under_loss_meets_all_the_same(tmp_path: Path, lossless_sigma_m: float) -> None:
    # GIVEN handshakes and declarations any of which may be lost
    flown = fly(tmp_path, cold=True)
    # THEN they were repeated until no pair was left that hears nothing
    assert flown.repeated > 0
    assert flown.found.dead == 0
    check_on_time(flown.results, flown.witness)
    assert flown.off == []
    assert flown.sigma_m <= MAX_SIGMA_FACTOR * lossless_sigma_m
