"""What a drone states of a target: whether its place is known, apart from whether the drone's own is."""

from __future__ import annotations

from enum import StrEnum

from estimators.integrity.thresholds import DEGRADED_SIGMA_M, TARGET_UNSEEN_S


class TargetState(StrEnum):
    """What the place of a target may be used for, the best first."""

    KNOWN = "known"
    UNSEEN = "not seen"
    """Where it was when it was measured last, or would be by now; the covariance has grown since."""
    POOR = "poor"
    """The covariance says that its place is of little use."""
    NOT_OBSERVABLE = "not observable"
    """What was measured does not say where it is, whatever the covariance says."""
    NOT_FOUND = "not found"
    """No part of the estimate."""


def target_state(sigma_m: float, unseen_s: float, *, observable: bool = True) -> TargetState:
    """Of a target in an estimate.

    ``sigma_m``: the largest 1-sigma of the axes of its position; ``unseen_s``: since it was measured last.
    ``observable``: whether the data tell its place.
    """
    if not observable:
        return TargetState.NOT_OBSERVABLE
    if sigma_m > DEGRADED_SIGMA_M:
        return TargetState.POOR
    return TargetState.UNSEEN if unseen_s > TARGET_UNSEEN_S else TargetState.KNOWN
