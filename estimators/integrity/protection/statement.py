"""What an agent states of its position at every estimate: ellipse, protection levels, state and reason."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.protection.levels import ErrorEllipse, ProtectionLevel
from estimators.integrity.protection.targets import TargetState
from estimators.integrity.thresholds import FEWEST_RECEIVERS
from estimators.model.measurements import Vector

ALIKE = "all receivers off alike"
"""What no measurement between drones can show, in fleets of any size."""
ONE_OF_FEW = "which of fewer than four receivers is off"


class IntegrityState(StrEnum):
    """What a position may be used for, the best first."""

    NOMINAL = "NOMINAL"
    DEGRADED = "DEGRADED"
    """Within the alert limits; something that should be there is not, or is left out."""
    DEAD_RECKONING = "DEAD_RECKONING"
    """Nothing was measured or received: a prediction, its protection level growing."""
    ALERT = "ALERT"
    """The error may be beyond the alert limits."""
    NOT_OBSERVABLE = "NOT_OBSERVABLE"
    """What was measured does not say where the drone is."""


@dataclass(frozen=True, slots=True)
class AlertLimits:
    """Largest errors that whoever uses the position can do with."""

    horizontal_m: float
    vertical_m: float


@dataclass(frozen=True, slots=True)
class Guaranteed:
    """The guaranteed set of a neighbour's relative position; no probability, and never merged with one."""

    half_axes_m: Vector
    """``(3,)``, the longest first."""
    least_range_m: float
    """It is certainly not nearer."""


@dataclass(frozen=True, slots=True)
class Statement:
    """Of one tick."""

    state: IntegrityState
    reason: str
    """Empty where nominal."""
    ellipse: ErrorEllipse
    own: ProtectionLevel
    relative: Mapping[int, ProtectionLevel]
    """Of each neighbour's position relative to the own one, by id."""
    guaranteed: Mapping[int, Guaranteed]
    """By id; none where the bounds of the sensors say nothing."""
    off: Mapping[int, float]
    """Whose fixes are off, by id, and by how many metres."""
    ranges_off: tuple[tuple[int, int], ...]
    """Between whom ranges are off, by id."""
    unattributable: bool
    """Whether somebody's fixes are off now, and it cannot be told whose."""
    undetectable: tuple[str, ...]
    """What could be wrong and would not be seen, always."""
    targets: Mapping[int, TargetState] = field(default_factory=dict)
    """Of every target of the configuration, by id: said of it alone, and nothing of the own position."""

    def __str__(self) -> str:
        return f"{self.state}: {self.reason}" if self.reason else str(self.state)


_UNHELD = (
    What.NO_ESTIMATE,
    What.NOT_ALIGNED,
    What.UNKNOWN,
    What.AMBIGUOUS,
    What.TOO_FEW_RANGED,
    What.ONE_PLANE,
    What.MIRRORED,
    What.NOT_OBSERVABLE,
)


def judged(
    findings: Iterable[Finding], own: ProtectionLevel, limits: AlertLimits
) -> tuple[IntegrityState, Finding | str]:
    """The state, and what it follows from: a finding, or words about a protection level; empty where nominal."""
    found = [each for each in findings if each.gravity > Gravity.NOTED]
    for each in found:
        if each.what in _UNHELD:
            return IntegrityState.NOT_OBSERVABLE, each
    if own.horizontal_m > limits.horizontal_m:
        return IntegrityState.ALERT, _above("horizontal", own.horizontal_m, limits.horizontal_m)
    if own.vertical_m > limits.vertical_m:
        return IntegrityState.ALERT, _above("vertical", own.vertical_m, limits.vertical_m)
    for each in found:
        if each.gravity is Gravity.ALARM:
            return IntegrityState.ALERT, each
    for each in found:
        if each.what is What.NO_DATA:
            return IntegrityState.DEAD_RECKONING, each
    return (IntegrityState.DEGRADED, found[0]) if found else (IntegrityState.NOMINAL, "")


def undetectable(receivers: int) -> tuple[str, ...]:
    """What cannot be seen with so many receivers that range to each other."""
    return (ALIKE,) if receivers >= FEWEST_RECEIVERS else (ALIKE, ONE_OF_FEW)


def _above(axis: str, level_m: float, limit_m: float) -> str:
    return f"{axis} protection level {level_m:.1f} m above {limit_m:g} m"
