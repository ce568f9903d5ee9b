"""Can a place that was found by ranges alone be taken for where the drone is?"""

from __future__ import annotations

from dataclasses import dataclass

from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.thresholds import HELD_SIGMA_M


@dataclass(frozen=True, slots=True)
class RangeLocation:
    """What a search over all places found (`estimators.model.multilateration`)."""

    fits: bool
    """Whether the best place explains the ranges."""
    rivals: int
    """Other places that the ranges do not rule out."""
    sigma_m: float
    """1-sigma of the best place along its worst direction."""


class RangeLocationMonitor:
    """Without memory; a place has to be known to ``limit_m``."""

    def __init__(self, limit_m: float = HELD_SIGMA_M) -> None:
        self._limit_m = limit_m

    def observe(self, evidence: RangeLocation) -> tuple[Finding, ...]:
        """Nothing if the place can be taken; the rivals of a place that does not fit say nothing."""
        if not evidence.fits:
            return (Finding(What.CONTRADICTORY, Gravity.NOTED),)
        found = []
        if evidence.rivals:
            found.append(Finding(What.AMBIGUOUS, Gravity.ALARM, value=evidence.rivals, limit=0))
        if evidence.sigma_m > self._limit_m:
            found.append(Finding(What.UNCERTAIN, Gravity.NOTED, value=evidence.sigma_m, limit=self._limit_m))
        return tuple(found)
