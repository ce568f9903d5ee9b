"""What an estimate says of itself: there, aligned, in use, observable."""

from __future__ import annotations

import pytest

from estimators.estimator import Status
from estimators.integrity.finding import Gravity, What
from estimators.integrity.solution import Solution, SolutionMonitor
from estimators.integrity.thresholds import ALIGNED_SIGMA_M, DEGRADED_SIGMA_M, FAULT_SIGMA_M

BELOW, ABOVE = 0.999, 1.001


def whats(monitor: SolutionMonitor, status: Status | None, sigma_m: float) -> list[What]:
    return [finding.what for finding in monitor.observe(Solution(status, sigma_m))]


@pytest.fixture
def aligned() -> SolutionMonitor:
    monitor = SolutionMonitor()
    assert monitor.observe(Solution(Status.OK, 0.1)) == ()
    return monitor


def test_alignment_ends_once_and_begins_anew_only_without_an_estimate() -> None:
    monitor = SolutionMonitor()
    assert whats(monitor, Status.OK, ABOVE * ALIGNED_SIGMA_M) == [What.NOT_ALIGNED]
    assert whats(monitor, Status.OK, BELOW * ALIGNED_SIGMA_M) == []
    assert whats(monitor, Status.OK, ABOVE * ALIGNED_SIGMA_M) == []
    assert whats(monitor, None, 1e4) == [What.NO_ESTIMATE]
    assert whats(monitor, Status.OK, ABOVE * ALIGNED_SIGMA_M) == [What.NOT_ALIGNED]


@pytest.mark.parametrize(
    ("sigma_m", "expected"),
    [
        (BELOW * DEGRADED_SIGMA_M, []),
        (ABOVE * DEGRADED_SIGMA_M, [What.UNCERTAIN]),
        (BELOW * FAULT_SIGMA_M, [What.UNCERTAIN]),
        (ABOVE * FAULT_SIGMA_M, [What.UNKNOWN]),
    ],
)
def test_the_limits_of_the_own_sigma(aligned: SolutionMonitor, sigma_m: float, expected: list[What]) -> None:
    assert whats(aligned, Status.OK, sigma_m) == expected


def test_a_finding_says_the_figure_and_its_limit(aligned: SolutionMonitor) -> None:
    (finding,) = aligned.observe(Solution(Status.OK, 60.0))
    assert (finding.gravity, finding.value, finding.limit) == (Gravity.UNUSABLE, 60.0, FAULT_SIGMA_M)
    # and the position can be used again as soon as it is known again
    assert aligned.observe(Solution(Status.OK, 1.0)) == ()


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        (Status.OK, []),
        (Status.NOT_CONVERGED, []),
        (Status.FELL_BACK, [(What.FELL_BACK, Gravity.DEGRADED)]),
        (Status.NO_DATA, [(What.NO_DATA, Gravity.DEGRADED)]),
        (Status.NOT_OBSERVABLE, [(What.NOT_OBSERVABLE, Gravity.ALARM)]),
    ],
)
def test_what_follows_from_the_status(
    aligned: SolutionMonitor, status: Status, expected: list[tuple[What, Gravity]]
) -> None:
    assert [(finding.what, finding.gravity) for finding in aligned.observe(Solution(status, 0.1))] == expected


def test_how_an_estimate_was_made_is_told_of_one_in_use_and_its_observability_always() -> None:
    assert whats(SolutionMonitor(), Status.NO_DATA, 30.0) == [What.NOT_ALIGNED]
    assert whats(SolutionMonitor(), Status.NOT_OBSERVABLE, 30.0) == [What.NOT_ALIGNED, What.NOT_OBSERVABLE]


def test_a_start_says_what_it_waits_for() -> None:
    (finding,) = SolutionMonitor().observe(Solution(None, 1e4, "waiting for fixes"))
    assert (finding.gravity, finding.detail) == (Gravity.ABSENT, "waiting for fixes")
