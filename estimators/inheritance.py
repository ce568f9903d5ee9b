"""Consensus without dilution: take from a neighbour only what it knows better.

A convex combination of information pairs dilutes an agent's own block by neighbours that know it less. When
records are shared, neighbours mostly hold the same information, and what is lost to one of them is the rows of
some agents. So for those agents, D, whose marginal the neighbour knows better, its conditional density of D given
the other agents S takes the place of the own one:

    p(x_S, x_D) = p_own(x_S) p_neighbour(x_D | x_S)

The own marginal on S is untouched, and no datum enters it a second time.
"""

from __future__ import annotations

import numpy as np

from estimators.estimator import symmetrised
from estimators.layout import STATES_PER_AGENT, block
from estimators.measurements import Matrix, Vector

WORTHWHILE_NATS = 0.2
"""Difference in log determinant of a 6x6 marginal covariance from which on a neighbour knows an agent better."""


def inherit(
    own: tuple[Matrix, Vector], other: tuple[Matrix, Vector], slot: int, threshold: float = WORTHWHILE_NATS
) -> tuple[Matrix, Vector]:
    """The own information pair, with the agents that ``other`` knows better taken from there.

    ``slot`` is the own place, which is never taken. Pairs as in `estimators.estimator.Payload`.
    """
    covariance, other_covariance = symmetrised(np.linalg.inv(own[0])), symmetrised(np.linalg.inv(other[0]))
    better = [
        k
        for k in range(len(own[1]) // STATES_PER_AGENT)
        if k != slot and _log_det(covariance, k) - _log_det(other_covariance, k) > threshold
    ]
    if not better:
        return own
    taken = np.zeros(len(own[1]), bool)
    for k in better:
        taken[block(k)] = True
    return _transplant(own, other, covariance, taken)


def _log_det(covariance: Matrix, slot: int) -> float:
    return float(np.linalg.slogdet(covariance[block(slot), block(slot)])[1])


def _transplant(
    own: tuple[Matrix, Vector],
    other: tuple[Matrix, Vector],
    covariance: Matrix,
    taken: np.ndarray[tuple[int], np.dtype[np.bool_]],
) -> tuple[Matrix, Vector]:
    """Own marginal of the states not ``taken`` times the other's conditional of those taken."""
    kept = ~taken
    marginal = np.linalg.inv(covariance[np.ix_(kept, kept)])
    conditional, cross = other[0][np.ix_(taken, taken)], other[0][np.ix_(taken, kept)]
    regression = np.linalg.solve(conditional, cross)  # E[x_D | x_S] = a - regression x_S
    information, vector = np.empty_like(own[0]), np.empty_like(own[1])
    information[np.ix_(taken, taken)] = conditional
    information[np.ix_(taken, kept)] = cross
    information[np.ix_(kept, taken)] = cross.T
    information[np.ix_(kept, kept)] = marginal + cross.T @ regression
    vector[taken] = other[1][taken]
    vector[kept] = marginal @ (covariance @ own[1])[kept] + regression.T @ other[1][taken]
    return 0.5 * (information + information.T), vector
