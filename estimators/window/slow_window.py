"""From a measurement window and a belief about its start to the problem over its first state, and its solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.compiled.entries import entry, plain
from estimators.integrity.innovations import Ignored, Residuals
from estimators.integrity.observability import row_jacobian
from estimators.model.measurements import ROW, Matrix, RowTable, Vector
from estimators.model.motion import predict_mean
from estimators.model.row_kernels import (
    HALF_WIDTH,
    ODOMETRY,
    POSITION,
    PRECISION,
    RELATIVE,
    VALUE,
    VELOCITY,
    IntArray,
    encode_rows,
    predict_row,
)
from estimators.systematic import slow_errors
from estimators.systematic.belief import SlowBelief
from estimators.window.first_state import (
    CONVERGED,
    SLOW_WINDOW,
    UNUSABLE,
    SlowWindow,
    slow_part,
    solve_first_state,
)
from estimators.window.history import MeasurementWindow

WHITE = 0.4, 3.0
"""What the white noise of fixes is taken to be of what their receiver claims, at least and at most."""
IGNORED_FACTOR = 1e-8
"""On the information of rows that are to get no weight: a fix of a metre is one of 10 km."""


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
    programs: int = 0
    """Quadratic programs solved for limits."""
    active: int = 0
    """Limits that hold the optimum."""
    strained: tuple[int, ...] = ()
    """Slots that limits keep farther from where everything else has them than the covariance has it."""


def slow_problem(
    window: MeasurementWindow,
    belief: SlowBelief,
    white: Matrix,
    period_s: float,
    eps: float,
    *,
    robust: bool,
    ignored: Ignored | None = None,
) -> SlowProblem:
    """The problem of a window with a belief about its start; ``white`` ``(n, 3)``: see `SystematicSizes`.

    ``ignored``: what gets no weight; absent = nothing.
    """
    rows, start = window.rows()
    rows = np.ascontiguousarray(rows)
    accel, accel_variance = window.inputs()
    agents = belief.states // 6
    code, data = np.empty((len(rows), 3), np.int64), np.empty((len(rows), 7))
    group = np.empty(len(rows), np.int64)
    _encode(rows, agents, np.ascontiguousarray(np.clip(white, *WHITE)), code, data, group)
    if ignored is not None and ignored.any():
        data[ignored.rows(rows), PRECISION] *= IGNORED_FACTOR
    if len(belief.sizes):
        at, by = slow_errors.couplings(rows, window.layout.is_vehicle)
        measured = np.repeat(window.layout.is_vehicle, 3)  # a body that tells no acceleration has no error of it
        push_at = np.where(measured, np.arange(3 * agents, 6 * agents), -1)
        push_by = measured.astype(float)
    else:
        at, by = np.full((len(rows), 1), -1, np.int64), np.zeros((len(rows), 1))
        push_at, push_by = np.full(3 * agents, -1, np.int64), np.zeros(3 * agents)
    return SlowProblem(
        SlowWindow(
            code, data, start, group, at, by, accel, accel_variance, push_at, push_by, belief.mean,
            period_s, eps, robust,
        ),
        rows,
    )  # fmt: skip


@entry("void(ROW[::1], int64, float64[:, ::1], int64[:, ::1], float64[:, ::1], int64[::1])", ROW=ROW)
def _encode(rows: RowTable, agents: int, white: Matrix, code: IntArray, data: Matrix, group: IntArray) -> None:
    """Fill what `SlowWindow` holds of the rows; those of one fix, velocity or sighting have one weight."""
    encode_rows(rows, np.arange(agents), code, data)
    for r in range(rows.shape[0]):
        row = rows[r]
        if row["kind"] == POSITION and not np.isfinite(data[r, HALF_WIDTH]):
            scale = 0.0
            for i, direction in enumerate((row["x"], row["y"], row["z"])):
                scale += (direction * white[row["agent"], i]) ** 2
            data[r, PRECISION] /= scale
        kind, before = row["kind"], rows[r - 1]
        vector = kind in (POSITION, VELOCITY, ODOMETRY, RELATIVE)
        same = r > 0 and vector and kind == before["kind"] and row["other"] == before["other"]
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
    window = problem.window
    keep = slow_errors.kept_per_tick(belief.states // 6, window.dt) if len(belief.sizes) else np.zeros(0)
    added = (1.0 - keep**2) * belief.sizes**2
    told = _told(window, belief)
    at, grid = np.flatnonzero(told), np.ix_(told, told)
    window, errors = _reduced(window, told), told[belief.states :]
    path, slow = guess[0].copy(), guess[1][errors]
    measured, variances = np.empty(len(problem.rows)), np.empty(len(problem.rows))
    newest, mean, covariance = np.empty((len(at), len(at))), np.empty(len(at)), belief.covariance[grid]
    outcome, iterations, cost = solve_first_state(
        plain(window), problem.rows, keep[errors], added[errors], slide, max_iterations, tolerance,
        path, slow, measured, variances, newest, mean, covariance,
    )  # fmt: skip
    if outcome == UNUSABLE:
        raise ArithmeticError("the window's prior or its information is not positive definite")
    # the other errors are what they were believed to be, and go on as they would alone
    whole = np.diag(belief.covariance.diagonal())
    whole[grid] = newest
    estimated = belief.mean[belief.states :].copy()
    estimated[errors] = slow
    arrival = belief
    if slide:
        ahead = np.concatenate((np.ones(belief.states), keep))
        following = np.diag(ahead**2 * belief.covariance.diagonal())
        following[range(belief.states, len(told)), range(belief.states, len(told))] += added
        following[grid] = 0.5 * (covariance + covariance.T)
        expected = ahead * belief.mean
        expected[at] = mean
        arrival = SlowBelief(expected, following, belief.sizes)
    return SlowSolution(
        path, estimated, whole, measured, variances, arrival, outcome == CONVERGED, int(iterations), float(cost)
    )


def _told(window: SlowWindow, belief: SlowBelief) -> NDArray[np.bool_]:
    """Which of the variables ``(D,)`` the window can tell anything about.

    All states, and slow errors that its rows or accelerations hold or that hang together with other variables. Two
    drones that never ranged each other have a bias of which nothing is ever known.
    """
    d = belief.states
    told = np.ones(len(belief.mean), np.bool_)
    told[d:] = np.count_nonzero(belief.covariance[d:], axis=1) > 1
    told[d + window.slow_at[window.slow_at >= 0]] = True
    told[d + window.push_at[window.push_at >= 0]] = True
    return told


def _reduced(window: SlowWindow, told: NDArray[np.bool_]) -> SlowWindow:
    """A window without the variables that it can tell nothing about."""
    if told.all():
        return window
    place = np.append(np.cumsum(told[2 * len(window.push_at) :]) - 1, -1)
    return window._replace(
        slow_at=place[window.slow_at], push_at=place[window.push_at], prior_mean=window.prior_mean[told]
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


def leaving_residuals(problem: SlowProblem, solution: SlowSolution, ignored: Ignored) -> Residuals:
    """The rows of the window's first tick, which have been weighed for good, against its solution.

    Those that are ``ignored`` are held against the estimate without them: its variance counts too.
    """
    window, count = problem.window, int(problem.window.start[1])
    rows, precision = problem.rows[:count], window.data[:count, PRECISION]
    residuals = np.empty(count)
    _residuals(plain(window), solution.path[0], solution.slow, residuals)
    variances, weights = 1.0 / precision, 1.0 / (precision * solution.measured[:count])
    if ignored.any():
        unused = np.flatnonzero(ignored.rows(rows))
        weights[unused] = 0.0
        variances[unused] = IGNORED_FACTOR * variances[unused] + _predicted(problem, solution, unused)
    return Residuals(rows, residuals**2 / variances, weights)


def _predicted(problem: SlowProblem, solution: SlowSolution, which: NDArray[np.int64]) -> Vector:
    """Variances of what a solution predicts for rows of the first tick, those at ``which``."""
    rows, covariance = problem.rows[which], solution.covariance
    gradients = np.zeros((len(which), len(covariance) + 1))
    gradients[:, : solution.path.shape[1]] = row_jacobian(rows, solution.path[0], problem.window.eps)[1]
    at, by = problem.window.slow_at[which], problem.window.slow_by[which]
    states = solution.path.shape[1]
    np.put_along_axis(gradients, np.where(at >= 0, states + at, len(covariance)), by, axis=1)
    used = gradients[:, :-1]
    return np.asarray(np.einsum("ri,ij,rj->r", used, covariance, used))


@entry("void(SLOW_WINDOW, float64[::1], float64[::1], float64[::1])", SLOW_WINDOW=SLOW_WINDOW)
def _residuals(window: SlowWindow, first: Vector, slow: Vector, out: Vector) -> None:
    """out ``(m,)`` <- of the rows of the first tick, at its state ``(6n,)`` and the slow errors ``(q,)``."""
    window = SlowWindow(*window)
    unit = np.empty(4)
    for r in range(out.shape[0]):
        predicted = predict_row(window.code, window.data, r, first, window.eps, unit)
        out[r] = window.data[r, VALUE] - predicted - slow_part(window, r, slow)
