"""Compiled primal-dual active set: from an approximate solution of a quadratic program to the exact one.

The program is that of `estimators.solvers.qp`. Every row is free, held at a bound (its multiplier to be found), or
saturated (outside, at the price of its penalty); the set is corrected until the optimality conditions hold.
"""

from __future__ import annotations

import numpy as np

from estimators.compiled.entries import entry, kernel
from estimators.compiled.linear_algebra import cholesky_solve, factor_upper
from estimators.model.measurements import Matrix, Vector
from estimators.model.row_kernels import IntArray

FEASIBILITY = 1e-9
"""How far a row may be outside, relative to its width or 1, and a multiplier beyond its penalty, relatively."""

SATURATED_WITHIN = 1e-7
DEPENDENT = 1e-13
"""Relative ridge that picks the shortest multipliers where held rows depend on each other."""

FREE, HELD, SATURATED = 0, 1, 2


@kernel
def _outside(rows: Matrix, lower: Vector, upper: Vector, q: Vector, i: int) -> tuple[float, float]:
    """How far row i is above its upper and below its lower bound (negative inside)."""
    value = 0.0
    for j in range(q.shape[0]):
        value += rows[i, j] * q[j]
    return value - upper[i], lower[i] - value


@kernel
def _sort_rows(
    rows: Matrix,
    lower: Vector,
    upper: Vector,
    penalty: Vector,
    tolerance: float,
    q: Vector,
    multipliers: Vector,
    place: IntArray,
    side: Vector,
) -> None:
    """Place every row by where it is and which way its multiplier pulls; ``side`` +1 upper, -1 lower."""
    for i in range(rows.shape[0]):
        over, under = _outside(rows, lower, upper, q, i)
        width = upper[i] - lower[i]
        slack = tolerance * (max(1.0, width) if np.isfinite(width) else 1.0)
        if multipliers[i] != 0.0:
            side[i] = 1.0 if multipliers[i] > 0.0 else -1.0
        else:
            side[i] = 1.0 if over >= under else -1.0
        outside = over if side[i] > 0.0 else under
        strength = side[i] * multipliers[i]
        place[i] = FREE
        if strength >= penalty[i] * (1.0 - max(SATURATED_WITHIN, tolerance)) and outside > -slack:
            place[i] = SATURATED
        elif strength >= 0.0 and (outside > slack or (strength > 0.0 and outside > -slack)):
            place[i] = HELD


@kernel
def _solve_held(
    linear: Vector,
    rows: Matrix,
    lower: Vector,
    upper: Vector,
    penalty: Vector,
    place: IntArray,
    side: Vector,
    q: Vector,
    multipliers: Vector,
) -> bool:
    """q and multipliers <- optimum with the held rows as equations and the saturated ones at their price."""
    m, d = rows.shape
    for j in range(d):
        q[j] = -linear[j]
    held = np.empty(m, np.int64)
    count = 0
    for i in range(m):
        multipliers[i] = 0.0
        if place[i] == SATURATED:
            multipliers[i] = side[i] * penalty[i]
            for j in range(d):
                q[j] -= multipliers[i] * rows[i, j]
        elif place[i] == HELD:
            held[count] = i
            count += 1
    if count == 0:
        return True
    gram = np.empty((count, count))
    force = np.empty(count)
    largest = 0.0
    for a in range(count):
        i = held[a]
        force[a] = lower[i] if side[i] < 0.0 else upper[i]
        force[a] = -force[a]
        for j in range(d):
            force[a] += rows[i, j] * q[j]
        for b in range(count):
            total = 0.0
            for j in range(d):
                total += rows[i, j] * rows[held[b], j]
            gram[a, b] = total
        largest = max(largest, gram[a, a])
    for a in range(count):
        gram[a, a] += DEPENDENT * largest
    if not factor_upper(gram):
        return False
    cholesky_solve(gram, force)
    for a in range(count):
        i = held[a]
        multipliers[i] = force[a]
        for j in range(d):
            q[j] -= force[a] * rows[i, j]
    return True


@kernel
def _is_optimal(
    rows: Matrix,
    lower: Vector,
    upper: Vector,
    penalty: Vector,
    place: IntArray,
    side: Vector,
    q: Vector,
    multipliers: Vector,
) -> bool:
    """Feasible where not saturated, multipliers of the right sign and within their penalties."""
    for i in range(rows.shape[0]):
        over, under = _outside(rows, lower, upper, q, i)
        width = upper[i] - lower[i]
        slack = FEASIBILITY * (max(1.0, width) if np.isfinite(width) else 1.0)
        strength = side[i] * multipliers[i]
        if place[i] == SATURATED:
            if (over if side[i] > 0.0 else under) < -slack:
                return False
        elif max(over, under) > slack:
            return False
        if place[i] == HELD and not (0.0 <= strength <= penalty[i] * (1.0 + FEASIBILITY)):
            return False
    return True


@entry(
    "boolean(float64[::1], float64[:, ::1], float64[::1], float64[::1], float64[::1], float64, int64,"
    " float64[::1], float64[::1])"
)
def settle(
    linear: Vector,
    rows: Matrix,
    lower: Vector,
    upper: Vector,
    penalty: Vector,
    accuracy: float,
    rounds: int,
    q: Vector,
    multipliers: Vector,
) -> bool:
    """Replace an approximate solution, q and multipliers good to ``accuracy``, by the exact one.

    False where the set does not settle within ``rounds``; q and multipliers are worth nothing then.
    """
    place = np.zeros(rows.shape[0], np.int64)
    side = np.ones(rows.shape[0])
    _sort_rows(rows, lower, upper, penalty, accuracy, q, multipliers, place, side)
    for _ in range(rounds):
        if not _solve_held(linear, rows, lower, upper, penalty, place, side, q, multipliers):
            return False
        if _is_optimal(rows, lower, upper, penalty, place, side, q, multipliers):
            return True
        _sort_rows(rows, lower, upper, penalty, FEASIBILITY, q, multipliers, place, side)
    return False
