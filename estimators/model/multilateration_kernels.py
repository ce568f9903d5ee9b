"""Compiled descents of `estimators.model.multilateration`: an attempt to locate a drone has to fit into a tick."""

from __future__ import annotations

import numpy as np

from estimators.compiled.entries import entry, kernel
from estimators.compiled.linear_algebra import cholesky_upper, solve_upper, solve_upper_transposed
from estimators.model.measurements import Matrix, Vector

ITERATIONS = 40
CONVERGED = 1e-6
"""Gain of a step, in cost, below which a descent has arrived."""
WEAK = 1e-8
"""Position information (1/m2) added so that a covariance exists: a sigma of 10 km."""
_TINY_M2 = 1e-12
"""Added to a squared distance: a start may lie on an anchor."""
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-9, 1e9


@entry("float64[::1](float64[:, ::1], float64[:, ::1], float64[:, ::1], float64)")
def descend(states: Matrix, ends: Matrix, ranges: Matrix, speed_sigma_mps: float) -> Vector:
    """Levenberg-Marquardt from each of ``states`` ``(s, 6)``, which are replaced by where it ends; costs ``(s,)``.

    ``ends`` ``(m, 3)``: the far ends less the displacement by acceleration. ``ranges`` ``(m, 3)``: lead (s), range
    (m), weight (1/m), the inverse 1-sigma.
    """
    costs = np.empty(states.shape[0])
    hessian, gradient, tried = np.empty((6, 6)), np.empty(6), np.empty(6)
    for s in range(states.shape[0]):
        state = states[s]
        cost = _linearise(state, ends, ranges, speed_sigma_mps, hessian, gradient)
        damping = _FIRST_DAMPING
        for _ in range(ITERATIONS):
            tried_cost = np.inf
            for i in range(6):
                hessian[i, i] *= 1.0 + damping
                tried[i] = gradient[i]
            if cholesky_upper(hessian):
                solve_upper_transposed(hessian, tried)
                solve_upper(hessian, tried)
                for i in range(6):
                    tried[i] = state[i] - tried[i]
                tried_cost = _cost(tried, ends, ranges, speed_sigma_mps)
            gain = cost - tried_cost
            if gain > 0.0:
                state[:] = tried
                damping = max(damping / 5.0, _LEAST_DAMPING)
            else:
                damping = min(damping * 4.0, _MOST_DAMPING)
            if 0.0 <= gain < CONVERGED:
                break
            cost = _linearise(state, ends, ranges, speed_sigma_mps, hessian, gradient)
        costs[s] = _cost(state, ends, ranges, speed_sigma_mps)
    return costs


@kernel
def _cost(state: Vector, ends: Matrix, ranges: Matrix, speed_sigma_mps: float) -> float:
    """Squared whitened residuals of a state, and the prior on its velocity."""
    total: float = (state[3] ** 2 + state[4] ** 2 + state[5] ** 2) / speed_sigma_mps**2
    for k in range(ends.shape[0]):
        lead = ranges[k, 0]
        north = state[0] + lead * state[3] - ends[k, 0]
        east = state[1] + lead * state[4] - ends[k, 1]
        down = state[2] + lead * state[5] - ends[k, 2]
        distance = np.sqrt(north * north + east * east + down * down + _TINY_M2)
        total += ((distance - ranges[k, 1]) * ranges[k, 2]) ** 2
    return total


@kernel
def _linearise(
    state: Vector, ends: Matrix, ranges: Matrix, speed_sigma_mps: float, hessian: Matrix, gradient: Vector
) -> float:
    """Fill the Gauss-Newton ``hessian`` ``(6, 6)`` (upper triangle) and ``gradient`` ``(6,)``; the cost."""
    hessian[:] = 0.0
    total = 0.0
    for i in range(3):
        hessian[i, i] = WEAK
        hessian[3 + i, 3 + i] = 1.0 / speed_sigma_mps**2
        gradient[i] = 0.0
        gradient[3 + i] = state[3 + i] / speed_sigma_mps**2
        total += state[3 + i] * gradient[3 + i]
    slope = np.empty(6)
    for k in range(ends.shape[0]):
        lead, weight = ranges[k, 0], ranges[k, 2]
        away2 = _TINY_M2
        for i in range(3):
            slope[i] = state[i] + lead * state[3 + i] - ends[k, i]
            away2 += slope[i] * slope[i]
        distance = np.sqrt(away2)
        residual = (distance - ranges[k, 1]) * weight
        total += residual * residual
        for i in range(3):
            slope[i] *= weight / distance
            slope[3 + i] = lead * slope[i]
        for i in range(6):
            gradient[i] += residual * slope[i]
            for j in range(i, 6):
                hessian[i, j] += slope[i] * slope[j]
    return total
