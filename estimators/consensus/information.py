"""Information consensus: fusing information pairs, and the weights to fuse them with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimators.compiled.entries import entry, kernel, plain, structure
from estimators.compiled.linear_algebra import factor_upper
from estimators.estimator import Payload
from estimators.model.measurements import Matrix, Vector

WeightRule = Literal["observability_rank", "metropolis", "uniform"]


class Pairs(NamedTuple):
    """Information pairs of a closed neighbourhood, the own one first, with the weights to fuse them."""

    weights: Vector
    """``(J,)``, a convex combination."""
    informations: NDArray[np.float64]
    """``(J, 6n, 6n)``."""
    vectors: Matrix
    """``(J, 6n)``."""


PAIRS = structure(Pairs, "float64[::1], float64[:, :, ::1], float64[:, ::1]")
NO_PAIRS = Pairs(np.zeros(0), np.zeros((0, 0, 0)), np.zeros((0, 0)))
"""Nothing to fuse."""


@kernel
def combine(pairs: Pairs, information: Matrix, vector: Vector) -> None:
    """information, vector <- weighted sums of the pairs: (13)-(14)."""
    weights, informations, vectors = pairs.weights, pairs.informations, pairs.vectors
    n = vector.shape[0]
    for i in range(n):
        vector[i] = 0.0
        for j in range(n):
            information[i, j] = 0.0
    for p in range(weights.shape[0]):
        weight = weights[p]
        for i in range(n):
            vector[i] += weight * vectors[p, i]
            for j in range(n):
                information[i, j] += weight * informations[p, i, j]


@entry("void(PAIRS, float64[:, ::1], float64[::1])", PAIRS=PAIRS)
def combine_pairs(pairs: Pairs, information: Matrix, vector: Vector) -> None:
    """`combine`, for Python."""
    combine(Pairs(*pairs), information, vector)


@entry("boolean(float64[:, ::1])")
def is_definite(information: Matrix) -> bool:
    """Whether a symmetric matrix is positive definite; one that is not finite is not."""
    return factor_upper(information.copy())


def usable_pairs(
    received: Mapping[int, Payload], tick: int, dimension: int
) -> tuple[dict[int, Payload], int]:
    """The pairs that speak of ``tick`` and can be fused, and how many of that tick cannot.

    One pair that is not finite, not positive definite or of another dimension would spoil the whole
    neighbourhood's: it is left out.
    """
    timely = {slot: pair for slot, pair in received.items() if pair.tick == tick}
    usable = {slot: pair for slot, pair in timely.items() if _can_be_fused(pair, dimension)}
    return usable, len(timely) - len(usable)


def fits(pair: Payload, dimension: int) -> bool:
    """Whether a pair is one of ``dimension`` states, with counts that can be."""
    return (
        pair.information.shape == (dimension, dimension)
        and pair.vector.shape == (dimension,)
        and pair.rank >= 0
        and pair.degree >= 0
    )


def _can_be_fused(pair: Payload, dimension: int) -> bool:
    if not fits(pair, dimension) or not np.isfinite(pair.vector).all():
        return False
    return is_definite(np.ascontiguousarray(pair.information, np.float64))


def rank_weights(own_rank: int, neighbour_ranks: Sequence[int]) -> tuple[float, list[float]]:
    """Weights by observability rank over the closed neighbourhood, Borelle et al. 2023, eq. (26).

    The sum in (26) includes the agent itself: only then do the weights sum to one. A neighbourhood in which
    nothing is observable gets equal weights.
    """
    total = own_rank + sum(neighbour_ranks)
    if total == 0:
        return uniform_weights(len(neighbour_ranks))
    return own_rank / total, [rank / total for rank in neighbour_ranks]


def uniform_weights(neighbours: int) -> tuple[float, list[float]]:
    """Equal weights over the closed neighbourhood."""
    weight = 1.0 / (neighbours + 1)
    return weight, [weight] * neighbours


def metropolis_weights(own_degree: int, neighbour_degrees: Sequence[int]) -> tuple[float, list[float]]:
    """Metropolis weights 1 / (1 + max degree of the two ends); the rest stays with the agent."""
    weights = [1.0 / (1.0 + max(own_degree, degree)) for degree in neighbour_degrees]
    return 1.0 - sum(weights), weights


def weigh(
    own: Payload, received: Mapping[int, Payload], rule: WeightRule, ranks: Mapping[int, int]
) -> Pairs:
    """The pairs of one round of consensus with their weights, own first, then by slot.

    ``ranks`` holds the ranks of the first round by slot (they do not change between rounds). A neighbour that
    was not heard is left out and the weights are renormalised over the others. Metropolis weights take a
    neighbour's degree from ``Payload.degree``.
    """
    slots = sorted(received)
    if rule == "observability_rank":
        weight, others = rank_weights(own.rank, [ranks.get(slot, received[slot].rank) for slot in slots])
    elif rule == "metropolis":
        weight, others = metropolis_weights(own.degree, [received[slot].degree for slot in slots])
    else:
        weight, others = uniform_weights(len(slots))
    n = len(own.vector)
    informations, vectors = np.empty((len(slots) + 1, n, n)), np.empty((len(slots) + 1, n))
    for place, pair in enumerate((own, *(received[slot] for slot in slots))):
        informations[place] = pair.information
        vectors[place] = pair.vector
    return Pairs(np.array([weight, *others]), informations, vectors)


def fuse_pairs(pairs: Pairs) -> tuple[Matrix, Vector]:
    """The convex combination (13)-(14)."""
    information, vector = np.empty(pairs.informations.shape[1:]), np.empty(pairs.vectors.shape[1])
    combine_pairs(plain(pairs), information, vector)
    return information, vector


def fuse(
    own: Payload, received: Mapping[int, Payload], rule: WeightRule, ranks: Mapping[int, int]
) -> tuple[Matrix, Vector]:
    """One round of consensus, eqs (13)-(14), see `weigh`."""
    return fuse_pairs(weigh(own, received, rule, ranks))
