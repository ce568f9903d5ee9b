"""All monitors of a drone together: what is found in a tick, in the order in which it is told."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agent.watch.position_watch import PositionWatch, TickEvidence, clock_finding
from estimators.estimator import Status
from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.latency_doubt import FixTiming
from estimators.integrity.range_geometry import RangeGeometry
from estimators.integrity.solution import Solution
from estimators.integrity.staleness import Ages

WELL = Solution(Status.OK, 0.1)
FRESH = Ages(0.2, 1.0, {2: 0.1, 3: 0.1})
TWO_RANGED = RangeGeometry.of(np.zeros(3), 9.0 * np.eye(3)[:2], np.zeros(2))
AROUND = RangeGeometry.of(np.zeros(3), 9.0 * np.eye(3), np.zeros(3))


def found(evidence: TickEvidence) -> list[What]:
    return [finding.what for finding in PositionWatch(1.0).observe(evidence)]


def test_of_a_drone_that_is_well_nothing_is_found() -> None:
    assert found(TickEvidence(WELL, FRESH, "connected")) == []
    assert found(TickEvidence(WELL, FRESH, "connected", AROUND)) == []


def test_everything_that_is_wrong_is_found_at_once_in_the_order_of_telling() -> None:
    evidence = TickEvidence(
        Solution(Status.NOT_OBSERVABLE, 6.0),
        Ages(None, 0.5, {2: math.inf, 3: 0.1}),
        "lost",
        TWO_RANGED,
        (Finding(What.AMBIGUOUS, Gravity.ALARM, value=1, limit=0),),
        FixTiming(latency_sigma_s=0.1, speed_mps=20.0, sigma_m=1.0, refused=True),
    )
    watch = PositionWatch(1.0)
    watch.observe(TickEvidence(WELL, FRESH, "connected"))  # aligned
    assert [finding.what for finding in watch.observe(evidence)] == [
        What.UNCERTAIN,
        What.AMBIGUOUS,
        What.TOO_FEW_RANGED,
        What.NOT_OBSERVABLE,
        What.AUTOPILOT,
        What.IMU_GAP,
        What.NO_FIX,
        What.SILENT,
        What.LATENCY,
        What.FIX_REFUSED,
    ]


@pytest.mark.parametrize("state", ["searching", "lost"])
def test_a_link_that_is_not_there_is_named_by_its_state(state: str) -> None:
    (finding,) = PositionWatch(1.0).observe(TickEvidence(WELL, FRESH, state))
    assert (finding.what, finding.gravity, finding.detail) == (What.AUTOPILOT, Gravity.DEGRADED, state)


def test_a_clock_outside_the_fleets_time_is_a_finding_and_a_right_one_none() -> None:
    assert clock_finding(None) == ()
    (finding,) = clock_finding("clock at 2001-09-09, outside the fleet's time")
    assert (finding.what, finding.gravity) == (What.CLOCK, Gravity.DEGRADED)
    assert finding.detail.startswith("clock at 2001")
