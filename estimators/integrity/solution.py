"""What an estimate says of itself: whether there is one, its status, and how sure it is of the own position."""

from __future__ import annotations

from dataclasses import dataclass

from estimators.estimator import Status
from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.thresholds import ALIGNED_SIGMA_M, DEGRADED_SIGMA_M, FAULT_SIGMA_M


@dataclass(frozen=True, slots=True)
class Solution:
    """Of a tick: the status (``None`` before the start) and the largest 1-sigma of the own position's axes."""

    status: Status | None
    own_sigma_m: float
    waiting_for: str = ""
    """What the start waits for, in words."""


class SolutionMonitor:
    """Remembers whether the estimate has been sure since its start: alignment is done once."""

    def __init__(self) -> None:
        self._aligned = False

    def observe(self, evidence: Solution) -> tuple[Finding, ...]:
        """Of an estimate that is not in use (yet), how it was made does not matter; whether it is observable does."""
        status, sigma_m = evidence.status, evidence.own_sigma_m
        if status is None:
            self._aligned = False
            return (Finding(What.NO_ESTIMATE, Gravity.ABSENT, detail=evidence.waiting_for),)
        unheld = (Finding(What.NOT_OBSERVABLE, Gravity.ALARM),) if status is Status.NOT_OBSERVABLE else ()
        if not self._aligned and sigma_m > ALIGNED_SIGMA_M:
            return (Finding(What.NOT_ALIGNED, Gravity.NOT_YET, value=sigma_m, limit=ALIGNED_SIGMA_M), *unheld)
        self._aligned = True
        if sigma_m > FAULT_SIGMA_M:
            return (Finding(What.UNKNOWN, Gravity.UNUSABLE, value=sigma_m, limit=FAULT_SIGMA_M), *unheld)
        found = []
        if status is Status.FELL_BACK:
            found.append(Finding(What.FELL_BACK, Gravity.DEGRADED))
        if status is Status.NO_DATA:
            found.append(Finding(What.NO_DATA, Gravity.DEGRADED))
        if sigma_m > DEGRADED_SIGMA_M:
            found.append(Finding(What.UNCERTAIN, Gravity.DEGRADED, value=sigma_m, limit=DEGRADED_SIGMA_M))
        return (*found, *unheld)
