"""What an estimate says of the biases of ranges: pair by pair, and of what all ranges to a target share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimators.model.layout import Layout
from estimators.model.measurements import Matrix, Vector
from estimators.systematic import slow_errors

LEARNED = 0.9
"""A sigma that is not below this share of its prior's says that no range has told anything yet."""


@dataclass(frozen=True, slots=True)
class RangeBiases:
    """Biases and their 1-sigma in m; NaN where nothing is known."""

    bias_m: Matrix
    """``(n, n)``, symmetric, NaN on the diagonal: by how much the ranges of a pair are too long."""
    sigma_m: Matrix
    """``(n, n)``."""
    target_m: Vector
    """``(n,)``, of targets alone: by how much all ranges to it are too long."""
    target_sigma_m: Vector
    """``(n,)``."""

    @classmethod
    def of(cls, layout: Layout, slow: Vector, covariance: Matrix, sizes: Vector) -> RangeBiases:
        """From slow errors ``(q,)``, their covariance ``(q, q)`` and the sigmas of their priors (`slow_errors`)."""
        agents, drifts, targets = layout.size, slow_errors.drifts(layout.size).start, set(layout.target_slots)
        bias_m, sigma_m = np.full((2, agents, agents), np.nan)
        target_m, target_sigma_m = np.full((2, agents), np.nan)
        for one in range(agents):
            for other in range(one + 1, agents):
                held = [slow_errors.pair_of(one, other, agents)]
                held += [drifts + slot for slot in (one, other) if slot in targets][:1]
                known = _known(held, slow, covariance, sizes)
                bias_m[one, other] = bias_m[other, one] = known[0]
                sigma_m[one, other] = sigma_m[other, one] = known[1]
        for slot in targets:
            target_m[slot], target_sigma_m[slot] = _known([drifts + slot], slow, covariance, sizes)
        return cls(bias_m, sigma_m, target_m, target_sigma_m)


def _known(held: list[int], slow: Vector, covariance: Matrix, sizes: Vector) -> tuple[float, float]:
    """The sum of some errors and its sigma, NaN where no more is known than at first."""
    sigma = float(np.sqrt(covariance[np.ix_(held, held)].sum()))
    if sigma >= LEARNED * float(np.linalg.norm(sizes[held])):
        return np.nan, np.nan
    return float(slow[held].sum()), sigma
