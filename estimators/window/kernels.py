"""The compiled step of a moving horizon estimator: from the fused prior to the next one, in one call.

The optimisation runs over the agents R of the window's rows (`estimators.window.regional`); the states of the others
follow from one triangular solve:

    x_O = mean_O - U_OO^-1 U_OR ((z - mean_R) + Pi_RR s)

where s collects the innovations that the frozen gains carry into O over the window (`_carried`).
"""

from __future__ import annotations

import numpy as np

from estimators.compiled.entries import entry, kernel
from estimators.compiled.linear_algebra import factor_upper, inverse_from_cholesky, solve_upper
from estimators.consensus.information import PAIRS, Pairs, combine
from estimators.model.corrections import add_row_information
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import Matrix, Vector
from estimators.model.motion import predict_information, predict_state, transpose_predict
from estimators.model.row_kernels import (
    HALF_WIDTH,
    PRECISION,
    add_gradient,
    encode_rows,
)
from estimators.solvers.gauss_newton import minimise
from estimators.window.least_squares import Trajectory, Window
from estimators.window.pre_estimation import pre_estimate
from estimators.window.problem import (
    CORRECTED,
    NOTHING,
    OPTIONS,
    PROBLEM,
    StepOptions,
    WindowProblem,
)
from estimators.window.regional import Region, regional_problem, scatter

CONVERGED = 0
NOT_CONVERGED = 1
UNUSABLE = 2
"""The prior is not positive definite, or a result is not finite."""


@kernel
def _carried(window: Window, path: Trajectory, base_units: Matrix, ticks: int) -> Vector:
    """s of the module's text for the first ``ticks`` ticks: sum_k Psi_k' C_k' R^-1 innovation_k."""
    code, data, start = window.code, window.data, window.start
    carried = np.zeros(window.prior_mean.shape[0])
    for k in range(ticks, 0, -1):
        for r in range(start[k], start[k + 1]):
            add_gradient(code, data, r, base_units[r], data[r, PRECISION] * path.innovations[r], carried)
        through = np.zeros(start[k + 1] - start[k])
        for r in range(start[k], start[k + 1]):
            for j in range(carried.shape[0]):
                through[r - start[k]] += window.gains[r, j] * carried[j]
        for r in range(start[k], start[k + 1]):
            add_gradient(code, data, r, base_units[r], -through[r - start[k]], carried)
        transpose_predict(carried, window.dt)
    return carried


@kernel
def _outside_states(
    region: Region, change: Vector, accel: Matrix, dt: float, ticks: int, out: Vector
) -> None:
    """Write the states of the agents outside R after ``ticks`` ticks into ``out`` ``(6n,)``, by slot."""
    outside, order = region.outside, region.order
    d_out = STATES_PER_AGENT * outside
    x = np.empty(d_out)
    for i in range(d_out):
        total = 0.0
        for j in range(change.shape[0]):
            total += region.root[i, d_out + j] * change[j]
        x[i] = -total
    solve_upper(region.root[:d_out, :d_out], x)
    for i in range(d_out):
        x[i] += region.mean[i]
    inputs = np.empty(3 * outside)
    for k in range(ticks):
        for a in range(outside):
            for i in range(3):
                inputs[3 * a + i] = accel[k, 3 * order[a] + i]
        predict_state(x, inputs, dt, x)
    for a in range(outside):
        for i in range(STATES_PER_AGENT):
            out[STATES_PER_AGENT * order[a] + i] = x[STATES_PER_AGENT * a + i]


@kernel
def arrival_update(problem: WindowProblem, state: Vector, eps: float, out: Matrix) -> bool:
    """out <- information of (17)-(18): predicted over one tick, updated by its rows linearised at ``state``."""
    out[:, :] = problem.information
    if not predict_information(out, problem.accel_variance[0], problem.period_s):
        return False
    add_row_information(problem.rows[problem.start[1] : problem.start[2]], state, eps, out)
    return True


@entry(
    "Tuple((int64, int64, float64, boolean))(PAIRS, PROBLEM, OPTIONS, float64[:, ::1], float64[:, ::1])",
    PAIRS=PAIRS,
    PROBLEM=PROBLEM,
    OPTIONS=OPTIONS,
)
def moving_horizon_step(
    pairs: Pairs, problem: WindowProblem, options: StepOptions, states: Matrix, next_information: Matrix
) -> tuple[int, int, float, bool]:
    """One unconstrained step: consensus (13)-(16), window optimum (5)-(10), next arrival cost (17)-(18).

    Parameters
    ----------
    pairs
        What is to be fused into the problem's prior; without any, it is fused already.
    problem, options
        The window, and how to solve it. The bounds of the options are checked afterwards.
    states : ``(N+1, 6n)``, out
        States of the window given everything in it. Agents outside the optimisation are exact at the first
        two ticks and the last, and at the others only where there is a box (nothing else needs them).
    next_information : ``(6n, 6n)``, out
        Prior information for a window that starts one tick later, before consensus.

    Returns
    -------
    status (`CONVERGED`, `NOT_CONVERGED`, `UNUSABLE`), iterations, optimal cost (9) without factor 1/2,
    whether all bounds hold.
    """
    pairs, problem, options = Pairs(*pairs), WindowProblem(*problem), StepOptions(*options)
    if pairs.weights.shape[0] > 0:
        combine(pairs, problem.information, problem.vector)
    region, window = regional_problem(problem, options.eps)
    if not region.definite:
        return UNUSABLE, 0, 0.0, True
    d = window.prior_mean.shape[0]
    z = np.zeros(d + window.noise_precision.size)
    z[:d] = window.prior_mean
    path, value, iterations, converged = minimise(window, z, options.max_iterations, options.tolerance)
    box_position, box_speed = options.box_position, options.box_speed
    boxed = np.isfinite(box_position) or np.isfinite(box_speed)
    write_states(region, window, path, problem.accel, boxed, states)
    hold = bounds_hold(window, path, options.bounds_on) and (not boxed or in_box(states, box_position, box_speed))
    if not arrival_update(problem, states[1], options.eps, next_information):
        return UNUSABLE, iterations, 2.0 * value, hold
    if not (np.isfinite(states).all() and np.isfinite(next_information).all()):
        return UNUSABLE, iterations, 2.0 * value, hold
    return (CONVERGED if converged else NOT_CONVERGED), iterations, 2.0 * value, hold


@kernel
def bounds_hold(window: Window, path: Trajectory, bounds_on: int) -> bool:
    """Whether every residual after the first tick (8) is within its sensor's bound."""
    if bounds_on == NOTHING:
        return True
    for r in range(window.start[1], window.code.shape[0]):
        residual = path.residuals[r] if bounds_on == CORRECTED else path.innovations[r]
        if abs(residual) > window.data[r, HALF_WIDTH]:
            return False
    return True


@kernel
def in_box(states: Matrix, box_position: float, box_speed: float) -> bool:
    """Whether every position and velocity component of all states is within its bound."""
    for k in range(states.shape[0]):
        for i in range(states.shape[1]):
            limit = box_position if i % STATES_PER_AGENT < 3 else box_speed
            if abs(states[k, i]) > limit:
                return False
    return True


@kernel
def write_states(
    region: Region, window: Window, path: Trajectory, accel: Matrix, all_ticks: bool, states: Matrix
) -> None:
    """states ``(N+1, 6n)`` <- the fleet along the window, see `moving_horizon_step`."""
    ticks = accel.shape[0]
    d = window.prior_mean.shape[0]
    for tick in range(ticks + 1):
        scatter(path.states[tick], region.order, region.outside, states[tick])
        if region.outside == 0:
            continue
        change = path.states[0] - window.prior_mean
        exact = all_ticks or tick == 1 or tick == ticks
        if window.gains.shape[0] > 0 and tick > 0 and exact:
            carried = _carried(window, path, region.base_units, tick)
            for i in range(d):
                for j in range(d):
                    change[i] += region.covariance[i, j] * carried[j]
        _outside_states(region, change, accel, window.dt, tick, states[tick])


@entry(
    "boolean(PROBLEM, float64[::1], float64, float64[::1], float64[:, ::1])",
    PROBLEM=PROBLEM,
)
def filter_window(problem: WindowProblem, prior_mean: Vector, eps: float, mean: Vector, covariance: Matrix) -> bool:
    """Run the EKF of the pre-estimation over a window for the whole fleet, from its fused prior.

    ``prior_mean`` ``(6n,)`` is that of the prior. Gives the mean ``(6n,)`` at the window's end and Pi_pre,t|t (22)
    ``(6n, 6n)``; the window's first rows are not used, as in (20)-(23). False where the prior is not positive
    definite.
    """
    problem = WindowProblem(*problem)
    rows = problem.rows
    agents = prior_mean.shape[0] // STATES_PER_AGENT
    root = problem.information.copy()
    if not factor_upper(root):
        return False
    inverse_from_cholesky(root, covariance)
    m = rows.shape[0]
    code = np.empty((m, 3), np.int64)
    data = np.empty((m, 7))
    encode_rows(rows, np.arange(agents), code, data)
    gains = np.zeros((m, prior_mean.shape[0]))
    units = np.zeros((m, 4))
    mean[:] = prior_mean
    pre_estimate(
        code, data, problem.start, problem.accel, problem.accel_variance, mean, problem.period_s, eps,
        covariance, gains, units,
    )  # fmt: skip
    return True
