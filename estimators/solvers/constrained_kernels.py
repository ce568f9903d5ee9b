"""Compiled pieces of the constrained step; `estimators.solvers.constrained` puts them together with a QP engine.

A prepared window travels between the calls as the plain arrays of `Region` and `Window`.
"""

from __future__ import annotations

import numpy as np

from estimators.compiled.entries import entry, kernel
from estimators.compiled.linear_algebra import factor_upper, solve_upper_transposed
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import ROW, Matrix, RowTable, Vector
from estimators.model.motion import predict_sensitivity
from estimators.model.row_kernels import IntArray, chain_gradient
from estimators.solvers.gauss_newton import minimise, set_weights
from estimators.window.kernels import CORRECTED, arrival_update, write_states
from estimators.window.problem import (
    Trajectory,
    Window,
    empty_trajectory,
    gradient,
    hessian,
    roll_out,
)
from estimators.window.regional import Region, gather, regional_problem

_REGION = (
    "boolean, int64[::1], int64, float64[:, ::1], float64[::1], float64[:, ::1], float64[:, ::1]"
)
_WINDOW = (
    "int64[:, ::1], float64[:, ::1], int64[::1], float64[:, ::1], float64[:, ::1], float64[:, ::1],"
    " float64[::1], float64[:, ::1], float64[:, ::1], float64, float64"
)


@entry(
    f"Tuple(({_REGION}, {_WINDOW}, float64[::1], boolean))(ROW[::1], int64[::1], float64[:, ::1],"
    " float64[:, ::1], float64[:, ::1], float64[::1], int64[::1], float64, float64, boolean, int64, float64,"
    " float64[::1])",
    ROW=ROW,
)
def prepare(
    rows: RowTable,
    start: IntArray,
    accel: Matrix,
    accel_variance: Matrix,
    information: Matrix,
    vector: Vector,
    extra: IntArray,
    dt: float,
    eps: float,
    with_gains: bool,
    max_iterations: int,
    tolerance: float,
    first_state: Vector,
) -> tuple[
    bool, IntArray, int, Matrix, Vector, Matrix, Matrix,
    IntArray, Matrix, IntArray, Matrix, Matrix, Matrix, Vector, Matrix, Matrix, float, float,
    Vector, bool,
]:  # fmt: skip
    """Region, window, unconstrained optimum z and whether it was reached; arguments as `moving_horizon_step`.

    ``first_state`` ``(6n,)`` is that optimum's first state: all of z with pre-estimation, computed again
    without.
    """
    region, w = regional_problem(
        rows, start, accel, accel_variance, information, vector, extra, dt, eps, with_gains
    )
    d = w.prior_mean.shape[0]
    z = np.zeros(d + w.noise_precision.size)
    z[:d] = w.prior_mean
    converged = False
    if with_gains:
        gather(first_state, region.order, region.outside, STATES_PER_AGENT, z)
        converged = True
    elif region.definite:
        converged = minimise(w, z, max_iterations, tolerance)[3]
    return (
        region.definite, region.order, region.outside, region.root, region.mean, region.covariance,
        region.base_units,
        w.code, w.data, w.start, w.accel, w.noise_precision, w.gains, w.prior_mean, w.prior_root,
        w.prior_information, w.dt, w.eps,
        z, converged,
    )  # fmt: skip


@entry(f"float64({_WINDOW}, float64[::1], int64, float64[:, ::1], float64[::1])")
def evaluate(
    code: IntArray,
    data: Matrix,
    start: IntArray,
    accel: Matrix,
    noise_precision: Matrix,
    gains: Matrix,
    prior_mean: Vector,
    prior_root: Matrix,
    prior_information: Matrix,
    dt: float,
    eps: float,
    z: Vector,
    bounds_on: int,
    states: Matrix,
    bounded: Vector,
) -> float:
    """Objective f(z); fills the states ``(N+1, d)`` and the residuals ``(m,)`` that noise bounds hold for."""
    window = Window(
        code, data, start, accel, noise_precision, gains, prior_mean, prior_root, prior_information, dt, eps
    )
    path = empty_trajectory(window)
    value = roll_out(window, z, path)
    states[:, :] = path.states
    bounded[:] = path.residuals if bounds_on == CORRECTED else path.innovations
    return value


@entry(
    f"boolean({_WINDOW}, float64[::1], int64, float64[::1], float64[:, ::1], boolean, boolean, float64[::1],"
    " float64[:, ::1], float64[:, ::1])"
)
def linearise_bounds(
    code: IntArray,
    data: Matrix,
    start: IntArray,
    accel: Matrix,
    noise_precision: Matrix,
    gains: Matrix,
    prior_mean: Vector,
    prior_root: Matrix,
    prior_information: Matrix,
    dt: float,
    eps: float,
    z: Vector,
    bounds_on: int,
    multipliers: Vector,
    state_multipliers: Matrix,
    exact: bool,
    boxed: bool,
    linear: Vector,
    inverse_root: Matrix,
    rows: Matrix,
) -> bool:
    """One quadratic program at z, in the variables q = U step with U'U the Hessian.

    The Hessian is Gauss-Newton's of f, or (``exact``, where it is definite) the Lagrangian's with
    ``multipliers`` ``(m,)`` on the bounded residuals and ``state_multipliers`` ``(N+1, d)`` on the states.
    ``linear`` gets U'^-1 df/dz, ``inverse_root`` U^-1, and ``rows`` ``(m + (N+1) d, variables)`` the
    derivatives of the bounded residuals and, if ``boxed``, of the states, times U^-1. False where the
    Hessian cannot be factored.
    """
    window = Window(
        code, data, start, accel, noise_precision, gains, prior_mean, prior_root, prior_information, dt, eps
    )
    path = empty_trajectory(window)
    roll_out(window, z, path)
    set_weights(window, path)
    gradient(window, z, path, linear)
    n = z.shape[0]
    curvature = np.empty((n, n))
    sensitivities = np.empty((path.states.size, n))
    if exact:
        set_weights(window, path)
        for r in range(code.shape[0]):
            if bounds_on == CORRECTED:
                path.weights[r] += multipliers[r]
            else:
                path.predicted_weights[r] = multipliers[r]
        path.state_weights[:, :] = state_multipliers
        gradient(window, z, path, np.empty(n))
        hessian(window, path, True, curvature, sensitivities)
        exact = factor_upper(curvature)
    if not exact:
        hessian(window, path, False, curvature, sensitivities)
        if not factor_upper(curvature):
            return False
    _invert_upper(curvature, inverse_root)
    solve_upper_transposed(curvature, linear)
    slopes = np.empty((code.shape[0], n))
    _bound_slopes(window, path, bounds_on, sensitivities, slopes)
    m = code.shape[0]
    rows[:m] = np.dot(slopes, inverse_root)
    if boxed:
        rows[m:] = np.dot(sensitivities, inverse_root)
    else:
        rows[m:] = 0.0
    return True


@kernel
def _invert_upper(u: Matrix, out: Matrix) -> None:
    """out <- U^-1, upper triangular."""
    n = u.shape[0]
    out[:, :] = 0.0
    for i in range(n - 1, -1, -1):
        scale = 1.0 / u[i, i]
        out[i, i] = scale
        for j in range(i + 1, n):
            factor = -u[i, j] * scale
            for k in range(j, n):
                out[i, k] += factor * out[j, k]


@kernel
def _bound_slopes(
    window: Window, path: Trajectory, bounds_on: int, sensitivities: Matrix, out: Matrix
) -> None:
    """Derivatives of the bounded residuals: -C dx/dz after correction, or before it (innovations).

    Innovations are bounded only with gains (`bound_kind` in `estimators.solvers.constrained`): z is then the
    first state alone.
    """
    d = window.prior_mean.shape[0]
    out[:, :] = 0.0
    for k in range(1, window.start.shape[0] - 1):
        if bounds_on == CORRECTED:
            sens = sensitivities[k * d : (k + 1) * d].copy()
        else:
            sens = sensitivities[(k - 1) * d : k * d].copy()
            predict_sensitivity(sens, window.dt)
        units = path.units if bounds_on == CORRECTED else path.predicted_units
        for r in range(window.start[k], window.start[k + 1]):
            chain_gradient(window.code, window.data, r, units[r], sens, out[r])
    for r in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[r, j] = -out[r, j]


@entry(
    f"boolean({_REGION}, {_WINDOW}, float64[::1], ROW[::1], float64[:, ::1], float64[:, ::1],"
    " float64[:, ::1], float64[:, ::1], float64[:, ::1])",
    ROW=ROW,
)
def finish(
    definite: bool,
    order: IntArray,
    outside: int,
    root: Matrix,
    mean: Vector,
    covariance: Matrix,
    base_units: Matrix,
    code: IntArray,
    data: Matrix,
    start: IntArray,
    accel: Matrix,
    noise_precision: Matrix,
    gains: Matrix,
    prior_mean: Vector,
    prior_root: Matrix,
    prior_information: Matrix,
    dt: float,
    eps: float,
    z: Vector,
    rows: RowTable,
    fleet_accel: Matrix,
    fleet_accel_variance: Matrix,
    information: Matrix,
    states: Matrix,
    next_information: Matrix,
) -> bool:
    """From z to the fleet's states ``(N+1, 6n)`` and the next arrival cost; see `moving_horizon_step`."""
    region = Region(definite, order, outside, root, mean, covariance, base_units)
    window = Window(
        code, data, start, accel, noise_precision, gains, prior_mean, prior_root, prior_information, dt, eps
    )
    path = empty_trajectory(window)
    roll_out(window, z, path)
    write_states(region, window, path, fleet_accel, True, states)
    updates = rows[start[1] : start[2]]
    return arrival_update(information, updates, states[1], fleet_accel_variance[0], dt, eps, next_information)
