"""Fixes of which it is not known when they were taken."""

from __future__ import annotations

import pytest

from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.latency_doubt import FixTiming, LatencyMonitor


@pytest.mark.parametrize(
    ("speed_mps", "sigma_s", "found"), [(0.0, 0.1, False), (9.9, 0.1, False), (10.1, 0.1, True), (30.0, 0.01, False)]
)
def test_the_latency_is_doubted_where_it_moves_a_fix_by_more_than_the_fix_errs(
    speed_mps: float, sigma_s: float, found: bool
) -> None:
    expected = Finding(What.LATENCY, Gravity.NOTED, value=speed_mps * sigma_s, limit=1.0)
    assert LatencyMonitor().observe(FixTiming(sigma_s, speed_mps, 1.0, False)) == ((expected,) if found else ())


def test_a_refused_fix_is_noted() -> None:
    (finding,) = LatencyMonitor().observe(FixTiming(0.0, 0.0, 1.0, refused=True))
    assert (finding.what, finding.gravity) == (What.FIX_REFUSED, Gravity.NOTED)
