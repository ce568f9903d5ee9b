"""Is what is needed there: fixes, the IMU, and the neighbours that should be heard?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.thresholds import GPS_LOST_FIXES, GPS_LOST_LEAST_S, GPS_LOST_S, MIN_IMU_COVERAGE


@dataclass(frozen=True, slots=True)
class Ages:
    """How old is what an estimate lives on."""

    fix_age_s: float | None
    """Since the last own fix; ``None``: there was none."""
    imu_coverage: float
    """Share of the latest tick, 0..1, that the IMU vouches for."""
    heard_age_s: Mapping[int, float] = field(default_factory=dict)
    """Since each neighbour that should be heard was, by id; ``inf``: never."""
    aided: bool = True
    """Whether the attitude in the latest tick was that of an autopilot with positions."""
    fix_interval_s: float | None = None
    """Between the fixes, on average; ``None``: not known."""


class StalenessMonitor:
    """``neighbour_timeout_s``: a neighbour that is heard less often is silent."""

    def __init__(self, neighbour_timeout_s: float) -> None:
        self._neighbour_timeout_s = neighbour_timeout_s

    def observe(self, evidence: Ages) -> tuple[Finding, ...]:
        """A finding for each thing that is missing, one per silent neighbour in the order of the evidence."""
        found = []
        coverage, timeout_s = evidence.imu_coverage, self._neighbour_timeout_s
        if coverage < MIN_IMU_COVERAGE:
            found.append(Finding(What.IMU_GAP, Gravity.DEGRADED, value=coverage, limit=MIN_IMU_COVERAGE))
        if not evidence.aided:
            found.append(Finding(What.UNAIDED, Gravity.DEGRADED))
        limit_s = gps_lost_after_s(evidence.fix_interval_s)
        if gps_lost(evidence.fix_age_s, evidence.fix_interval_s):
            found.append(Finding(What.NO_FIX, Gravity.DEGRADED, value=evidence.fix_age_s, limit=limit_s))
        for agent, age_s in evidence.heard_age_s.items():
            if age_s > timeout_s:
                found.append(Finding(What.SILENT, Gravity.DEGRADED, agent, age_s, timeout_s))
        return tuple(found)


def gps_lost_after_s(fix_interval_s: float | None) -> float:
    """The age of the last fix from which on a drone has to do without GPS, by the interval between its fixes."""
    if fix_interval_s is None:
        return GPS_LOST_S
    return min(max(GPS_LOST_FIXES * fix_interval_s, GPS_LOST_LEAST_S), GPS_LOST_S)


def gps_lost(fix_age_s: float | None, fix_interval_s: float | None = None) -> bool:
    """Whether a drone has to do without GPS, by the time since its last fix (``None``: there was none)."""
    return fix_age_s is None or fix_age_s > gps_lost_after_s(fix_interval_s)
