"""Our own step and that of DEKF-CI, as the agents run them, on captured windows."""

from __future__ import annotations

import numpy as np

from estimators.algorithms.dekf_ci import predict_and_correct, recover
from estimators.consensus.information import fuse
from estimators.estimator import Payload
from estimators.model.measurements import Matrix, Vector
from estimators.settings import EstimatorSettings
from estimators.window.problem import WindowSolution
from estimators.window.solving import pre_estimation, solve_window
from fleetloc.bench.speed.windows import PERIOD_S, BenchWindow


def our_step(window: BenchWindow, settings: EstimatorSettings) -> WindowSolution:
    """Consensus fuse, window, next arrival cost."""
    problem, pairs = window.unfused_problem()
    return solve_window(problem, settings, pairs=pairs)


def our_step_with_covariance(window: BenchWindow, settings: EstimatorSettings) -> WindowSolution:
    """The same, and the covariance (22) that the agent publishes with its estimate."""
    problem, pairs = window.unfused_problem()
    solution = solve_window(problem, settings, pairs=pairs)
    pre_estimation(problem, settings.norm_smoothing_m)
    return solution


def filter_step(window: BenchWindow, settings: EstimatorSettings) -> tuple[Vector, Matrix]:
    """Predict, correct, consensus fuse, mean ``(6n,)`` and covariance ``(6n, 6n)``: one tick of DEKF-CI."""
    step = window.filter_step
    predicted, information = step.mean.copy(), step.information.copy()
    vector, mean, covariance = np.empty_like(predicted), np.empty_like(predicted), np.empty_like(information)
    eps = settings.norm_smoothing_m
    arguments = (step.rows, step.accel, step.accel_variance, PERIOD_S, eps, True)
    healthy = predict_and_correct(*arguments, predicted, information, vector)
    ranks = {agent: payload.rank for agent, payload in step.received.items()}
    pair = fuse(Payload(0, information, vector, step.rank), step.received, "observability_rank", ranks)
    if not (healthy and recover(*pair, mean, covariance)):
        raise np.linalg.LinAlgError("DEKF-CI: the information of a captured window is not positive definite")
    return mean, covariance
