"""Daemons on a segment that really loses and delays frames: warm, and cold, when the first handshakes are lost too.

The long runs, link by link, are `tests.fleet.measure_links`; docs/links.md has their figures.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.config.reading import load_config
from fleetloc.report.fleet_report import report_figures
from fleetloc.report.fleet_results import FleetResults, load_results
from fleetloc.run.lockstep_run import fly_in_lockstep
from tests.support.lossnet.delivery import Delivery, delivery, heard_so_far
from tests.support.lossnet.flight import LossyFlight, why_not
from tests.support.machine import Witness, check_on_time, witnessed

ROOT = Path(__file__).parents[2]
LINE3 = ROOT / "configs" / "line3.toml"
LOSSY_RADIO = ROOT / "configs" / "links" / "lossy_radio.toml"
ALL_PAIRS = "fleet.edges=[[1,2],[1,3],[2,3]]"
LOSS, DELAY_S = 0.3, 0.05
WARM_S, COLD_S = 8.0, 15.0
"""A cold link comes up when all four datagrams of a handshake get through: every fourth try, two tries in 3 s."""
PATIENCE_S, POLL_S = 60.0, 0.2

pytestmark = [
    pytest.mark.slow,
    pytest.mark.realtime,
    pytest.mark.skipif(why_not() is not None, reason=str(why_not())),
]


@dataclass(frozen=True)
class Flown:
    """One flight: its report, what was delivered, subscriptions repeated, and how late the machine was."""

    fleet: dict[str, Any]
    found: Delivery
    repeated: int
    results: FleetResults
    witness: Witness

    def net_age_s(self, percent: float) -> float:
        """Percentile of the packets' ages at arrival, without what the machine itself was late by on their way."""
        ages_s, sent_s = np.array(self.found.ages_s), np.array(self.found.sent_s)
        late_s = [self.witness.lost_s(sent, sent + age) for sent, age in zip(sent_s, ages_s, strict=True)]
        return float(np.percentile(ages_s - late_s, percent))


def wait_until_met(flight: LossyFlight) -> None:
    """Until every daemon has heard every other one, by their flight logs."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not all(heard_so_far(flight.out, one) == set(flight.ids) - {one} for one in flight.ids):
        assert time.monotonic() < deadline_s, "daemons on a clean segment do not meet"
        time.sleep(POLL_S)


def fly(out: Path, *, cold: bool, duration_s: float) -> Flown:
    """Fly line3, everybody a neighbour of everybody."""
    with LossyFlight(LINE3, out, [ALL_PAIRS], [LOSSY_RADIO]) as flight, witnessed(out) as witness:
        if cold:
            flight.set_faults(loss=LOSS, delay_s=DELAY_S)
        flight.start_daemons()
        if not cold:
            wait_until_met(flight)
            flight.set_faults(loss=LOSS, delay_s=DELAY_S)
        begin_s = time.time()
        flight.fly(duration_s)
        end_s = time.time()
        report = flight.report()
        repeated = sum(flight.counters(agent_id)["counters"]["subscriptions repeated"] for agent_id in flight.ids)
        pairs = list(permutations(flight.ids, 2))
    results = load_results(load_config(LINE3, [ALL_PAIRS]), out)
    return Flown(report["fleet"], delivery(out, pairs, begin_s, end_s), repeated, results, Witness(witness))


@pytest.fixture(scope="module")
def lossless_rmse_m(tmp_path_factory: pytest.TempPathFactory) -> float:
    """Of the same flight in virtual time without a loss."""
    out = tmp_path_factory.mktemp("lossless")
    config = load_config(LINE3, [ALL_PAIRS, f"sim.duration_s={WARM_S}"])
    outcome = fly_in_lockstep(config, out)
    rmse_m: float = report_figures(config, load_results(config, out), out, outcome, "lockstep")["fleet"][
        "position_rmse_m"
    ]
    return rmse_m


def test_a_fleet_that_met_before_flies_through_a_radio_that_loses_a_third(
    tmp_path: Path, lossless_rmse_m: float
) -> None:
    # GIVEN links that are up WHEN 30 % of all frames are lost from then on and the rest is 50 ms late
    flown = fly(tmp_path, cold=False, duration_s=WARM_S)
    found = flown.found
    # THEN every pair hears what one frame's chance leaves, and nothing waits for what was lost
    assert found.dead == 0
    assert min(found.share.values()) > 0.5
    assert found.mean == pytest.approx(1 - LOSS, abs=0.08)
    assert found.age_s(10) >= DELAY_S - 0.001
    assert flown.net_age_s(90) < 4 * DELAY_S
    # AND estimates are in time and as good as without a loss
    check_on_time(flown.results, flown.witness)
    assert flown.fleet["position_rmse_m"] <= 1.5 * lossless_rmse_m


def test_a_fleet_that_starts_under_loss_meets_all_the_same(tmp_path: Path, lossless_rmse_m: float) -> None:
    # GIVEN handshakes and declarations any of which may be lost
    flown = fly(tmp_path, cold=True, duration_s=COLD_S)
    # THEN they were repeated until no pair was left that hears nothing
    assert flown.repeated > 0
    assert flown.found.dead == 0
    check_on_time(flown.results, flown.witness)
    assert flown.fleet["position_rmse_m"] <= 1.5 * lossless_rmse_m
