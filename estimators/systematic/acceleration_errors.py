"""The errors of the fleet's accelerations as an estimator knows them, and how they go on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from estimators.integrity.places.hypotheses import Drift
from estimators.model.layout import block
from estimators.model.measurements import Matrix, Vector
from estimators.systematic import slow_errors


@dataclass(frozen=True, slots=True)
class AccelerationErrors:
    """Of n agents, NED m/s2, beside the 6n states of the tick that they are known at."""

    mean: Vector
    """``(3n,)``."""
    covariance: Matrix
    """``(3n, 3n)``."""
    with_states: Matrix
    """``(6n, 3n)``: their covariance with the states."""
    sizes: Vector
    """``(3n,)``: standard deviations of what they may be."""
    kept: float
    """Factor per tick of what is left of them."""

    @classmethod
    def of(cls, slow: Vector, covariance: Matrix, sizes: Vector, period_s: float) -> Self:
        """Out of all slow errors ``(q,)``, the covariance ``(6n + q, 6n + q)`` of states and them, their sizes."""
        states = len(covariance) - len(slow)
        agents = states // 6
        mine = slice(slow_errors.acceleration_of(0, agents).start, slow_errors.common(agents).start)
        at = slice(states + mine.start, states + mine.stop)
        kept = float(slow_errors.kept_per_tick(agents, period_s)[mine.start])
        return cls(slow[mine], covariance[at, at], covariance[:states, at], sizes[mine], kept)

    def joined(self, mean: Vector, covariance: Matrix, slot: int) -> tuple[Vector, Matrix]:
        """An agent's state ``(9,)``, ``(9, 9)`` out of the fleet's ``(6n,)``, ``(6n, 6n)``: with its error."""
        own, mine = block(slot), slice(3 * slot, 3 * slot + 3)
        cross = self.with_states[own, mine]
        joint = np.block([[covariance[own, own], cross], [cross.T, self.covariance[mine, mine]]])
        return np.concatenate((mean[own], self.mean[mine])), joint

    def drift(self, slot: int) -> Drift:
        """How an agent's error goes on."""
        return Drift(self.kept, self.sizes[3 * slot : 3 * slot + 3])

    def apart(self) -> Self:
        """The same, of which the states say nothing any more."""
        return replace(self, with_states=np.zeros_like(self.with_states))
