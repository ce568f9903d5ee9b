"""Solving one window: the unconstrained step first, the constrained one only where a bound does not hold."""

from __future__ import annotations

import numpy as np

from estimators.compiled.entries import plain
from estimators.consensus.information import NO_PAIRS, Pairs
from estimators.estimator import SolverReport, Status
from estimators.model.measurements import Matrix, Vector
from estimators.model.motion import predict_mean
from estimators.settings import EstimatorSettings
from estimators.solvers.constrained import solve_constrained, step_options
from estimators.window.kernels import NOT_CONVERGED, UNUSABLE, filter_window, moving_horizon_step
from estimators.window.problem import WindowProblem, WindowSolution


def solve_window(
    problem: WindowProblem, settings: EstimatorSettings, budget: int | None = None, pairs: Pairs = NO_PAIRS
) -> WindowSolution:
    """Optimum of (5)-(10) and the next arrival cost (17)-(18), with at most ``budget`` iterations.

    ``pairs``, the last round of consensus, are fused first: into the problem's prior, which is room for it.
    Falls back to the pre-estimate, and says so in the status, where the optimisation cannot be run.
    """
    n = len(problem.vector)
    path, next_information = np.empty((len(problem.accel) + 1, n)), np.empty((n, n))
    limit = settings.max_iterations if budget is None else min(budget, settings.max_iterations)
    options = step_options(settings, problem.with_gains, limit)
    outcome, iterations, cost, bounds_hold = moving_horizon_step(
        plain(pairs), plain(problem), plain(options), path, next_information
    )
    if outcome == UNUSABLE:
        return _fallback(problem)
    if not bounds_hold:
        return solve_constrained(problem, settings, limit, path) or _fallback(problem)
    status = Status.NOT_CONVERGED if outcome == NOT_CONVERGED else Status.OK
    return WindowSolution(path, next_information, status, SolverReport(iterations=iterations, cost=cost))


def pre_estimation(problem: WindowProblem, norm_smoothing: float) -> tuple[Vector, Matrix]:
    """Mean ``(6n,)`` and covariance ``(6n, 6n)`` (22) of the EKF through the window, from its fused prior.

    Raises ``numpy.linalg.LinAlgError`` where the prior information is not positive definite.
    """
    n = len(problem.vector)
    mean, covariance = np.empty(n), np.empty((n, n))
    if not filter_window(plain(problem), _prior_mean(problem), norm_smoothing, mean, covariance):
        raise np.linalg.LinAlgError("the prior information of the window is not positive definite")
    return mean, covariance


def _prior_mean(problem: WindowProblem) -> Vector:
    """The mean (16) of the fused prior."""
    return np.asarray(np.linalg.solve(problem.information, problem.vector), np.float64)


def _fallback(problem: WindowProblem) -> WindowSolution:
    """The prior carried through the window without measurements."""
    prior_mean = _prior_mean(problem)
    path = np.empty((len(problem.accel) + 1, len(prior_mean)))
    path[0] = prior_mean
    for k, accel in enumerate(problem.accel):
        path[k + 1] = predict_mean(path[k], accel, problem.period_s)
    return WindowSolution(path, problem.information.copy(), Status.FELL_BACK, SolverReport())
