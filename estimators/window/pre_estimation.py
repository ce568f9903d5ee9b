"""EKF pre-estimation over the window: gains (20)-(23) of Borelle et al. 2023, from the prior mean on."""

from __future__ import annotations

import numpy as np

from estimators.compiled.entries import kernel
from estimators.compiled.linear_algebra import mirror_upper
from estimators.model.measurements import Matrix, Vector
from estimators.model.motion import predict_covariance, predict_state
from estimators.model.row_kernels import (
    PRECISION,
    VALUE,
    IntArray,
    chain_gradient,
    dot_gradient,
    predict_row,
)


@kernel
def update_covariance(
    code: IntArray, data: Matrix, first: int, last: int, units: Matrix, cov: Matrix, gains: Matrix
) -> None:
    """Measurement update of a covariance by rows first..last-1, all linearised at one point: (21)-(23).

    ``units`` ``(m, 4)`` holds their gradients. ``gains`` ``(m, d)`` gets the columns of K = cov C' R^-1, one
    a row. Rows enter one at a time (their noise is independent), so nothing is inverted; the result equals the
    block formula.
    """
    n = cov.shape[0]
    column = np.empty(n)
    for r in range(first, last):
        chain_gradient(code, data, r, units[r], cov, column)  # cov c, cov being symmetric
        innovation_variance = 1.0 / data[r, PRECISION] + dot_gradient(code, data, r, units[r], column)
        scale = 1.0 / innovation_variance
        for i in range(n):
            factor = scale * column[i]
            if factor != 0.0:
                for j in range(n):
                    cov[i, j] -= factor * column[j]
    for r in range(first, last):
        chain_gradient(code, data, r, units[r], cov, column)  # cov c, cov being symmetric
        for j in range(n):
            gains[r, j] = data[r, PRECISION] * column[j]


@kernel
def pre_estimate(
    code: IntArray,
    data: Matrix,
    start: IntArray,
    accel: Matrix,
    accel_variance: Matrix,
    mean: Vector,
    dt: float,
    eps: float,
    cov: Matrix,
    gains: Matrix,
    units: Matrix,
) -> None:
    """Run the EKF from the prior through the window and keep its gains.

    ``start`` ``(N+2,)``: first row of each tick; ``accel``, ``accel_variance`` ``(N, 3 n)``; ``mean``
    ``(d,)`` and ``cov`` ``(d, d)`` hold the prior on entry and x_t|t, Pi_pre,t|t (22) on return; ``gains`` ``(m, d)``
    and ``units`` ``(m, 4)`` get gain and gradient of every row after the first tick.
    """
    innovation = np.empty(code.shape[0])
    for k in range(1, start.shape[0] - 1):
        predict_state(mean, accel[k - 1], dt, mean)
        predict_covariance(cov, accel_variance[k - 1], dt)
        for r in range(start[k], start[k + 1]):
            innovation[r] = data[r, VALUE] - predict_row(code, data, r, mean, eps, units[r])
        update_covariance(code, data, start[k], start[k + 1], units, cov, gains)
        for r in range(start[k], start[k + 1]):
            for j in range(mean.shape[0]):
                mean[j] += gains[r, j] * innovation[r]
    mirror_upper(cov)  # rounding
