"""A window over its first state alone: the exact form of the moving horizon estimator with EKF pre-estimation.

Variables are the state x_0 at the window's start and the slow errors s of its sensors, which are constants over a
window. The process noise is integrated out: a Kalman filter that starts at x_0 with *zero* covariance runs through
the window, and its innovations, weighted by their own covariance, are the likelihood of (x_0, s),

    e_r = y_r - h(x_k^-) - b_r's,      S_r = R_r + c_r P_k^- c_r',      J = |(x_0, s) - prior|^2 + sum_r e_r^2 / S_r.

On a linear system its optimum is that over (x_0, s) and all process noises, and its newest state, with covariance
Phi_N Cov(x_0, s) Phi_N' + P_N, is the Kalman filter's. Rows are linearised along the smoothed path, which a backward
pass gives (A. E. Bryson and M. Frazier, 1963): that is Gauss-Newton on the joint problem without its variables.

Outliers: beyond a threshold c the square of a residual z gives way to the logarithm of a Student-t density with nu
degrees of freedom, so that a row's weight is (nu + c^2) / (nu + z^2); the rows of one fix have one weight.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimators.compiled.entries import entry, kernel, structure
from estimators.compiled.linear_algebra import cholesky_solve, factor_upper, inverse_from_cholesky
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import ROW, Matrix, RowTable, Vector
from estimators.model.motion import add_input_noise, predict_covariance, predict_sensitivity, transpose_predict
from estimators.model.row_kernels import (
    PRECISION,
    VALUE,
    IntArray,
    add_gradient,
    chain_gradient,
    dot_gradient,
    predict_row,
)
from estimators.model.second_order import linearisation_variance

CONVERGED, NOT_CONVERGED, UNUSABLE = 0, 1, 2
SIGNIFICANT = 0.05
"""Share of a row's variance below which what its linearisation misses is left out."""
REWEIGHTINGS = 3
"""How often the covariance and what the linearisation misses at it are computed from each other."""
SHORTEST_STEP = 1.0 / 64.0
"""A step that has to be cut further is none."""
SLOW = 0.3
"""Contraction from one step to the next above which the length of the step is looked for."""
ROUNDING = 1e-10
"""Relative change of the objective that counts as none."""
EXPECTED_CONTRACTION_M = 1.0
"""A first step of size s is expected to leave an error of s^2 over this: a range bends over metres."""
DEGREES_OF_FREEDOM = 4.0
"""nu of the Student-t density beyond the threshold."""
THRESHOLDS = np.array([0.0, 9.0, 11.8, 14.2])
"""c^2 by the rows that have one weight: three sigma, and the same probability for two and three of them."""


class SlowWindow(NamedTuple):
    """A window of N ticks and m rows of n agents (d = 6n) with q slow errors, D = d + q variables."""

    code: IntArray
    """``(m, 3)``, see `estimators.model.row_kernels`."""
    data: Matrix
    """``(m, 7)``."""
    start: IntArray
    """``(N+2,)``: first row of each tick, then m."""
    group: IntArray
    """``(m,)``: the first row of those that share its weight; they follow each other."""
    slow_at: IntArray
    """``(m, 7)``: which slow errors the row holds, -1 where fewer."""
    slow_by: Matrix
    """``(m, 7)``: by how much, in units of the row."""
    accel: Matrix
    """``(N, 3n)`` m/s2."""
    accel_variance: Matrix
    """``(N, 3n)``, positive."""
    push_at: IntArray
    """``(3n,)``: the slow error that each acceleration holds, -1 for none."""
    push_by: Vector
    """``(3n,)``: by how much, m/s2."""
    prior_mean: Vector
    """``(D,)``."""
    prior_information: Matrix
    """``(D, D)``."""
    dt: float
    eps: float
    robust: bool
    """Whether outliers are weighted down."""


SLOW_WINDOW = structure(
    SlowWindow,
    "int64[:, ::1], float64[:, ::1], int64[::1], int64[::1], int64[:, ::1], float64[:, ::1], float64[:, ::1],"
    " float64[:, ::1], int64[::1], float64[::1], float64[::1], float64[:, ::1], float64, float64, boolean",
)


class Sweep(NamedTuple):
    """What one pass of the filter with zero start leaves."""

    gradients: Matrix
    """``(m, D)`` of the innovations, each divided by its own sigma."""
    innovations: Vector
    """``(m,)`` divided by their sigmas."""
    sigmas: Vector
    """``(m,)`` of the innovations."""
    gains: Matrix
    """``(m, d)``."""
    units: Matrix
    """``(m, 4)`` gradients of the rows, see `predict_row`."""
    before: Matrix
    """``((N+1) d, d)``: covariance of every tick before its rows."""
    mean: Vector
    """``(d,)`` of the last tick."""
    sensitivity: Matrix
    """``(d, D)`` of the last state."""
    covariance: Matrix
    """``(d, d)`` of the last state given (x_0, s)."""


@kernel
def slow_part(window: SlowWindow, r: int, slow: Vector) -> float:
    """What row r holds of the slow errors."""
    total = 0.0
    for j in range(window.slow_at.shape[1]):
        at = window.slow_at[r, j]
        if at < 0:
            break
        total += window.slow_by[r, j] * slow[at]
    return total


@kernel
def move(window: SlowWindow, k: int, slow: Vector, x: Vector) -> None:
    """x <- the state one tick after tick k, by the accelerations less their slow errors."""
    dt = window.dt
    for a in range(x.shape[0] // STATES_PER_AGENT):
        p = STATES_PER_AGENT * a
        for i in range(3):
            c = 3 * a + i
            push = window.accel[k, c]
            if window.push_at[c] >= 0:
                push -= window.push_by[c] * slow[window.push_at[c]]
            x[p + i] += dt * x[p + 3 + i] + 0.5 * dt * dt * push
            x[p + 3 + i] += dt * push


@kernel
def sweep(window: SlowWindow, path: Matrix, slow: Vector, variances: Vector) -> Sweep:
    """The filter from ``path[0]`` with zero covariance, rows linearised at ``path`` ``(N+1, d)``.

    ``variances`` ``(m,)`` are those of the rows, weights included.
    """
    code, data, start, dt = window.code, window.data, window.start, window.dt
    ticks, d, m = path.shape[0], path.shape[1], code.shape[0]
    variables = window.prior_mean.shape[0]
    out = Sweep(
        np.empty((m, variables)), np.empty(m), np.empty(m), np.zeros((m, d)), np.empty((m, 4)),
        np.zeros((ticks * d, d)), path[0].copy(), np.zeros((d, variables)), np.zeros((d, d)),
    )  # fmt: skip
    x, sens, cov = out.mean, out.sensitivity, out.covariance
    column, away = np.zeros(d), np.empty(d)
    for i in range(d):
        sens[i, i] = 1.0
    for k in range(ticks):
        if k > 0:
            move(window, k - 1, slow, x)
            predict_sensitivity(sens, dt)
            for c in range(d // 2):
                if window.push_at[c] >= 0:
                    p, j = STATES_PER_AGENT * (c // 3) + c % 3, d + window.push_at[c]
                    sens[p, j] -= 0.5 * dt * dt * window.push_by[c]
                    sens[p + 3, j] -= dt * window.push_by[c]
            predict_covariance(cov, window.accel_variance[k - 1], dt)
        out.before[k * d : (k + 1) * d] = cov
        for r in range(start[k], start[k + 1]):
            for i in range(d):
                away[i] = x[i] - path[k, i]
            predicted = predict_row(code, data, r, path[k], window.eps, out.units[r])
            unit, g = out.units[r], out.gradients[r]
            e = data[r, VALUE] - predicted - slow_part(window, r, slow) - dot_gradient(code, data, r, unit, away)
            chain_gradient(code, data, r, unit, sens, g)
            for j in range(window.slow_at.shape[1]):
                if window.slow_at[r, j] < 0:
                    break
                g[d + window.slow_at[r, j]] += window.slow_by[r, j]
            variance = variances[r]
            if k > 0:
                chain_gradient(code, data, r, unit, cov, column)
                variance += dot_gradient(code, data, r, unit, column)
                for i in range(d):
                    gain = column[i] / variance
                    out.gains[r, i] = gain
                    if gain != 0.0:
                        x[i] += gain * e
                        for j in range(variables):
                            sens[i, j] -= gain * g[j]
                        for j in range(d):
                            cov[i, j] -= gain * column[j]
            sigma = np.sqrt(variance)
            out.sigmas[r] = sigma
            out.innovations[r] = e / sigma
            for j in range(variables):
                g[j] /= sigma
    return out


@kernel
def normal_factor(window: SlowWindow, found: Sweep, factor: Matrix) -> bool:
    """factor <- upper Cholesky of the Hessian over (x_0, s); False where it is not positive definite."""
    factor[:, :] = window.prior_information + np.dot(found.gradients.T.copy(), found.gradients)
    return factor_upper(factor)


@kernel
def step(window: SlowWindow, found: Sweep, factor: Matrix, path: Matrix, slow: Vector) -> Vector:
    """Gauss-Newton's change of (x_0, s)."""
    d = path.shape[1]
    away = np.empty(window.prior_mean.shape[0])
    for i in range(d):
        away[i] = window.prior_mean[i] - path[0, i]
    for j in range(slow.shape[0]):
        away[d + j] = window.prior_mean[d + j] - slow[j]
    change: Vector = np.dot(window.prior_information, away) + np.dot(found.innovations, found.gradients)
    cholesky_solve(factor, change)
    return change


@kernel
def smoothed(window: SlowWindow, found: Sweep, change: Vector, path: Matrix, slow: Vector, out: Matrix) -> None:
    """out ``(N+1, d)`` <- the states given all rows and (x_0, s) changed by ``change``; ``slow`` is after it."""
    code, data, start = window.code, window.data, window.start
    ticks, d = path.shape
    innovations = found.innovations - np.dot(found.gradients, change)
    x = path[0] + change[:d]
    for k in range(ticks):
        if k > 0:
            move(window, k - 1, slow, x)
        out[k] = x
        for r in range(start[k], start[k + 1]):
            e = innovations[r] * found.sigmas[r]
            for i in range(d):
                x[i] += found.gains[r, i] * e
    adjoint = np.zeros(d)
    for k in range(ticks - 1, 0, -1):
        for r in range(start[k + 1] - 1, start[k] - 1, -1):
            total = innovations[r] / found.sigmas[r]
            for i in range(d):
                total -= found.gains[r, i] * adjoint[i]
            add_gradient(code, data, r, found.units[r], total, adjoint)
        for i in range(d):
            total = 0.0
            for j in range(d):
                total += found.before[k * d + i, j] * adjoint[j]
            out[k, i] += total
        transpose_predict(adjoint, window.dt)


@kernel
def weigh(window: SlowWindow, path: Matrix, slow: Vector, variances: Vector) -> float:
    """variances ``(m,)`` <- those of the rows by their weights at a path; gives the rows' part of the objective."""
    code, data, start, group = window.code, window.data, window.start, window.group
    unit, squares, m = np.empty(4), np.zeros(code.shape[0]), code.shape[0]
    for k in range(start.shape[0] - 1):
        for r in range(start[k], start[k + 1]):
            away = data[r, VALUE] - predict_row(code, data, r, path[k], window.eps, unit) - slow_part(window, r, slow)
            squares[group[r]] += data[r, PRECISION] * away * away
    total, nu, r = 0.0, DEGREES_OF_FREEDOM, 0
    while r < m:
        last = r
        while last < m and group[last] == r:
            last += 1
        weight, square = 1.0, squares[r]
        limit = THRESHOLDS[min(last - r, 3)]
        if window.robust and square > limit:
            weight = (nu + limit) / (nu + square)
            square = limit + (nu + limit) * np.log((nu + square) / (nu + limit))
        total += square
        for i in range(r, last):
            variances[i] = 1.0 / (data[i, PRECISION] * weight)
        r = last
    return total


@kernel
def objective(window: SlowWindow, path: Matrix, slow: Vector, variances: Vector) -> float:
    """The joint objective, without a factor one half, at a path that the dynamics admit; sets the ``variances``."""
    d, dt = path.shape[1], window.dt
    away = np.empty(window.prior_mean.shape[0])
    for i in range(d):
        away[i] = path[0, i] - window.prior_mean[i]
    for j in range(slow.shape[0]):
        away[d + j] = slow[j] - window.prior_mean[d + j]
    total = float(np.dot(away, np.dot(window.prior_information, away)))
    for k in range(path.shape[0] - 1):
        for c in range(d // 2):
            v = STATES_PER_AGENT * (c // 3) + 3 + c % 3
            push = window.accel[k, c]
            if window.push_at[c] >= 0:
                push -= window.push_by[c] * slow[window.push_at[c]]
            noise = (path[k + 1, v] - path[k, v]) / dt - push
            total += noise * noise / window.accel_variance[k, c]
    return total + weigh(window, path, slow, variances)


@kernel
def minimise(
    window: SlowWindow, path: Matrix, slow: Vector, variances: Vector, max_iterations: int, tolerance: float
) -> tuple[int, int, float]:
    """Minimise from ``path`` ``(N+1, d)`` and ``slow`` ``(q,)``, in place; ``variances`` ``(m,)`` come out weighted.

    Converged when the change still expected from another iteration, estimated from the contraction, is below
    ``tolerance`` in every state. Gives the outcome, the iterations and the objective.
    """
    d, variables = path.shape[1], window.prior_mean.shape[0]
    factor = np.empty((variables, variables))
    trial, there = np.empty_like(path), np.empty_like(slow)
    trial_variances = np.empty_like(variances)
    value = objective(window, path, slow, variances)
    last = EXPECTED_CONTRACTION_M
    for iteration in range(max_iterations):
        found = sweep(window, path, slow, variances)
        if not normal_factor(window, found, factor):
            return UNUSABLE, iteration, value
        change = step(window, found, factor, path, slow)
        there[:] = slow + change[d:]
        smoothed(window, found, change, path, there, trial)
        size = max(np.abs(trial - path).max(), 0.0)
        if not np.isfinite(size):
            return UNUSABLE, iteration, value
        _, new = _shared_step(window, path, slow, trial, there, trial_variances, value, size > SLOW * last)
        if not new <= value + ROUNDING * (1.0 + abs(value)):
            return (CONVERGED if size < tolerance else NOT_CONVERGED), iteration + 1, value
        path[:], slow[:], variances[:] = trial, there, trial_variances
        value = new
        if size * min(size / last, 1.0) < tolerance:
            return CONVERGED, iteration + 1, value
        last = size
    return NOT_CONVERGED, max_iterations, value


@kernel
def _shared_step(
    window: SlowWindow,
    path: Matrix,
    slow: Vector,
    trial: Matrix,
    there: Vector,
    variances: Vector,
    value: float,
    slowly: bool,
) -> tuple[float, float]:
    """``trial`` ``(N+1, d)``, ``there`` ``(q,)`` <- as much of the step to them from ``path``, ``slow`` as pays.

    Where steps contract ``slowly`` they overshoot along a bend, or creep: then the lowest point of the parabola
    through the objective at the start, in the middle and at the end is tried. Gives the share that was taken and the
    objective there; ``value`` is that at the start, and what is not below it means that no share was found.
    """
    full, full_slow = trial.copy(), there.copy()
    new, share = objective(window, trial, there, variances), 1.0
    if slowly:
        trial[:], there[:] = 0.5 * (path + full), 0.5 * (slow + full_slow)
        middle = objective(window, trial, there, variances)
        bend = 2.0 * (new - 2.0 * middle + value)
        share = min(max((3.0 * value - 4.0 * middle + new) / (2.0 * bend), SHORTEST_STEP), 2.0) if bend > 0.0 else 1.0
        trial[:], there[:] = path + share * (full - path), slow + share * (full_slow - slow)
        new = objective(window, trial, there, variances)
    while not new <= value + ROUNDING * (1.0 + abs(value)) and share > SHORTEST_STEP:
        share *= 0.5
        trial[:], there[:] = path + share * (full - path), slow + share * (full_slow - slow)
        new = objective(window, trial, there, variances)
    return share, new


@kernel
def newest_covariance(found: Sweep, factor: Matrix, out: Matrix) -> None:
    """out ``(D, D)`` <- covariance of the newest state and the slow errors, from a sweep and its normal factor."""
    d, variables = found.sensitivity.shape
    start = np.empty((variables, variables))
    inverse_from_cholesky(factor, start)
    carry = np.zeros((variables, variables))
    carry[:d] = found.sensitivity
    for j in range(d, variables):
        carry[j, j] = 1.0
    out[:, :] = np.dot(np.dot(carry, start), carry.T.copy())
    out[:d, :d] += found.covariance
    for i in range(variables):
        for j in range(i):
            middle = 0.5 * (out[i, j] + out[j, i])
            out[i, j] = middle
            out[j, i] = middle


@kernel
def marginalise(window: SlowWindow, path: Matrix, variances: Vector, mean: Vector, covariance: Matrix) -> None:
    """mean ``(D,)``, covariance ``(D, D)`` <- the window's prior, in covariance form, with its first tick's rows.

    ``covariance`` comes in as that of the prior. Rows are linearised at the smoothed ``path``.
    """
    code, data = window.code, window.data
    d, variables = path.shape[1], window.prior_mean.shape[0]
    mean[:] = window.prior_mean
    unit, column, away = np.empty(4), np.empty(variables), np.empty(d)
    for r in range(window.start[0], window.start[1]):
        for i in range(d):
            away[i] = mean[i] - path[0, i]
        e = data[r, VALUE] - predict_row(code, data, r, path[0], window.eps, unit)
        e -= slow_part(window, r, mean[d:]) + dot_gradient(code, data, r, unit, away)
        chain_gradient(code, data, r, unit, covariance[:d], column)
        for j in range(window.slow_at.shape[1]):
            at, by = window.slow_at[r, j], window.slow_by[r, j]
            if at < 0:
                break
            for i in range(variables):
                column[i] += by * covariance[d + at, i]
        variance = variances[r] + dot_gradient(code, data, r, unit, column[:d]) + slow_part(window, r, column[d:])
        for i in range(variables):
            gain = column[i] / variance
            mean[i] += gain * e
            if gain != 0.0:
                for j in range(variables):
                    covariance[i, j] -= gain * column[j]


@kernel
def predict_moments(window: SlowWindow, keep: Vector, added: Vector, mean: Vector, covariance: Matrix) -> None:
    """mean ``(D,)``, covariance ``(D, D)`` <- those one tick after the window's start.

    Slow errors ``(q,)`` are Gauss-Markov: ``keep`` is the factor by which each decays in a tick, ``added`` the
    variance that it gains.
    """
    d, dt = 6 * (window.push_at.shape[0] // 3), window.dt
    move(window, 0, mean[d:], mean[:d])
    for turn in range(2):  # rows, then, transposed, columns: the covariance stays symmetric
        across = covariance if turn == 0 else covariance.T
        for c in range(d // 2):
            p, at = STATES_PER_AGENT * (c // 3) + c % 3, d + window.push_at[c]
            for j in range(across.shape[1]):
                across[p, j] += dt * across[p + 3, j]
                if at >= d:
                    push = window.push_by[c] * across[at, j]
                    across[p, j] -= 0.5 * dt * dt * push
                    across[p + 3, j] -= dt * push
        for q in range(keep.shape[0]):
            for j in range(across.shape[1]):
                across[d + q, j] *= keep[q]
    add_input_noise(covariance[:d, :d], window.accel_variance[0], dt)
    for q in range(keep.shape[0]):
        mean[d + q] *= keep[q]
        covariance[d + q, d + q] += added[q]


@entry(
    "Tuple((int64, int64, float64))(SLOW_WINDOW, ROW[::1], float64[::1], float64[::1], boolean, int64, float64,"
    " float64[:, ::1],"
    " float64[::1], float64[::1], float64[::1], float64[:, ::1], float64[::1], float64[:, ::1])",
    SLOW_WINDOW=SLOW_WINDOW,
    ROW=ROW,
)
def solve_first_state(
    window: SlowWindow,
    rows: RowTable,
    keep: Vector,
    added: Vector,
    slide: bool,
    max_iterations: int,
    tolerance: float,
    path: Matrix,
    slow: Vector,
    measured: Vector,
    variances: Vector,
    newest: Matrix,
    mean: Vector,
    covariance: Matrix,
) -> tuple[int, int, float]:
    """Optimum of a window, the covariance of its newest state, and the prior of the window that follows.

    ``keep``, ``added``: see `predict_moments`. ``path`` ``(N+1, d)`` and ``slow`` ``(q,)`` come in as the start of
    the iteration and go out as the optimum;
    ``measured`` ``(m,)`` get the variances of the rows by their weights, ``variances`` these with what a
    linearisation misses.
    ``newest`` ``(D, D)`` gets the covariance of the newest state and the slow errors. ``covariance`` ``(D, D)`` comes
    in as that of the window's prior; with ``slide``, it and ``mean`` ``(D,)`` go out as the prior of a window that
    starts one tick later. Gives the outcome, the iterations and the objective.
    """
    window = SlowWindow(*window)
    variables = window.prior_mean.shape[0]
    outcome, iterations, value = minimise(window, path, slow, variances, max_iterations, tolerance)
    if outcome == UNUSABLE:
        return outcome, iterations, value
    factor = np.empty((variables, variables))
    measured[:] = variances
    for _ in range(REWEIGHTINGS + 1):
        found = sweep(window, path, slow, variances)
        if not normal_factor(window, found, factor):
            return UNUSABLE, iterations, value
        newest_covariance(found, factor, newest)
        if not add_missed(window, rows, path, newest, measured, variances):
            break
    if slide:
        marginalise(window, path, variances, mean, covariance)
        predict_moments(window, keep, added, mean, covariance)
    if not (np.isfinite(path).all() and np.isfinite(newest).all() and np.isfinite(covariance).all()):
        return UNUSABLE, iterations, value
    return outcome, iterations, value


@kernel
def add_missed(
    window: SlowWindow, rows: RowTable, path: Matrix, newest: Matrix, measured: Vector, variances: Vector
) -> bool:
    """variances <- ``measured`` plus what linearisations miss where it is significant; whether any has changed."""
    d = path.shape[1]
    covariance, changed = newest[:d, :d], False
    for k in range(path.shape[0]):
        for r in range(window.start[k], window.start[k + 1]):
            missed = linearisation_variance(rows[r], path[k], covariance, window.eps)
            total = measured[r] + missed if missed > SIGNIFICANT * measured[r] else measured[r]
            changed = changed or abs(total - variances[r]) > SIGNIFICANT * variances[r]
            variances[r] = total
    return changed
