"""Kernels for a window over its first state (`estimators.window.first_state`) whose states or residuals are bounded.

The bounded problem is the joint one, over x_0, the slow errors s and all process noises. With them integrated out it
stays exact, by duality: what pulls a quantity a'(x_k, s) back to its bound moves the whole path along its *response*,

    H^-1 a,      H the Hessian of the joint problem,

that is the covariance of all states with the quantity. A forward and a backward pass through a solved sweep give it,
without H: the pull is a row without information at tick k. So a program has one variable for each bound that may be
active, and none for the path.

Quantities are numbered: the states of all ticks, the speeds of all agents at all ticks, the residuals of all rows.
"""

from __future__ import annotations

import numpy as np

from estimators.compiled.entries import entry, kernel
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import Matrix, Vector
from estimators.model.row_kernels import HALF_WIDTH, VALUE, IntArray, add_gradient, dot_gradient, predict_row
from estimators.window.first_state import (
    SLOW_WINDOW,
    SlowWindow,
    Sweep,
    objective,
    slow_part,
    smoothed,
    sweep,
)


@kernel
def speed_of(path: Matrix, k: int, a: int) -> float:
    """Length of the velocity of agent a at tick k."""
    v = STATES_PER_AGENT * a + 3
    return float(np.sqrt(path[k, v] ** 2 + path[k, v + 1] ** 2 + path[k, v + 2] ** 2))


@entry(
    "boolean(SLOW_WINDOW, float64[:, ::1], float64[::1], float64[::1], float64[::1], float64, boolean)",
    SLOW_WINDOW=SLOW_WINDOW,
)
def keeps_limits(
    window: SlowWindow, path: Matrix, slow: Vector, low: Vector, high: Vector, speed_mps: float, noise: bool
) -> bool:
    """Whether a path is within all limits, and, with ``noise``, every residual within its half width."""
    window = SlowWindow(*window)
    ticks, d = path.shape
    for k in range(ticks):
        for i in range(d):
            if not low[i] <= path[k, i] <= high[i]:
                return False
        for a in range(d // STATES_PER_AGENT):
            if not speed_of(path, k, a) <= speed_mps:
                return False
    if noise:
        unit = np.empty(4)
        for k in range(ticks):
            for r in range(window.start[k], window.start[k + 1]):
                if not abs(residual(window, path, slow, k, r, unit)) <= window.data[r, HALF_WIDTH]:
                    return False
    return True


@kernel
def residual(window: SlowWindow, path: Matrix, slow: Vector, k: int, r: int, unit: Vector) -> float:
    """What row r, of tick k, leaves at a path; ``unit`` ``(4,)``: see `predict_row`."""
    predicted = predict_row(window.code, window.data, r, path[k], window.eps, unit)
    return float(window.data[r, VALUE] - predicted - slow_part(window, r, slow))


@entry("void(SLOW_WINDOW, float64[:, ::1], float64[::1], float64[::1])", SLOW_WINDOW=SLOW_WINDOW)
def quantities(window: SlowWindow, path: Matrix, slow: Vector, out: Vector) -> None:
    """out <- all quantities at a path."""
    window = SlowWindow(*window)
    ticks, d = path.shape
    n, unit = d // STATES_PER_AGENT, np.empty(4)
    for k in range(ticks):
        out[k * d : (k + 1) * d] = path[k]
        for a in range(n):
            out[ticks * d + k * n + a] = speed_of(path, k, a)
        for r in range(window.start[k], window.start[k + 1]):
            out[ticks * (d + n) + r] = residual(window, path, slow, k, r, unit)


@entry("void(SLOW_WINDOW, float64[:, ::1], float64[:, ::1], float64[::1], float64[::1])", SLOW_WINDOW=SLOW_WINDOW)
def quantity_changes(window: SlowWindow, path: Matrix, change: Matrix, slow_change: Vector, out: Vector) -> None:
    """out <- how all quantities change with a path and its slow errors, in the first order about ``path``."""
    window = SlowWindow(*window)
    ticks, d = path.shape
    n, unit = d // STATES_PER_AGENT, np.empty(4)
    for k in range(ticks):
        out[k * d : (k + 1) * d] = change[k]
        for a in range(n):
            v, speed, total = STATES_PER_AGENT * a + 3, speed_of(path, k, a), 0.0
            for i in range(3):
                total += path[k, v + i] * change[k, v + i]
            out[ticks * d + k * n + a] = total / speed if speed > 0.0 else 0.0
        for r in range(window.start[k], window.start[k + 1]):
            predict_row(window.code, window.data, r, path[k], window.eps, unit)
            moved = dot_gradient(window.code, window.data, r, unit, change[k])
            out[ticks * (d + n) + r] = -moved - slow_part(window, r, slow_change)


@entry("void(SLOW_WINDOW, float64[:, ::1], int64[::1], int64[::1], float64[:, ::1])", SLOW_WINDOW=SLOW_WINDOW)
def quantity_gradients(window: SlowWindow, path: Matrix, chosen: IntArray, tick: IntArray, gradients: Matrix) -> None:
    """tick ``(p,)``, gradients ``(p, D)`` over (x_tick, s) <- those of the chosen quantities ``(p,)``."""
    window = SlowWindow(*window)
    ticks, d = path.shape
    n, unit = d // STATES_PER_AGENT, np.empty(4)
    gradients[:, :] = 0.0
    for c in range(chosen.shape[0]):
        at, along = chosen[c], gradients[c]
        if at < ticks * d:
            tick[c] = at // d
            along[at % d] = 1.0
        elif at < ticks * (d + n):
            k, a = (at - ticks * d) // n, (at - ticks * d) % n
            tick[c], v, speed = k, STATES_PER_AGENT * a + 3, speed_of(path, k, a)
            if speed > 0.0:
                for i in range(3):
                    along[v + i] = path[k, v + i] / speed
        else:
            r, k = at - ticks * (d + n), 0
            while window.start[k + 1] <= r:
                k += 1
            tick[c] = k
            predict_row(window.code, window.data, r, path[k], window.eps, unit)
            add_gradient(window.code, window.data, r, unit, -1.0, along[:d])
            for j in range(window.slow_at.shape[1]):
                if window.slow_at[r, j] < 0:
                    break
                along[d + window.slow_at[r, j]] -= window.slow_by[r, j]


@kernel
def across(unit: Vector, first: Vector, second: Vector) -> None:
    """first, second ``(3,)`` <- unit vectors across a unit vector ``(3,)`` and each other."""
    least = 0
    for i in range(1, 3):
        if abs(unit[i]) < abs(unit[least]):
            least = i
    root = np.sqrt(1.0 - unit[least] * unit[least])
    for i in range(3):
        first[i] = ((1.0 if i == least else 0.0) - unit[least] * unit[i]) / root
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        second[i] = unit[j] * first[k] - unit[k] * first[j]


@entry(
    "int64(SLOW_WINDOW, float64[:, ::1], float64[::1], float64[::1], float64[::1], boolean,"
    " int64[::1], float64[:, ::1], float64[::1])",
    SLOW_WINDOW=SLOW_WINDOW,
)
def bends(
    window: SlowWindow,
    path: Matrix,
    slow: Vector,
    variances: Vector,
    multipliers: Vector,
    of_rows: bool,
    tick: IntArray,
    along: Matrix,
    curvature: Vector,
) -> int:
    """Second derivatives of half the Lagrangian that Gauss-Newton's Hessian leaves out; gives their number b.

    Each is curvature[i] a a', with a = along[i] over (x_tick[i], s); ``tick`` ``(b,)``, ``along`` ``(b, D)``,
    ``curvature`` ``(b,)`` have room for two of each speed and each row. Those of speeds at their limit; with
    ``of_rows`` those of the rows' norms, too, by what their residuals and multipliers pull.
    """
    window = SlowWindow(*window)
    code, data = window.code, window.data
    ticks, d = path.shape
    n, unit, turned, count = d // STATES_PER_AGENT, np.empty(4), np.empty((2, 4)), 0
    for k in range(ticks):
        for a in range(n):
            pull, speed = multipliers[ticks * d + k * n + a], speed_of(path, k, a)
            if pull == 0.0 or speed == 0.0:
                continue
            v = STATES_PER_AGENT * a + 3
            across(path[k, v : v + 3] / speed, turned[0], turned[1])
            for i in range(2):
                tick[count], curvature[count], along[count, :] = k, pull / speed, 0.0
                along[count, v : v + 3] = turned[i, :3]
                count += 1
        for r in range(window.start[k], window.start[k + 1]):
            if not of_rows:
                break
            left = residual(window, path, slow, k, r, unit)
            pull = -(left / variances[r] + multipliers[ticks * (d + n) + r])
            if unit[3] == 0.0 or pull == 0.0:
                continue
            norm = np.sqrt(unit[0] ** 2 + unit[1] ** 2 + unit[2] ** 2)
            if norm == 0.0:
                continue
            across(unit[:3] / norm, turned[0], turned[1])
            for i in range(2):
                tick[count], curvature[count], along[count, :] = k, pull / unit[3], 0.0
                add_gradient(code, data, r, turned[i], 1.0, along[count, :d])
                count += 1
    return count


@kernel
def respond(
    window: SlowWindow, found: Sweep, tick: int, along: Vector, still: Matrix, out: Matrix, slow_out: Vector
) -> None:
    """out ``(N+1, d)``, slow_out ``(q,)`` <- response of the path and the slow errors to a pull at ``tick``.

    ``along`` ``(D,)`` is the gradient of the quantity that is pulled, over (x_tick, s); ``still`` is a path of zeros.
    The pull goes through a solved sweep as what the rows say does.
    """
    d, dt, width = still.shape[1], window.dt, window.push_at.shape[0]
    vector, offset = along.copy(), np.zeros(found.offset.shape)
    half = 0.5 * dt * dt
    for k in range(tick, found.offset.shape[0]):
        now, first = offset[k], k * width
        for c in range(width):
            p = STATES_PER_AGENT * (c // 3) + c % 3
            vector[p + 3] -= dt * vector[p]
            if window.push_at[c] >= 0:
                vector[d + window.push_at[c]] += window.push_by[c] * (half * vector[p] + dt * vector[p + 3])
        for c in range(width):
            p = STATES_PER_AGENT * (c // 3) + c % 3
            now[c] = np.sqrt(window.accel_variance[k, c]) * (half * vector[p] + dt * vector[p + 3])
        for c in range(width):
            now[c] /= found.roots[first + c, c]
            for i in range(c + 1, width):
                now[i] -= found.roots[first + c, i] * now[c]
            for j in range(vector.shape[0]):
                vector[j] -= found.noise[first + c, j] * now[c]
    pulled = Sweep(found.information, vector, found.noise, offset, found.roots)
    smoothed(window, pulled, still, np.zeros(slow_out.shape[0]), out, slow_out)


@entry(
    "boolean(SLOW_WINDOW, float64[:, ::1], float64[:, ::1], float64[::1], float64[::1], int64[::1], float64[:, ::1],"
    " float64[:, ::1], float64[::1], float64[:, :, ::1], float64[:, ::1])",
    SLOW_WINDOW=SLOW_WINDOW,
)
def newton_responses(
    window: SlowWindow,
    prior: Matrix,
    path: Matrix,
    slow: Vector,
    variances: Vector,
    tick: IntArray,
    along: Matrix,
    trial: Matrix,
    there: Vector,
    responses: Matrix,
    slow_responses: Matrix,
) -> bool:
    """Gauss-Newton's step without bounds, and the responses to pulls; False where the Hessian is not positive.

    ``prior`` ``(D, D)`` is the prior's information. ``trial`` ``(N+1, d)`` and ``there`` ``(q,)`` get where the step
    leads from ``path`` and ``slow``; ``responses`` ``(p, N+1, d)`` and ``slow_responses`` ``(p, q)`` those to pulls
    along ``along`` ``(p, D)`` at ``tick`` ``(p,)``.
    """
    window = SlowWindow(*window)
    total, ticks, width = window.prior_mean.shape[0], window.accel.shape[0], window.push_at.shape[0]
    found = Sweep(
        np.empty((total, total)), np.empty(total), np.empty((ticks * width, total)), np.empty((ticks, width)),
        np.empty((ticks * width, width)),
    )  # fmt: skip
    if not sweep(window, prior, path, slow, variances, found):
        return False
    smoothed(window, found, path, slow, trial, there)
    still = np.zeros(path.shape)
    for p in range(tick.shape[0]):
        respond(window, found, tick[p], along[p], still, responses[p], slow_responses[p])
    return True


@entry(
    "float64(SLOW_WINDOW, float64[:, ::1], float64[:, ::1], float64[::1], float64[::1])", SLOW_WINDOW=SLOW_WINDOW
)
def joint_objective(window: SlowWindow, prior: Matrix, path: Matrix, slow: Vector, variances: Vector) -> float:
    """See `estimators.window.first_state.objective`."""
    return float(objective(SlowWindow(*window), prior, path, slow, variances))
