"""What is missing: fixes, IMU samples, neighbours."""

from __future__ import annotations

import math

import pytest

from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.staleness import Ages, StalenessMonitor
from estimators.integrity.thresholds import GPS_LOST_S, MIN_IMU_COVERAGE

TIMEOUT_S = 1.0


def observe(ages: Ages) -> tuple[Finding, ...]:
    return StalenessMonitor(TIMEOUT_S).observe(ages)


def test_what_is_fresh_is_not_found() -> None:
    assert observe(Ages(GPS_LOST_S, MIN_IMU_COVERAGE, {2: TIMEOUT_S, 3: 0.0})) == ()


@pytest.mark.parametrize("age_s", [None, 1.001 * GPS_LOST_S, 1e6])
def test_without_a_fix_of_late_there_is_no_gps(age_s: float | None) -> None:
    assert observe(Ages(age_s, 1.0)) == (Finding(What.NO_FIX, Gravity.DEGRADED, value=age_s, limit=GPS_LOST_S),)


@pytest.mark.parametrize(
    ("interval_s", "limit_s"),
    [(0.05, 0.7), (0.1, 0.7), (0.2, 0.8), (0.3, 1.2), (1.0, GPS_LOST_S), (None, GPS_LOST_S)],
)
def test_where_fixes_come_often_they_are_missed_earlier(interval_s: float | None, limit_s: float) -> None:
    assert observe(Ages(0.99 * limit_s, 1.0, fix_interval_s=interval_s)) == ()
    (finding,) = observe(Ages(1.01 * limit_s, 1.0, fix_interval_s=interval_s))
    assert (finding.what, finding.limit) == (What.NO_FIX, pytest.approx(limit_s))


def test_a_gap_of_the_imu_is_found_by_its_share_of_the_tick() -> None:
    assert observe(Ages(0.1, 0.89)) == (Finding(What.IMU_GAP, Gravity.DEGRADED, value=0.89, limit=MIN_IMU_COVERAGE),)


def test_each_silent_neighbour_is_named_with_its_silence() -> None:
    found = observe(Ages(0.1, 1.0, {2: 1.5, 3: 0.2, 7: math.inf}))
    assert [(finding.what, finding.about, finding.value) for finding in found] == [
        (What.SILENT, 2, 1.5),
        (What.SILENT, 7, math.inf),
    ]
    assert {finding.limit for finding in found} == {TIMEOUT_S}


def test_it_remembers_nothing() -> None:
    monitor = StalenessMonitor(TIMEOUT_S)
    assert monitor.observe(Ages(None, 0.0, {2: 9.0}))
    assert monitor.observe(Ages(0.0, 1.0, {2: 0.0})) == ()
