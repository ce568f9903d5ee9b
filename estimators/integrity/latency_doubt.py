"""Is it known when the fixes were taken? A drone in motion is elsewhere by then.

The latency itself is estimated in `estimators.calibration.latency`; here is what its answer is worth for the fixes.
"""

from __future__ import annotations

from dataclasses import dataclass

from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.thresholds import LATENCY_SHARE


@dataclass(frozen=True, slots=True)
class FixTiming:
    """Of the latest fix."""

    latency_sigma_s: float
    """1-sigma of the latency that it was corrected by."""
    speed_mps: float
    sigma_m: float
    """1-sigma of its position as the receiver claims it, without the latency."""
    refused: bool
    """Whether the latency's filters found it where the drone cannot have been."""


class LatencyMonitor:
    """Without memory."""

    def observe(self, evidence: FixTiming) -> tuple[Finding, ...]:
        """Noted only: the covariance of the fix holds the latency's error already."""
        found = []
        along_m, limit_m = evidence.speed_mps * evidence.latency_sigma_s, LATENCY_SHARE * evidence.sigma_m
        if along_m > limit_m:
            found.append(Finding(What.LATENCY, Gravity.NOTED, value=along_m, limit=limit_m))
        if evidence.refused:
            found.append(Finding(What.FIX_REFUSED, Gravity.NOTED))
        return tuple(found)
