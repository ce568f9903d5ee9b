"""The least-squares problem of one window: value, gradient, Hessian, bounds.

Variables z: the state at the window's start ``(d,)``, followed, without pre-estimation (DMHE-1), by one
acceleration correction ``(3 n,)`` per tick. Objective, half of the paper's (9)-(10):

    f(z) = 1/2 |U (x_0 - prior)|^2 + 1/2 sum_k |y_k - h(x_k)|^2_{R^-1} + 1/2 sum_k |w_k|^2_{Q^-1}

with U'U the prior information, along x_{k+1} = A x_k + B (u_k + w_k) + K_{k+1} (y_{k+1} - h(A x_k + B u_k)),
eqs (6)-(7): gains without w_k (pre-estimation), or w_k without gains (DMHE-1).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimators.compiled.entries import kernel, structure
from estimators.compiled.linear_algebra import LIBRARY_SIZE, add_outer_upper, multiply
from estimators.model.measurements import Matrix, Vector
from estimators.model.motion import predict_sensitivity, predict_state, transpose_predict, transpose_predict_all
from estimators.model.row_kernels import (
    PRECISION,
    VALUE,
    IntArray,
    add_curvature,
    add_gradient,
    chain_gradient,
    predict_row,
)

LIBRARY_WORK = LIBRARY_SIZE**3
"""Multiplications from which on a product goes to BLAS."""


class Window(NamedTuple):
    """One window's problem over d states of n agents, N ticks after its start, m rows."""

    code: IntArray
    """``(m, 3)``, see `estimators.row_kernels`."""
    data: Matrix
    """``(m, 7)``."""
    start: IntArray
    """``(N+2,)``: first row of each tick, then m."""
    accel: Matrix
    """``(N, 3 n)`` known accelerations over each tick, m/s2."""
    noise_precision: Matrix
    """``(N, 3 n)`` diag Q^-1 where z holds corrections w, ``(0, 0)`` where it does not."""
    gains: Matrix
    """``(m, d)``, K' row by row; ``(0, 0)`` without pre-estimation."""
    prior_mean: Vector
    """``(d,)``."""
    prior_root: Matrix
    """``(d, d)`` upper U, U'U the prior information."""
    prior_information: Matrix
    """``(d, d)``, upper triangle."""
    dt: float
    eps: float


WINDOW = structure(
    Window,
    "int64[:, ::1], float64[:, ::1], int64[::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[::1],"
    " float64[:, ::1], float64[:, ::1], float64, float64",
)


class Trajectory(NamedTuple):
    """What `roll_out` computes, and the weights that the derivatives need."""

    states: Matrix
    """``(N+1, d)``."""
    residuals: Vector
    """``(m,)`` y - h(x_k)."""
    innovations: Vector
    """``(m,)`` y - h(A x_{k-1} + B u_{k-1}), zero in the first tick."""
    units: Matrix
    """``(m, 4)`` gradients of the residuals' rows (`predict_row`)."""
    predicted_units: Matrix
    """``(m, 4)`` gradients of the innovations' rows."""
    weights: Vector
    """``(m,)`` df/d residual."""
    predicted_weights: Vector
    """``(m,)`` df/d innovation, with what the gains pass on once `gradient` ran."""
    state_weights: Matrix
    """``(N+1, d)`` multipliers of bounds on the states themselves, zero for the plain objective."""


@kernel
def empty_trajectory(window: Window) -> Trajectory:
    """Room for one trajectory of the window."""
    m = window.code.shape[0]
    return Trajectory(
        np.empty((window.start.shape[0] - 1, window.prior_mean.shape[0])),
        np.zeros(m),
        np.zeros(m),
        np.zeros((m, 4)),
        np.zeros((m, 4)),
        np.zeros(m),
        np.zeros(m),
        np.zeros((window.start.shape[0] - 1, window.prior_mean.shape[0])),
    )


@kernel
def roll_out(window: Window, z: Vector, path: Trajectory) -> float:
    """f(z); fills the path's states, residuals, innovations and gradients."""
    code, data, start = window.code, window.data, window.start
    noise_precision, gains = window.noise_precision, window.gains
    prior_mean, prior_root = window.prior_mean, window.prior_root
    dt, eps = window.dt, window.eps
    states, residuals, innovations = path.states, path.residuals, path.innovations
    units, predicted_units = path.units, path.predicted_units
    d = prior_mean.shape[0]
    with_gains = gains.shape[0] > 0
    corrections = noise_precision.shape[0] > 0
    value = 0.0
    for i in range(d):
        root = 0.0
        for j in range(i, d):
            root += prior_root[i, j] * (z[j] - prior_mean[j])
        value += root * root
    for i in range(d):
        states[0, i] = z[i]
    inputs = np.empty(d // 2)
    for k in range(start.shape[0] - 1):
        x = states[k]
        if k > 0:
            for i in range(d // 2):
                inputs[i] = window.accel[k - 1, i]
                if corrections:
                    w = z[d + (k - 1) * (d // 2) + i]
                    inputs[i] += w
                    value += noise_precision[k - 1, i] * w * w
            predict_state(states[k - 1], inputs, dt, x)
            if with_gains:
                for r in range(start[k], start[k + 1]):
                    innovations[r] = data[r, VALUE] - predict_row(code, data, r, x, eps, predicted_units[r])
                for r in range(start[k], start[k + 1]):
                    for j in range(d):
                        x[j] += gains[r, j] * innovations[r]
        for r in range(start[k], start[k + 1]):
            residual = data[r, VALUE] - predict_row(code, data, r, x, eps, units[r])
            residuals[r] = residual
            value += data[r, PRECISION] * residual * residual
    return 0.5 * value


@kernel
def gradient(window: Window, z: Vector, path: Trajectory, out: Vector) -> None:
    """out <- df/dz by the adjoint recursion, after `roll_out` at z.

    ``path.weights[r]`` is df / d residual_r (residual over variance for the plain objective, plus a bound's
    multiplier where it has one); ``path.predicted_weights[r]`` holds the direct weight of the innovation on
    entry and its total weight (with what the gain passes on) on return.
    """
    code, data, start = window.code, window.data, window.start
    noise_precision, gains = window.noise_precision, window.gains
    prior_mean, prior_root = window.prior_mean, window.prior_root
    dt = window.dt
    units, predicted_units = path.units, path.predicted_units
    weights, predicted_weights = path.weights, path.predicted_weights
    d = prior_mean.shape[0]
    with_gains = gains.shape[0] > 0
    corrections = noise_precision.shape[0] > 0
    adjoint = np.zeros(d)
    for k in range(start.shape[0] - 2, -1, -1):
        for i in range(d):
            adjoint[i] += path.state_weights[k, i]
        for r in range(start[k], start[k + 1]):
            add_gradient(code, data, r, units[r], -weights[r], adjoint)
        if k == 0:
            break
        if with_gains:
            for r in range(start[k], start[k + 1]):
                total = predicted_weights[r]
                for j in range(d):
                    total += gains[r, j] * adjoint[j]
                predicted_weights[r] = total
            for r in range(start[k], start[k + 1]):
                add_gradient(code, data, r, predicted_units[r], -predicted_weights[r], adjoint)
        if corrections:
            for s in range(d // 6):
                for i in range(3):
                    q = d + (k - 1) * (d // 2) + 3 * s + i
                    through_state = 0.5 * dt * dt * adjoint[6 * s + i] + dt * adjoint[6 * s + 3 + i]
                    out[q] = through_state + noise_precision[k - 1, 3 * s + i] * z[q]
        transpose_predict(adjoint, dt)
    for i in range(d):
        out[i] = adjoint[i]
    for i in range(d):  # prior: U'U (x_0 - mean)
        root = 0.0
        for j in range(i, d):
            root += prior_root[i, j] * (z[j] - prior_mean[j])
        for j in range(i, d):
            out[j] += prior_root[i, j] * root


@kernel
def hessian(window: Window, path: Trajectory, exact: bool, out: Matrix, sensitivities: Matrix) -> None:
    """out (upper triangle) <- Gauss-Newton or exact Hessian of f at the point of the last `roll_out`.

    The exact one needs the weights of `gradient`. ``sensitivities`` ``((N+1) d, variables)`` gets dx_k/dz
    after correction, stacked.
    """
    code, data, start = window.code, window.data, window.start
    noise_precision, prior_information = window.noise_precision, window.prior_information
    d = prior_information.shape[0]
    variables = out.shape[0]
    sens = np.zeros((d, variables))
    product = np.empty((d, variables))
    local = np.zeros((d, d))
    row = np.empty(variables)
    out[:, :] = 0.0
    for i in range(d):
        sens[i, i] = 1.0
        for j in range(i, d):
            out[i, j] = prior_information[i, j]
    for k in range(noise_precision.shape[0]):
        for i in range(d // 2):
            out[d + k * (d // 2) + i, d + k * (d // 2) + i] = noise_precision[k, i]
    for k in range(start.shape[0] - 1):
        first, last = start[k], start[k + 1]
        if k > 0:
            _advance_sensitivity(window, path, k, exact, sens, product, local, out)
        sensitivities[k * d : (k + 1) * d] = sens
        if exact or k == 0:
            local[:, :] = 0.0
            for r in range(first, last):
                second = -path.weights[r] if exact else 0.0
                add_curvature(code, data, r, path.units[r], data[r, PRECISION], second, local)
            if k == 0:
                for i in range(d):
                    for j in range(i, d):
                        out[i, j] += local[i, j]
            else:
                _add_congruence(sens, local, product, out)
        elif (last - first) * variables * variables < LIBRARY_WORK:
            for r in range(first, last):
                chain_gradient(code, data, r, path.units[r], sens, row)
                add_outer_upper(out, data[r, PRECISION], row)
        else:
            scaled = np.empty((last - first, variables))
            for r in range(first, last):
                chain_gradient(code, data, r, path.units[r], sens, scaled[r - first])
                scaled[r - first] *= np.sqrt(data[r, PRECISION])
            out += np.dot(np.ascontiguousarray(scaled.T), scaled)


@kernel
def correction_hessian(window: Window, path: Trajectory, exact: bool, out: Matrix) -> None:
    """Upper triangle of `hessian` for a window with corrections and without gains, by the adjoint recursion.

    Then x_k depends on the variables through A and B alone. With H_k the curvature of tick k's rows and
    M_k = H_k + A' M_{k+1} A, the blocks beside the prior's are M_0 for the start, (A^k)' M_k B for the start and the
    correction that acts until tick k, and B' (A^{k-i})' M_k B for those until ticks i <= k.
    """
    code, data, start, dt = window.code, window.data, window.start, window.dt
    d = window.prior_information.shape[0]
    inputs = d // 2
    ahead = np.zeros((d, d))  # M_k
    pushed = np.empty((d, inputs))  # (A^{k-i})' M_k B
    for k in range(start.shape[0] - 2, -1, -1):
        for r in range(start[k], start[k + 1]):
            second = -path.weights[r] if exact else 0.0
            add_curvature(code, data, r, path.units[r], data[r, PRECISION], second, ahead)
        if k == 0:
            break
        for i in range(d):
            for j in range(inputs):
                p = 6 * (j // 3) + j % 3
                pushed[i, j] = 0.5 * dt * dt * ahead[i, p] + dt * ahead[i, p + 3]
        column = d + (k - 1) * inputs
        for i in range(k, 0, -1):
            for a in range(inputs):
                p, q = 6 * (a // 3) + a % 3, d + (i - 1) * inputs + a
                for j in range(inputs):
                    out[q, column + j] = 0.5 * dt * dt * pushed[p, j] + dt * pushed[p + 3, j]
            transpose_predict_all(pushed, dt)
        out[:d, column : column + inputs] = pushed
        for i in range(inputs):
            out[column + i, column + i] += window.noise_precision[k - 1, i]
        transpose_predict_all(ahead, dt)
        transpose_predict_all(ahead.T, dt)
    for i in range(d):
        for j in range(i, d):
            out[i, j] = window.prior_information[i, j] + ahead[i, j]


@kernel
def _advance_sensitivity(
    window: Window,
    path: Trajectory,
    k: int,
    exact: bool,
    sens: Matrix,
    product: Matrix,
    local: Matrix,
    out: Matrix,
) -> None:
    """sens <- dx_k/dz from dx_{k-1}/dz; adds the curvature of the predicted rows to the exact Hessian."""
    code, data, gains, dt = window.code, window.data, window.gains, window.dt
    first, last = window.start[k], window.start[k + 1]
    d = sens.shape[0]
    predict_sensitivity(sens, dt)
    if window.noise_precision.shape[0] > 0:
        for s in range(d // 6):
            for i in range(3):
                column = d + (k - 1) * (d // 2) + 3 * s + i
                sens[6 * s + i, column] += 0.5 * dt * dt
                sens[6 * s + 3 + i, column] += dt
    if gains.shape[0] == 0 or first == last:
        return
    if exact:
        local[:, :] = 0.0
        for r in range(first, last):
            add_curvature(code, data, r, path.predicted_units[r], 0.0, -path.predicted_weights[r], local)
        _add_congruence(sens, local, product, out)
    rows = np.empty((last - first, sens.shape[1]))
    for r in range(first, last):
        chain_gradient(code, data, r, path.predicted_units[r], sens, rows[r - first])
    if (last - first) * d * sens.shape[1] >= LIBRARY_WORK:
        sens -= np.dot(np.ascontiguousarray(gains[first:last].T), rows)
        return
    for r in range(first, last):
        for i in range(d):
            factor = gains[r, i]
            if factor != 0.0:
                for j in range(sens.shape[1]):
                    sens[i, j] -= factor * rows[r - first, j]


@kernel
def _add_congruence(sens: Matrix, local: Matrix, product: Matrix, out: Matrix) -> None:
    """Upper triangle of out += sens' local sens."""
    d, variables = sens.shape
    multiply(local, sens, product)
    if d * variables * variables >= LIBRARY_WORK:
        out += np.dot(np.ascontiguousarray(sens.T), product)
        return
    for r in range(d):
        for i in range(variables):
            factor = sens[r, i]
            if factor != 0.0:
                for j in range(i, variables):
                    out[i, j] += factor * product[r, j]
