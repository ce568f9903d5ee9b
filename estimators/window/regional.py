"""Reduction of a window to the agents that its rows touch, and what is needed to come back to the fleet.

Every row of a window touches only a few agents, R: the neighbourhood and those it ranges. Seen from R the
arrival cost is its Schur complement, so the optimisation runs over R alone, whatever the fleet's size, and is
exact. With the prior information ordered (O, R), O the agents outside, and factored as U'U, the complement is
U_RR' U_RR.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimators.compiled.entries import kernel, structure
from estimators.compiled.linear_algebra import cholesky_solve, factor_upper, inverse_from_cholesky
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import Matrix, RowTable, Vector
from estimators.model.row_kernels import IntArray, encode_rows
from estimators.window.least_squares import Window
from estimators.window.pre_estimation import pre_estimate
from estimators.window.problem import WindowProblem


@kernel
def regional_order(rows: RowTable, extra: IntArray, agents: int) -> tuple[IntArray, int]:
    """Slots, outside first, and how many are outside; ``extra`` slots count as regional."""
    regional = np.zeros(agents, np.bool_)
    for i in range(extra.shape[0]):
        regional[extra[i]] = True
    for r in range(rows.shape[0]):
        row = rows[r]
        regional[row["agent"]] = True
        if row["other"] >= 0:
            regional[row["other"]] = True
    order = np.empty(agents, np.int64)
    outside = 0
    for s in range(agents):
        if not regional[s]:
            order[outside] = s
            outside += 1
    at = outside
    for s in range(agents):
        if regional[s]:
            order[at] = s
            at += 1
    return order, outside


@kernel
def _permuted(information: Matrix, order: IntArray) -> Matrix:
    n = information.shape[0]
    out = np.empty((n, n))
    for a in range(order.shape[0]):
        for b in range(order.shape[0]):
            p = STATES_PER_AGENT * order[a]
            q = STATES_PER_AGENT * order[b]
            for i in range(STATES_PER_AGENT):
                for j in range(STATES_PER_AGENT):
                    out[STATES_PER_AGENT * a + i, STATES_PER_AGENT * b + j] = information[p + i, q + j]
    return out


@kernel
def gather(vector: Vector, order: IntArray, first: int, width: int, out: Vector) -> None:
    """out <- blocks ``order[first:]`` of ``vector``, ``width`` entries each."""
    for a in range(first, order.shape[0]):
        for i in range(width):
            out[width * (a - first) + i] = vector[width * order[a] + i]


@kernel
def scatter(vector: Vector, order: IntArray, first: int, out: Vector) -> None:
    """Blocks ``order[first:]`` of out <- vector."""
    for a in range(first, order.shape[0]):
        for i in range(STATES_PER_AGENT):
            out[STATES_PER_AGENT * order[a] + i] = vector[STATES_PER_AGENT * (a - first) + i]


class Region(NamedTuple):
    """How a window's problem sits in the fleet: what is needed to come back from R to all agents."""

    definite: bool
    """Whether the prior information could be factored; nothing else holds if not."""
    order: IntArray
    """``(n,)`` slots, outside first."""
    outside: int
    """How many agents are outside R."""
    root: Matrix
    """``(6n, 6n)`` U of the prior information in that order."""
    mean: Vector
    """``(6n,)`` prior mean in that order."""
    covariance: Matrix
    """``(d, d)`` prior covariance Pi_RR."""
    base_units: Matrix
    """``(m, 4)`` gradients that the frozen gains were computed with."""


REGION = structure(
    Region,
    "boolean, int64[::1], int64, float64[:, ::1], float64[::1], float64[:, ::1], float64[:, ::1]",
)


@kernel
def regional_problem(problem: WindowProblem, eps: float) -> tuple[Region, Window]:
    """Reduce a window to the agents of its rows."""
    rows, start, dt, with_gains = problem.rows, problem.start, problem.period_s, problem.with_gains
    accel, accel_variance = problem.accel, problem.accel_variance
    information = problem.information
    agents = information.shape[0] // STATES_PER_AGENT
    order, outside = regional_order(rows, problem.keep, agents)
    regional = agents - outside
    ordered = _permuted(information, order)
    root = ordered.copy()
    definite = factor_upper(root)
    mean = np.zeros(information.shape[0])
    if definite:
        gather(problem.vector, order, 0, STATES_PER_AGENT, mean)
        cholesky_solve(root, mean)
    first = STATES_PER_AGENT * outside
    d = STATES_PER_AGENT * regional
    ticks = accel.shape[0]
    local = np.full(agents, -1, np.int64)
    for a in range(outside, agents):
        local[order[a]] = a - outside
    m = rows.shape[0]
    code = np.empty((m, 3), np.int64)
    data = np.empty((m, 7))
    encode_rows(rows, local, code, data)
    inputs = np.empty((ticks, 3 * regional))
    variances = np.empty((ticks, 3 * regional))
    for k in range(ticks):
        gather(accel[k], order, outside, 3, inputs[k])
        gather(accel_variance[k], order, outside, 3, variances[k])
    prior_root = root[first:, first:].copy()
    prior_information = np.zeros((d, d))
    prior_covariance = np.zeros((d, d))
    prior_mean = mean[first:].copy()
    base_units = np.zeros((m, 4))
    gains = np.zeros((m if with_gains else 0, d))
    if definite:
        if outside == 0:
            prior_information[:, :] = ordered
        else:
            for i in range(d):  # U'U, upper triangle
                for j in range(i, d):
                    factor = prior_root[i, j]
                    for k in range(j, d):
                        prior_information[j, k] += factor * prior_root[i, k]
        inverse_from_cholesky(prior_root, prior_covariance)
        if with_gains:
            base = prior_mean.copy()
            cov = prior_covariance.copy()
            pre_estimate(code, data, start, inputs, variances, base, dt, eps, cov, gains, base_units)
    precision = np.zeros((0, 0)) if with_gains else 1.0 / variances
    window = Window(
        code, data, start, inputs, precision, gains, prior_mean, prior_root, prior_information, dt, eps
    )
    return Region(definite, order, outside, root, mean, prior_covariance, base_units), window
