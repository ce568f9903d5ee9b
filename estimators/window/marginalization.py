"""Filtered arrival cost: the information on a window's second state from all that the window drops.

The paper's arrival cost (17)-(18) already holds the rows of the next window's first tick and a smoothed mean,
which are then used again. Here the dropped tick is marginalised: its rows, linearised at the smoothed state,
enter the information pair, which is then predicted. Nothing is used twice, so that on a linear system the
estimator is the Kalman filter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimators.compiled.entries import entry, kernel, structure
from estimators.compiled.linear_algebra import cholesky_solve, factor_upper, inverse_from_cholesky
from estimators.model.corrections import add_corrections
from estimators.model.measurements import ROW, Matrix, RowTable, Vector
from estimators.model.motion import predict_information, predict_state
from estimators.model.second_order import linearisation_variance
from estimators.window.problem import PROBLEM, WindowProblem

SIGNIFICANT = 0.05
"""Share of a row's variance below which what its linearisation misses is left out."""
REWEIGHTINGS = 3
"""How often the covariance and what the linearisation misses at it are computed from each other."""


class Filtering(NamedTuple):
    """Room for what the information filter finds along a window."""

    rows: RowTable
    """``(m,)`` the window's, with the variances used."""
    information: Matrix
    """``(6n, 6n)`` one tick after the window's start, before that tick's rows."""
    mean: Vector
    """``(6n,)`` of that tick."""
    covariance: Matrix
    """``(6n, 6n)`` of the last state."""


FILTERING = structure(Filtering, "ROW[::1], float64[:, ::1], float64[::1], float64[:, ::1]", ROW=ROW)


@kernel
def filter_along(problem: WindowProblem, path: Matrix, eps: float, out: Filtering) -> bool:
    """Run the information filter through a window, every tick linearised at the smoothed ``path`` ``(N+1, 6n)``.

    From the window's fused prior on, with ``out.rows``; fills the rest of ``out``. False where a belief is not
    positive definite.
    """
    start, accel, dt = problem.start, problem.accel, problem.period_s
    n = problem.vector.shape[0]
    info = problem.information.copy()
    pair = problem.vector.copy()
    mean = np.empty(n)
    ticks = accel.shape[0]
    for k in range(ticks + 1):
        add_corrections(out.rows[start[k] : start[k + 1]], path[k], eps, info, pair)
        root = info.copy()
        if not factor_upper(root):
            return False
        if k == ticks:
            inverse_from_cholesky(root, out.covariance)
            break
        mean[:] = pair
        cholesky_solve(root, mean)
        predict_state(mean, accel[k], dt, mean)
        if not predict_information(info, problem.accel_variance[k], dt):
            return False
        for i in range(n):
            pair[i] = 0.0
            for j in range(n):
                pair[i] += info[i, j] * mean[j]
        if k == 0:
            out.information[:, :] = info
            out.mean[:] = mean
    return True


@entry(
    "boolean(PROBLEM, float64[:, ::1], float64, FILTERING)",
    PROBLEM=PROBLEM,
    FILTERING=FILTERING,
)
def filter_reweighted(problem: WindowProblem, path: Matrix, eps: float, out: Filtering) -> bool:
    """`filter_along`, with rows whose variances hold what their linearisation misses where it is significant.

    That follows from the covariance and it from that: iterated from the rows as they are, so that a place that the
    data tell is not doubted for the prior's sake. Fills all of ``out``.
    """
    problem, out = WindowProblem(*problem), Filtering(*out)
    rows, start, weighted = problem.rows, problem.start, out.rows
    for r in range(rows.shape[0]):
        weighted[r] = rows[r]
    total = np.empty(rows.shape[0])
    for _ in range(REWEIGHTINGS + 1):
        if not filter_along(problem, path, eps, out):
            return False
        settled = True
        for k in range(start.shape[0] - 1):
            for r in range(start[k], start[k + 1]):
                measured = rows[r]["variance"]
                missed = linearisation_variance(rows[r], path[k], out.covariance, eps)
                total[r] = measured + missed if missed > SIGNIFICANT * measured else measured
                before = weighted[r]["variance"]
                settled = settled and abs(total[r] - before) <= SIGNIFICANT * before
        if settled:
            break
        for r in range(rows.shape[0]):
            weighted[r]["variance"] = total[r]
    return True
