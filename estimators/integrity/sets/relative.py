"""Where a neighbour certainly is, relative to the own drone: a filter of three states."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

import numpy as np

from estimators.integrity.sets.ellipsoid import Ellipsoid
from estimators.integrity.sets.relative_kernels import PREDICTION_EMPTY, SNAPSHOT_EMPTY, step
from estimators.model.measurements import Matrix, Vector

RESTART_S = 10.0
"""What was measured has contradicted the set for so long, and never itself: the set begins anew from it. Bounds did
not hold once, and nothing says that they do not hold now."""


class Conflict(IntFlag):
    """What of a tick's bounds contradict each other."""

    NONE = 0
    PAST = PREDICTION_EMPTY
    """What was measured now contradicts what was measured before, and how the drones have moved."""
    PRESENT = SNAPSHOT_EMPTY
    """Fixes and ranges of now contradict each other."""


@dataclass(frozen=True, slots=True)
class RelativeBounds:
    """What is certain of a neighbour's relative position in a tick, NED m; infinite where nothing is.

    ``moved``, ``slack`` ``(3,)``: how far it has moved since the last tick, and how far off that is at most.
    ``low``, ``high`` ``(3,)``: the box that it is in now. ``ranges`` ``(m, 5)``: a range, its half width, and how far
    the neighbour has moved since.
    """

    moved: Vector
    slack: Vector
    low: Vector
    high: Vector
    ranges: Matrix


class RelativeFilter:
    """The set of one neighbour; the input is the relative displacement, with its bound.

    Three states, since six (with the velocity) make larger sets. The set moves and grows by the displacement's bound;
    from about 0.1 m a step on, what is measured at one instant is the smaller set, and is kept then.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._centre, self._shape = np.zeros(3), np.zeros((3, 3))
        self._known = False
        self._contradicted_s = 0.0
        self.conflicts = 0
        """Ticks whose bounds contradicted each other."""

    @property
    def set(self) -> Ellipsoid | None:
        """What is certain; ``None`` where nothing is."""
        return Ellipsoid(self._centre.copy(), self._shape.copy()) if self._known else None

    def observe(self, evidence: RelativeBounds) -> Conflict:
        """Go on by a tick."""
        found = Conflict(
            step(
                self._centre, self._shape, self._known, evidence.moved, evidence.slack, evidence.low, evidence.high,
                evidence.ranges,
            )
        )  # fmt: skip
        self._known = bool(np.isfinite(self._shape).all() and np.isfinite(self._centre).all())
        if not self._known:
            self._centre, self._shape = np.zeros(3), np.zeros((3, 3))
        self.conflicts += found is not Conflict.NONE
        self._contradicted_s = self._contradicted_s + self._period_s if found is Conflict.PAST else 0.0
        if self._contradicted_s > RESTART_S:
            self._known, self._contradicted_s = False, 0.0
        return found
