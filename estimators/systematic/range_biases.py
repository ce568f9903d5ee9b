"""What an estimate says of the biases of ranges, pair by pair."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimators.model.measurements import Matrix, Vector
from estimators.systematic import slow_errors

LEARNED = 0.9
"""A sigma that is not below this share of its prior's says that no range has told anything yet."""


@dataclass(frozen=True, slots=True)
class RangeBiases:
    """Biases and their 1-sigma in m, ``(n, n)``, symmetric; NaN where nothing is known, as on the diagonal."""

    bias_m: Matrix
    sigma_m: Matrix

    @classmethod
    def of(cls, agents: int, slow: Vector, variance: Vector, sizes: Vector) -> RangeBiases:
        """From slow errors ``(q,)``, their variances and the sigmas of their priors (`slow_errors`)."""
        bias_m, sigma_m = np.full((2, agents, agents), np.nan)
        for one in range(agents):
            for other in range(one + 1, agents):
                at = slow_errors.pair_of(one, other, agents)
                sigma = float(np.sqrt(variance[at]))
                if sigma < LEARNED * sizes[at]:
                    bias_m[one, other] = bias_m[other, one] = slow[at]
                    sigma_m[one, other] = sigma_m[other, one] = sigma
        return cls(bias_m, sigma_m)
