"""A window over its first state alone: the exact form of the moving horizon estimator with EKF pre-estimation.

Variables are the state x_0 at the window's start and the slow errors s of its sensors, which are constants over a
window. The process noise is integrated out. That can be done by a Kalman filter that starts at x_0 with *zero*
covariance: its innovations, weighted by their own covariance, are the likelihood of (x_0, s). The same can be done in
information form, which is what stands here, since rows have few entries and the noise of a tick fewer dimensions than
the state: with (L, l) information and vector of (x_k, s) given all rows before tick k,

    rows of the tick        L += sum_r g_r g_r' / R_r,       l += sum_r g_r e_r / R_r
    one tick on             P = F^-T L F^-1,   V = (1 + W'PW)^-T/2 W'P,   L <- P - V'V,   W = [B Q^1/2; 0]

and L of the last tick is the information of the newest state and s. The noise that a backward pass over the V gives
is the smoothed one. On a linear system the newest state and its covariance are the Kalman filter's. Rows are
linearised along the smoothed path: that is Gauss-Newton on the joint problem, with its variables eliminated tick by
tick. All is kept relative to the present path, so that no digits go to where the origin is.

Outliers: beyond a threshold c the square of a residual z gives way to the logarithm of a Student-t density with nu
degrees of freedom, so that a row's weight is (nu + c^2) / (nu + z^2); the rows of one fix have one weight.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimators.compiled.entries import entry, kernel, structure
from estimators.compiled.linear_algebra import (
    LIBRARY_SIZE,
    cholesky_solve,
    factor_upper,
    inverse_from_cholesky,
    solve_upper,
)
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import ROW, Matrix, RowTable, Vector
from estimators.model.motion import add_input_noise
from estimators.model.row_kernels import (
    OFFSET,
    PRECISION,
    SPEED,
    VALUE,
    VELOCITY,
    IntArray,
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
NOTHING_M = 1e-5
"""A last change of the path by less leaves gradients and weights what they were, to a millionth at ten metres."""
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
    dt: float
    eps: float
    robust: bool
    """Whether outliers are weighted down."""


SLOW_WINDOW = structure(
    SlowWindow,
    "int64[:, ::1], float64[:, ::1], int64[::1], int64[::1], int64[:, ::1], float64[:, ::1], float64[:, ::1],"
    " float64[:, ::1], int64[::1], float64[::1], float64[::1], float64, float64, boolean",
)


class Sweep(NamedTuple):
    """What one pass through the window leaves; all is relative to the path that it was linearised at."""

    information: Matrix
    """``(D, D)`` of the newest state and the slow errors; its upper Cholesky factor once it was solved."""
    vector: Vector
    """``(D,)``: what goes with it."""
    noise: Matrix
    """``(N 3n, D)``: V of every tick, how the noise of its accelerations hangs on what follows."""
    offset: Matrix
    """``(N, 3n)``: what it is where nothing follows."""
    roots: Matrix
    """``(N 3n, 3n)``: upper Cholesky factors of 1 + W'PW."""


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
def pushed(window: SlowWindow, k: int, c: int, slow: Vector) -> float:
    """Acceleration c over tick k, less its slow error."""
    push: float = window.accel[k, c]
    if window.push_at[c] >= 0:
        push -= window.push_by[c] * slow[window.push_at[c]]
    return push


@kernel
def move(window: SlowWindow, k: int, slow: Vector, x: Vector) -> None:
    """x <- the state one tick after tick k, by the accelerations less their slow errors."""
    dt = window.dt
    for c in range(x.shape[0] // 2):
        p = STATES_PER_AGENT * (c // 3) + c % 3
        push = pushed(window, k, c, slow)
        x[p] += dt * x[p + 3] + 0.5 * dt * dt * push
        x[p + 3] += dt * push


@kernel
def gradient(window: SlowWindow, r: int, unit: Vector, at: IntArray, by: Vector) -> int:
    """Entries of row r's gradient over (x, s) that are not zero: where, how much; gives their number."""
    code, data = window.code, window.data
    count, a, b = 0, code[r, 1], code[r, 2]
    turned = code[r, 0] == VELOCITY or code[r, 0] == SPEED
    offset = data[r, OFFSET]
    for i in range(3):
        if unit[i] == 0.0:
            continue
        if turned:
            at[count], by[count] = a + 3 + i, unit[i]
            count += 1
            continue
        at[count], by[count] = a + i, unit[i]
        count += 1
        if b >= 0:
            at[count], by[count] = b + i, -unit[i]
            count += 1
        if offset != 0.0:
            at[count], by[count] = a + 3 + i, offset * unit[i]
            count += 1
            if b >= 0:
                at[count], by[count] = b + 3 + i, -offset * unit[i]
                count += 1
    states = 2 * window.push_at.shape[0]
    for j in range(window.slow_at.shape[1]):
        if window.slow_at[r, j] < 0:
            break
        at[count], by[count] = states + window.slow_at[r, j], window.slow_by[r, j]
        count += 1
    return count


@kernel
def add_rows(window: SlowWindow, k: int, x: Vector, slow: Vector, variances: Vector, found: Sweep) -> None:
    """Add what the rows of tick k say, linearised at state x."""
    unit, at, by = np.empty(4), np.empty(24, np.int64), np.empty(24)
    information, vector = found.information, found.vector
    for r in range(window.start[k], window.start[k + 1]):
        predicted = predict_row(window.code, window.data, r, x, window.eps, unit)
        e = window.data[r, VALUE] - predicted - slow_part(window, r, slow)
        count = gradient(window, r, unit, at, by)
        for i in range(count):
            weighted = by[i] / variances[r]
            vector[at[i]] += weighted * e
            row = information[at[i]]
            for j in range(count):
                row[at[j]] += weighted * by[j]


@kernel
def carry_back(window: SlowWindow, information: Matrix, vector: Vector) -> None:
    """information, vector <- F^-T information F^-1, F^-T vector: the same said of the state one tick later."""
    dt = window.dt
    d, total = 2 * window.push_at.shape[0], vector.shape[0]
    half = 0.5 * dt * dt
    for c in range(d // 2):
        p = STATES_PER_AGENT * (c // 3) + c % 3
        v, s, by = p + 3, d + window.push_at[c], window.push_by[c]
        place, speed = information[p], information[v]
        for j in range(total):
            speed[j] -= dt * place[j]
        vector[v] -= dt * vector[p]
        if window.push_at[c] >= 0:
            slow = information[s]
            for j in range(total):
                slow[j] += by * (half * place[j] + dt * speed[j])
            vector[s] += by * (half * vector[p] + dt * vector[v])
    for i in range(total):
        row = information[i]
        for c in range(d // 2):
            p = STATES_PER_AGENT * (c // 3) + c % 3
            row[p + 3] -= dt * row[p]
            if window.push_at[c] >= 0:
                row[d + window.push_at[c]] += window.push_by[c] * (half * row[p] + dt * row[p + 3])


@kernel
def subtract_gram(v: Matrix, out: Matrix) -> None:
    """out -= v'v."""
    rows, n = v.shape
    if rows * n * n >= LIBRARY_SIZE**3:
        out -= np.dot(v.T, v)
        return
    for k in range(rows):
        for i in range(n):
            factor = v[k, i]
            if factor != 0.0:
                for j in range(n):
                    out[i, j] -= factor * v[k, j]


@kernel
def solve_rows(root: Matrix, out: Matrix) -> None:
    """out <- root'^-1 out, for an upper triangular ``root`` ``(k, k)`` and ``(k, n)``."""
    n = out.shape[1]
    for k in range(root.shape[0]):
        scale = 1.0 / root[k, k]
        for j in range(n):
            out[k, j] *= scale
        for i in range(k + 1, root.shape[0]):
            factor = root[k, i]
            if factor != 0.0:
                for j in range(n):
                    out[i, j] -= factor * out[k, j]


@kernel
def eliminate_noise(window: SlowWindow, path: Matrix, k: int, slow: Vector, found: Sweep) -> bool:
    """Carry what is known over tick k, the noise of its accelerations integrated out; False where that fails."""
    dt, width = window.dt, window.push_at.shape[0]
    information, vector = found.information, found.vector
    carry_back(window, information, vector)
    first = k * width
    noise, root, offset = found.noise[first : first + width], found.roots[first : first + width], found.offset[k]
    for c in range(width):
        p = STATES_PER_AGENT * (c // 3) + c % 3
        scale = np.sqrt(window.accel_variance[k, c])
        place, speed = scale * 0.5 * dt * dt, scale * dt
        for j in range(vector.shape[0]):
            noise[c, j] = place * information[p, j] + speed * information[p + 3, j]
        now = (path[k + 1, p + 3] - path[k, p + 3]) / dt - pushed(window, k, c, slow)
        offset[c] = place * vector[p] + speed * vector[p + 3] + now / scale
    for c in range(width):
        p = STATES_PER_AGENT * (c // 3) + c % 3
        scale = np.sqrt(window.accel_variance[k, c])
        for i in range(width):
            root[i, c] = scale * (0.5 * dt * dt * noise[i, p] + dt * noise[i, p + 3])
        root[c, c] += 1.0
    if not factor_upper(root):
        return False
    solve_rows(root, noise)
    for c in range(width):
        offset[c] /= root[c, c]
        for i in range(c + 1, width):
            offset[i] -= root[c, i] * offset[c]
        for j in range(vector.shape[0]):
            vector[j] -= noise[c, j] * offset[c]
    subtract_gram(noise, information)
    return True


@kernel
def sweep(
    window: SlowWindow, prior: Matrix, path: Matrix, slow: Vector, variances: Vector, found: Sweep
) -> bool:
    """From the window's prior information to that of its newest state, rows linearised at ``path`` ``(N+1, d)``.

    ``variances`` ``(m,)`` are those of the rows, weights included. False where it is not positive definite.
    """
    d, total = path.shape[1], prior.shape[0]
    away = np.empty(total)
    for i in range(d):
        away[i] = window.prior_mean[i] - path[0, i]
    for j in range(d, total):
        away[j] = window.prior_mean[j] - slow[j - d]
    found.information[:, :] = prior
    found.vector[:] = np.dot(prior, away)
    for k in range(path.shape[0]):
        if k > 0 and not eliminate_noise(window, path, k - 1, slow, found):
            return False
        add_rows(window, k, path[k], slow, variances, found)
    return factor_upper(found.information)


@kernel
def smoothed(window: SlowWindow, found: Sweep, path: Matrix, slow: Vector, out: Matrix, there: Vector) -> None:
    """out ``(N+1, d)``, there ``(q,)`` <- path and slow errors changed to where a sweep's linear problem has them."""
    d, dt, width = path.shape[1], window.dt, window.push_at.shape[0]
    change = found.vector.copy()
    cholesky_solve(found.information, change)
    for j in range(there.shape[0]):
        there[j] = slow[j] + change[d + j]
    noise = np.empty(width)
    for k in range(path.shape[0] - 1, -1, -1):
        for i in range(d):
            out[k, i] = path[k, i] + change[i]
        if k == 0:
            break
        first = (k - 1) * width
        for c in range(width):
            total = -found.offset[k - 1, c]
            for j in range(change.shape[0]):
                total += found.noise[first + c, j] * change[j]
            noise[c] = total
        solve_upper(found.roots[first : first + width], noise)
        for c in range(width):
            p = STATES_PER_AGENT * (c // 3) + c % 3
            push = np.sqrt(window.accel_variance[k - 1, c]) * noise[c]
            if window.push_at[c] >= 0:
                push -= window.push_by[c] * change[d + window.push_at[c]]
            change[p + 3] -= dt * push
            change[p] -= dt * change[p + 3] + 0.5 * dt * dt * push


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
def objective(window: SlowWindow, prior: Matrix, path: Matrix, slow: Vector, variances: Vector) -> float:
    """The joint objective, without a factor one half, at a path that the dynamics admit; sets the ``variances``."""
    d, dt = path.shape[1], window.dt
    away = np.empty(window.prior_mean.shape[0])
    for i in range(d):
        away[i] = path[0, i] - window.prior_mean[i]
    for j in range(slow.shape[0]):
        away[d + j] = slow[j] - window.prior_mean[d + j]
    total = float(np.dot(away, np.dot(prior, away)))
    for k in range(path.shape[0] - 1):
        for c in range(d // 2):
            v = STATES_PER_AGENT * (c // 3) + 3 + c % 3
            noise = (path[k + 1, v] - path[k, v]) / dt - pushed(window, k, c, slow)
            total += noise * noise / window.accel_variance[k, c]
    return total + weigh(window, path, slow, variances)


@kernel
def minimise(
    window: SlowWindow,
    prior: Matrix,
    path: Matrix,
    slow: Vector,
    variances: Vector,
    max_iterations: int,
    tolerance: float,
    found: Sweep,
) -> tuple[int, int, float, bool]:
    """Minimise from ``path`` ``(N+1, d)`` and ``slow`` ``(q,)``, in place; ``variances`` ``(m,)`` come out weighted.

    Converged when the change still expected from another iteration, estimated from the contraction, is below
    ``tolerance`` in every state. Gives the outcome, the iterations, the objective, and whether ``found`` is, to
    rounding, what a sweep at the end would find.
    """
    trial, there = np.empty_like(path), np.empty_like(slow)
    trial_variances = np.empty_like(variances)
    value = objective(window, prior, path, slow, variances)
    last = EXPECTED_CONTRACTION_M
    for iteration in range(max_iterations):
        if not sweep(window, prior, path, slow, variances, found):
            return UNUSABLE, iteration, value, False
        smoothed(window, found, path, slow, trial, there)
        size = 0.0
        for k in range(path.shape[0]):
            for i in range(path.shape[1]):
                size = max(size, abs(trial[k, i] - path[k, i])) if np.isfinite(trial[k, i]) else np.inf
        if not np.isfinite(size):
            return UNUSABLE, iteration, value, False
        slowly = size > SLOW * last
        _, new = _shared_step(window, prior, path, slow, trial, there, trial_variances, value, slowly)
        if not new <= value + ROUNDING * (1.0 + abs(value)):
            return (CONVERGED if size < tolerance else NOT_CONVERGED), iteration + 1, value, True
        path[:], slow[:], variances[:] = trial, there, trial_variances
        value = new
        if size * min(size / last, 1.0) < tolerance:
            return CONVERGED, iteration + 1, value, size < NOTHING_M
        last = size
    return NOT_CONVERGED, max_iterations, value, False


@kernel
def _shared_step(
    window: SlowWindow,
    prior: Matrix,
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
    new, share = objective(window, prior, trial, there, variances), 1.0
    if slowly:
        trial[:], there[:] = 0.5 * (path + full), 0.5 * (slow + full_slow)
        middle = objective(window, prior, trial, there, variances)
        bend = 2.0 * (new - 2.0 * middle + value)
        share = min(max((3.0 * value - 4.0 * middle + new) / (2.0 * bend), SHORTEST_STEP), 2.0) if bend > 0.0 else 1.0
        trial[:], there[:] = path + share * (full - path), slow + share * (full_slow - slow)
        new = objective(window, prior, trial, there, variances)
    while not new <= value + ROUNDING * (1.0 + abs(value)) and share > SHORTEST_STEP:
        share *= 0.5
        trial[:], there[:] = path + share * (full - path), slow + share * (full_slow - slow)
        new = objective(window, prior, trial, there, variances)
    return share, new


@kernel
def marginalise(window: SlowWindow, path: Matrix, variances: Vector, mean: Vector, covariance: Matrix) -> None:
    """mean ``(D,)``, covariance ``(D, D)`` <- the window's prior, in covariance form, with its first tick's rows.

    ``covariance`` comes in as that of the prior. Rows are linearised at the smoothed ``path``.
    """
    d, total, rows = path.shape[1], window.prior_mean.shape[0], window.start[1]
    mean[:] = window.prior_mean
    if rows == 0:
        return
    unit, at, by = np.empty(4), np.empty((rows, 24), np.int64), np.empty((rows, 24))
    counts, misses = np.empty(rows, np.int64), np.empty(rows)
    columns, root = np.zeros((rows, total)), np.empty((rows, rows))
    for r in range(rows):
        predicted = predict_row(window.code, window.data, r, path[0], window.eps, unit)
        count = gradient(window, r, unit, at[r], by[r])
        counts[r] = count
        misses[r] = window.data[r, VALUE] - predicted
        for i in range(count):
            here = at[r, i]
            misses[r] -= by[r, i] * (mean[here] - path[0, here] if here < d else mean[here])
            for j in range(total):
                columns[r, j] += by[r, i] * covariance[here, j]
    for r in range(rows):
        for other in range(rows):
            root[other, r] = 0.0
            for i in range(counts[r]):
                root[other, r] += by[r, i] * columns[other, at[r, i]]
        root[r, r] += variances[r]
    factor_upper(root)
    solve_rows(root, columns)
    for r in range(rows):
        misses[r] /= root[r, r]
        for i in range(r + 1, rows):
            misses[i] -= root[r, i] * misses[r]
        for j in range(total):
            mean[j] += columns[r, j] * misses[r]
    subtract_gram(columns, covariance)


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
    total, ticks, width = window.prior_mean.shape[0], window.accel.shape[0], window.push_at.shape[0]
    factor, prior = covariance.copy(), np.empty((total, total))
    if not factor_upper(factor):
        return UNUSABLE, 0, 0.0
    inverse_from_cholesky(factor, prior)
    found = Sweep(
        factor, np.empty(total), np.empty((ticks * width, total)), np.empty((ticks, width)),
        np.empty((ticks * width, width)),
    )  # fmt: skip
    outcome, iterations, value, swept = minimise(
        window, prior, path, slow, variances, max_iterations, tolerance, found
    )
    if outcome == UNUSABLE:
        return outcome, iterations, value
    measured[:] = variances
    for _ in range(REWEIGHTINGS + 1):
        if not swept and not sweep(window, prior, path, slow, variances, found):
            return UNUSABLE, iterations, value
        inverse_from_cholesky(found.information, newest)
        if not add_missed(window, rows, path, newest, measured, variances):
            break
        swept = False
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
    """variances <- ``measured`` plus what linearisations miss where it is significant; whether any has changed.

    Of speeds only where outliers are weighted down: what they leave wrong, fixes mend that keep their weight.
    """
    d = path.shape[1]
    covariance, changed = newest[:d, :d], False
    for k in range(path.shape[0]):
        for r in range(window.start[k], window.start[k + 1]):
            missed = 0.0
            if window.robust or window.code[r, 0] != SPEED:
                missed = linearisation_variance(rows[r], path[k], covariance, window.eps)
            total = measured[r] + missed if missed > SIGNIFICANT * measured[r] else measured[r]
            changed = changed or abs(total - variances[r]) > SIGNIFICANT * variances[r]
            variances[r] = total
    return changed
