"""Beliefs about a fleet's state, in moment and in information form."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.model.layout import block, states_of
from estimators.model.measurements import Matrix, Vector

Pair = tuple[Matrix, Vector]
"""Information matrix ``(6n, 6n)`` and vector ``(6n,)``, the matrix times the mean."""
Prior = tuple[Vector, Matrix]
"""Mean ``(6,)`` and covariance ``(6, 6)`` of one agent, NED m and m/s."""


def symmetrised(matrix: NDArray[Any]) -> Matrix:
    """The symmetric part of a square matrix."""
    return np.asarray(0.5 * (matrix + matrix.T), np.float64)


def marginal_pair(pair: Pair, slots: Sequence[int]) -> Pair:
    """The information pair of some slots alone, the others eliminated.

    With the kept states K and the others O: ``I_KK - I_KO I_OO^-1 I_OK`` and ``i_K - I_KO I_OO^-1 i_O``. Raises
    ``numpy.linalg.LinAlgError`` where ``I_OO`` is singular.
    """
    kept = states_of(slots)
    return marginal_of_states(pair, kept, other_states(kept, len(pair[1])))


def other_states(kept: NDArray[np.int64], dimension: int) -> NDArray[np.int64]:
    """The indices below ``dimension`` that are not ``kept``, ascending."""
    is_other = np.ones(dimension, np.bool_)
    is_other[kept] = False
    return np.asarray(np.flatnonzero(is_other), np.int64)


def marginal_of_states(pair: Pair, kept: NDArray[np.int64], others: NDArray[np.int64]) -> Pair:
    """`marginal_pair` with the states that are kept and those that are eliminated by their indices."""
    information, vector = pair
    marginal, right = information[np.ix_(kept, kept)], vector[kept]
    if len(others):
        cross = information[np.ix_(kept, others)]
        columns = np.column_stack((cross.T, vector[others]))
        solved = np.linalg.solve(information[np.ix_(others, others)], columns)
        marginal, right = marginal - cross @ solved[:, :-1], right - cross @ solved[:, -1]
    return symmetrised(marginal), np.asarray(right)


def reseated(covariance: Matrix, slot: int, onto: Matrix, excess: Matrix) -> Matrix:
    """The covariance where an agent's state is ``onto`` ``(6, D)`` times the old variables, with an error of its own.

    ``excess`` ``(6, 6)`` is that error's covariance.
    """
    out, own = covariance.copy(), block(slot)
    shared = onto @ covariance
    out[own, :], out[:, own] = shared, shared.T
    out[own, own] = shared @ onto.T + excess
    return symmetrised(out)
