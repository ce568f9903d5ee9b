"""From a measurement window and a belief about its start to the problem over its first state, and its solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.compiled.entries import entry, plain
from estimators.model.measurements import ROW, Matrix, RowTable, Vector
from estimators.model.motion import predict_mean
from estimators.model.row_kernels import HALF_WIDTH, POSITION, PRECISION, VELOCITY, IntArray, encode_rows
from estimators.systematic import slow_errors
from estimators.systematic.belief import SlowBelief
from estimators.window.first_state import CONVERGED, UNUSABLE, SlowWindow, solve_first_state
from estimators.window.history import MeasurementWindow

WHITE = 0.4, 3.0
"""What the white noise of fixes is taken to be of what their receiver claims, at least and at most."""


@dataclass(frozen=True, slots=True)
class SlowProblem:
    """A window, ready to be solved."""

    window: SlowWindow
    rows: RowTable
    """``(m,)``, sorted by tick."""


@dataclass(frozen=True, slots=True)
class SlowSolution:
    """The optimum of a window of N ticks and what follows from it."""

    path: Matrix
    """``(N+1, 6n)``."""
    slow: Vector
    """``(q,)`` slow errors."""
    covariance: Matrix
    """``(D, D)`` of the newest state and the slow errors."""
    measured: Vector
    """``(m,)`` variances of the rows by their weights."""
    variances: Vector
    """``(m,)`` the same, with what linearisations miss."""
    arrival: SlowBelief
    """The belief about the next window's start."""
    converged: bool
    iterations: int
    cost: float


def slow_problem(
    window: MeasurementWindow, belief: SlowBelief, white: Matrix, period_s: float, eps: float, *, robust: bool
) -> SlowProblem:
    """The problem of a window with a belief about its start; ``white`` ``(n, 3)``: see `SystematicSizes`.

    Raises ``numpy.linalg.LinAlgError`` where the belief's covariance is singular.
    """
    rows, start = window.rows()
    rows = np.ascontiguousarray(rows)
    accel, accel_variance = window.inputs()
    agents = belief.states // 6
    code, data = np.empty((len(rows), 3), np.int64), np.empty((len(rows), 7))
    group = np.empty(len(rows), np.int64)
    _encode(rows, agents, np.ascontiguousarray(np.clip(white, *WHITE)), code, data, group)
    if len(belief.sizes):
        at, by = slow_errors.couplings(rows, agents)
        push_at, push_by = np.arange(3 * agents, 6 * agents), np.ones(3 * agents)
    else:
        at, by = np.full((len(rows), 1), -1, np.int64), np.zeros((len(rows), 1))
        push_at, push_by = np.full(3 * agents, -1, np.int64), np.zeros(3 * agents)
    information = np.linalg.inv(belief.covariance)
    return SlowProblem(
        SlowWindow(
            code, data, start, group, at, by, accel, accel_variance, push_at, push_by, belief.mean,
            0.5 * (information + information.T), period_s, eps, robust,
        ),
        rows,
    )  # fmt: skip


@entry("void(ROW[::1], int64, float64[:, ::1], int64[:, ::1], float64[:, ::1], int64[::1])", ROW=ROW)
def _encode(rows: RowTable, agents: int, white: Matrix, code: IntArray, data: Matrix, group: IntArray) -> None:
    """Fill what `SlowWindow` holds of the rows; those of one fix, or one velocity, have one weight."""
    encode_rows(rows, np.arange(agents), code, data)
    for r in range(rows.shape[0]):
        row = rows[r]
        if row["kind"] == POSITION and not np.isfinite(data[r, HALF_WIDTH]):
            scale = 0.0
            for i, direction in enumerate((row["x"], row["y"], row["z"])):
                scale += (direction * white[row["agent"], i]) ** 2
            data[r, PRECISION] /= scale
        before = rows[r - 1]
        same = r > 0 and (row["kind"] == POSITION or row["kind"] == VELOCITY) and row["kind"] == before["kind"]
        same = same and row["tick"] == before["tick"] and row["observer"] == before["observer"]
        same = same and row["agent"] == before["agent"] and row["offset_s"] == before["offset_s"]
        group[r] = group[r - 1] if same else r


def solve_slow(
    problem: SlowProblem,
    belief: SlowBelief,
    guess: tuple[Matrix, Vector],
    max_iterations: int,
    tolerance: float,
    *,
    slide: bool,
) -> SlowSolution:
    """Solve a window from a ``guess`` of its path and slow errors; with ``slide`` the next one starts a tick later.

    Raises ``ArithmeticError`` where it cannot be solved.
    """
    window, total = problem.window, len(belief.mean)
    period_s = window.dt
    keep = slow_errors.kept_per_tick(belief.states // 6, period_s) if len(belief.sizes) else np.zeros(0)
    path, slow = guess[0].copy(), guess[1].copy()
    measured, variances = np.empty(len(problem.rows)), np.empty(len(problem.rows))
    newest, mean, covariance = np.empty((total, total)), np.empty(total), belief.covariance.copy()
    outcome, iterations, cost = solve_first_state(
        plain(window), problem.rows, keep, (1.0 - keep**2) * belief.sizes**2, slide, max_iterations, tolerance,
        path, slow, measured, variances, newest, mean, covariance,
    )  # fmt: skip
    if outcome == UNUSABLE:
        raise ArithmeticError("the window's information is not positive definite")
    arrival = SlowBelief(mean, 0.5 * (covariance + covariance.T), belief.sizes) if slide else belief
    return SlowSolution(
        path, slow, newest, measured, variances, arrival, outcome == CONVERGED, int(iterations), float(cost)
    )


def continued(path: Matrix, problem: SlowProblem, slow: Vector) -> Matrix:
    """A path ``(k, 6n)`` of the window's first ticks, carried on by its accelerations to all of them."""
    window = problem.window
    known = list(path[: len(window.accel) + 1])
    held = window.push_at >= 0
    error = np.zeros(len(held))
    error[held] = window.push_by[held] * slow[window.push_at[held]]
    while len(known) <= len(window.accel):
        known.append(predict_mean(known[-1], window.accel[len(known) - 1] - error, window.dt))
    return np.array(known)


def weights(problem: SlowProblem, solution: SlowSolution) -> NDArray[np.float64]:
    """The weight ``(m,)`` of each row: one, or less for an outlier."""
    return np.asarray(1.0 / (problem.window.data[:, PRECISION] * solution.measured))
