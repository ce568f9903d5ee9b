"""Compiled pieces of the constrained step; `estimators.solvers.constrained` puts them together with a QP engine."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimators.compiled.entries import entry, kernel, structure
from estimators.compiled.linear_algebra import factor_upper, solve_upper_transposed
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import Matrix, Vector
from estimators.model.motion import predict_sensitivity
from estimators.model.row_kernels import chain_gradient
from estimators.solvers.gauss_newton import minimise, set_weights
from estimators.window.kernels import arrival_update, write_states
from estimators.window.least_squares import (
    WINDOW,
    Trajectory,
    Window,
    empty_trajectory,
    gradient,
    hessian,
    roll_out,
)
from estimators.window.problem import CORRECTED, OPTIONS, PROBLEM, StepOptions, WindowProblem
from estimators.window.regional import REGION, Region, gather, regional_problem


class PreparedWindow(NamedTuple):
    """A window ready for the constrained step."""

    region: Region
    window: Window
    z: Vector
    """Its unconstrained optimum."""
    converged: bool
    """Whether that was reached."""


PREPARED_WINDOW = structure(PreparedWindow, "REGION, WINDOW, float64[::1], boolean", REGION=REGION, WINDOW=WINDOW)


@entry("PREPARED(PROBLEM, OPTIONS, float64[::1])", PREPARED=PREPARED_WINDOW, PROBLEM=PROBLEM, OPTIONS=OPTIONS)
def prepare(problem: WindowProblem, options: StepOptions, first_state: Vector) -> PreparedWindow:
    """Reduce a window and give its unconstrained optimum.

    ``first_state`` ``(6n,)`` is that optimum's first state: all of z with pre-estimation, computed again
    without.
    """
    problem, options = WindowProblem(*problem), StepOptions(*options)
    region, w = regional_problem(problem, options.eps)
    d = w.prior_mean.shape[0]
    z = np.zeros(d + w.noise_precision.size)
    z[:d] = w.prior_mean
    converged = False
    if problem.with_gains:
        gather(first_state, region.order, region.outside, STATES_PER_AGENT, z)
        converged = True
    elif region.definite:
        converged = minimise(w, z, options.max_iterations, options.tolerance)[3]
    return PreparedWindow(region, w, z, converged)


@entry("float64(WINDOW, float64[::1], int64, float64[:, ::1], float64[::1])", WINDOW=WINDOW)
def evaluate(window: Window, z: Vector, bounds_on: int, states: Matrix, bounded: Vector) -> float:
    """Objective f(z); fills the states ``(N+1, d)`` and the residuals ``(m,)`` that noise bounds hold for."""
    window = Window(*window)
    path = empty_trajectory(window)
    value = roll_out(window, z, path)
    states[:, :] = path.states
    bounded[:] = path.residuals if bounds_on == CORRECTED else path.innovations
    return value


class BoundPoint(NamedTuple):
    """Where bounds are linearised, and what holds there."""

    z: Vector
    multipliers: Vector
    """``(m,)`` on the bounded residuals."""
    state_multipliers: Matrix
    """``(N+1, d)`` on the states."""
    bounds_on: int
    boxed: bool
    """Whether the states are bounded."""


class LinearProgram(NamedTuple):
    """Room for the quadratic program at a point, in the variables q = U step with U'U the Hessian."""

    linear: Vector
    """U'^-1 df/dz."""
    inverse_root: Matrix
    """U^-1."""
    rows: Matrix
    """``(m + (N+1) d, variables)``: derivatives of bounded residuals and, if ``boxed``, of the states, times U^-1."""


POINT = structure(BoundPoint, "float64[::1], float64[::1], float64[:, ::1], int64, boolean")
PROGRAM = structure(LinearProgram, "float64[::1], float64[:, ::1], float64[:, ::1]")


@entry("boolean(WINDOW, POINT, boolean, PROGRAM)", WINDOW=WINDOW, POINT=POINT, PROGRAM=PROGRAM)
def linearise_bounds(window: Window, point: BoundPoint, exact: bool, out: LinearProgram) -> bool:
    """out <- one quadratic program at a point.

    The Hessian is Gauss-Newton's of f, or (``exact``, where it is definite) the Lagrangian's with the point's
    multipliers. False where it cannot be factored.
    """
    window, point, out = Window(*window), BoundPoint(*point), LinearProgram(*out)
    z, bounds_on, linear = point.z, point.bounds_on, out.linear
    path = empty_trajectory(window)
    roll_out(window, z, path)
    set_weights(window, path)
    gradient(window, z, path, linear)
    n = z.shape[0]
    m = window.code.shape[0]
    curvature = np.empty((n, n))
    sensitivities = np.empty((path.states.size, n))
    if exact:
        set_weights(window, path)
        for r in range(m):
            if bounds_on == CORRECTED:
                path.weights[r] += point.multipliers[r]
            else:
                path.predicted_weights[r] = point.multipliers[r]
        path.state_weights[:, :] = point.state_multipliers
        gradient(window, z, path, np.empty(n))
        hessian(window, path, True, curvature, sensitivities)
        exact = factor_upper(curvature)
    if not exact:
        hessian(window, path, False, curvature, sensitivities)
        if not factor_upper(curvature):
            return False
    _invert_upper(curvature, out.inverse_root)
    solve_upper_transposed(curvature, linear)
    slopes = np.empty((m, n))
    _bound_slopes(window, path, bounds_on, sensitivities, slopes)
    out.rows[:m] = np.dot(slopes, out.inverse_root)
    if point.boxed:
        out.rows[m:] = np.dot(sensitivities, out.inverse_root)
    else:
        out.rows[m:] = 0.0
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
    "boolean(REGION, WINDOW, float64[::1], PROBLEM, float64[:, ::1], float64[:, ::1])",
    REGION=REGION,
    WINDOW=WINDOW,
    PROBLEM=PROBLEM,
)
def finish(
    region: Region, window: Window, z: Vector, problem: WindowProblem, states: Matrix, next_information: Matrix
) -> bool:
    """From z to the fleet's states ``(N+1, 6n)`` and the next arrival cost; see `moving_horizon_step`."""
    region, window, problem = Region(*region), Window(*window), WindowProblem(*problem)
    path = empty_trajectory(window)
    roll_out(window, z, path)
    write_states(region, window, path, problem.accel, True, states)
    return arrival_update(problem, states[1], window.eps, next_information)
