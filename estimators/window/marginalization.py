"""Filtered arrival cost: the information on a window's second state from all that the window drops.

The paper's arrival cost (17)-(18) already holds the rows of the next window's first tick and a smoothed mean,
which are then used again. Here the dropped tick is marginalised: its rows, linearised at the smoothed state,
enter the information pair, which is then predicted. Nothing is used twice, so that on a linear system the
estimator is the Kalman filter.
"""

from __future__ import annotations

import numpy as np

from estimators.compiled.entries import entry, kernel
from estimators.compiled.linear_algebra import cholesky_solve, factor_upper, inverse_from_cholesky
from estimators.model.corrections import add_corrections
from estimators.model.measurements import ROW, Matrix, RowTable, Vector
from estimators.model.motion import predict_information, predict_state
from estimators.model.row_kernels import IntArray
from estimators.model.second_order import linearisation_variance

SIGNIFICANT = 0.05
"""Share of a row's variance below which what its linearisation misses is left out."""
REWEIGHTINGS = 3
"""How often the covariance and what the linearisation misses at it are computed from each other."""


@kernel
def filter_along(
    rows: RowTable,
    start: IntArray,
    accel: Matrix,
    accel_variance: Matrix,
    path: Matrix,
    dt: float,
    eps: float,
    information: Matrix,
    vector: Vector,
    next_information: Matrix,
    next_mean: Vector,
    covariance: Matrix,
) -> bool:
    """Run the information filter through a window, every tick linearised at the smoothed ``path``.

    ``path`` ``(N+1, 6n)``; ``information``, ``vector`` are the prior pair at the window's start.
    ``next_information``, ``next_mean`` get information and mean one tick later, before that tick's rows;
    ``covariance`` ``(6n, 6n)`` that of the last state. False where a pair is not positive definite.
    """
    n = vector.shape[0]
    info = information.copy()
    pair = vector.copy()
    mean = np.empty(n)
    ticks = accel.shape[0]
    for k in range(ticks + 1):
        add_corrections(rows[start[k] : start[k + 1]], path[k], eps, info, pair)
        root = info.copy()
        if not factor_upper(root):
            return False
        if k == ticks:
            inverse_from_cholesky(root, covariance)
            break
        mean[:] = pair
        cholesky_solve(root, mean)
        predict_state(mean, accel[k], dt, mean)
        if not predict_information(info, accel_variance[k], dt):
            return False
        for i in range(n):
            pair[i] = 0.0
            for j in range(n):
                pair[i] += info[i, j] * mean[j]
        if k == 0:
            next_information[:, :] = info
            next_mean[:] = mean
    return True


@entry(
    "boolean(ROW[::1], int64[::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64, float64,"
    " float64[:, ::1], float64[::1], ROW[::1], float64[:, ::1], float64[::1], float64[:, ::1])",
    ROW=ROW,
)
def filter_reweighted(
    rows: RowTable,
    start: IntArray,
    accel: Matrix,
    accel_variance: Matrix,
    path: Matrix,
    dt: float,
    eps: float,
    information: Matrix,
    vector: Vector,
    weighted: RowTable,
    next_information: Matrix,
    next_mean: Vector,
    covariance: Matrix,
) -> bool:
    """`filter_along`, with rows whose variances hold what their linearisation misses where it is significant.

    That follows from the covariance and it from that: iterated from the rows as they are, so that a place that the
    data tell is not doubted for the prior's sake. ``weighted`` ``(m,)`` gets the rows with the variances found.
    """
    for r in range(rows.shape[0]):
        weighted[r] = rows[r]
    total = np.empty(rows.shape[0])
    for _ in range(REWEIGHTINGS + 1):
        if not filter_along(
            weighted, start, accel, accel_variance, path, dt, eps,
            information, vector, next_information, next_mean, covariance,
        ):  # fmt: skip
            return False
        settled = True
        for k in range(start.shape[0] - 1):
            for r in range(start[k], start[k + 1]):
                measured = rows[r]["variance"]
                missed = linearisation_variance(rows[r], path[k], covariance, eps)
                total[r] = measured + missed if missed > SIGNIFICANT * measured else measured
                before = weighted[r]["variance"]
                settled = settled and abs(total[r] - before) <= SIGNIFICANT * before
        if settled:
            break
        for r in range(rows.shape[0]):
            weighted[r]["variance"] = total[r]
    return True
