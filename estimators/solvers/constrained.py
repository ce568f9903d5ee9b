"""The constrained step: sequential quadratic programming over the window's variables.

Noise bounds are soft, with an exact (l1) penalty on their excess: as hard constraints on the innovation (8)
they are infeasible in half of all windows, because the true innovation also holds the unknown inputs. The
state box is hard. Each program carries the rows that are near their bound and is checked against the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimators.compiled.entries import plain
from estimators.estimator import SolverReport, Status
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import Matrix, Vector
from estimators.settings import EstimatorSettings
from estimators.solvers.constrained_kernels import (
    BoundPoint,
    LinearProgram,
    PreparedWindow,
    evaluate,
    finish,
    linearise_bounds,
    prepare,
)
from estimators.solvers.qp import QpEngine, QuadraticProgram, make_engine, solve_exactly
from estimators.window.least_squares import Window
from estimators.window.problem import (
    CORRECTED,
    NOTHING,
    PREDICTED,
    StepOptions,
    WindowProblem,
    WindowSolution,
)

NEAR = 0.5
"""Fraction of a bound from which on a row enters the first program."""

SUFFICIENT_DECREASE = 1e-4
ROUNDING = 1e-13
SHORTEST_STEP = 2.0**-20


def bound_kind(settings: EstimatorSettings, with_gains: bool) -> int:
    """Which residuals the noise bounds hold for, in the kernels' code.

    Without gains nothing corrects a prediction: its innovation is the residual.
    """
    if settings.noise_bounds == "off":
        return NOTHING
    return PREDICTED if with_gains and settings.noise_bounds_on == "predicted" else CORRECTED


def box(settings: EstimatorSettings) -> tuple[float, float]:
    """Largest position and velocity component, m and m/s; inf where there is none."""
    return settings.state_box_position_m or np.inf, settings.state_box_speed_mps or np.inf


def step_options(settings: EstimatorSettings, with_gains: bool, limit: int) -> StepOptions:
    """The settings as the kernels take them, with at most ``limit`` iterations."""
    bounds_on = bound_kind(settings, with_gains)
    return StepOptions(settings.norm_smoothing_m, bounds_on, *box(settings), limit, settings.tolerance)


def solve_constrained(
    problem: WindowProblem, settings: EstimatorSettings, limit: int, path: Matrix
) -> WindowSolution | None:
    """Optimum under the settings' bounds; None where it cannot be found (an infeasible box).

    ``path`` is the unconstrained optimum's, to start from.

    An agent outside the optimisation that violates the box joins it, and the step is done again: exact.
    """
    options = step_options(settings, problem.with_gains, settings.max_iterations)
    first_state = np.ascontiguousarray(path[0])
    keep = set(problem.keep.tolist())
    while True:
        extended = problem._replace(keep=np.array(sorted(keep), np.int64))
        prepared = prepare(plain(extended), plain(options), first_state)
        outcome = _Sqp(prepared.window, settings, make_engine(settings.qp)).run(prepared.z, limit)
        if outcome is None:
            return None
        solution = _finished(problem, prepared, outcome)
        if solution is None:
            return None
        outside = set(prepared.region.order[: prepared.region.outside].tolist())
        joining = outside & _out_of_box(solution.path, settings)
        if not joining:
            return solution
        keep |= joining


def _out_of_box(path: Matrix, settings: EstimatorSettings) -> set[int]:
    """Slots with a state outside the box."""
    limit = np.tile(np.repeat(box(settings), 3), path.shape[1] // STATES_PER_AGENT)
    beyond = (np.abs(path) > limit).any(axis=0).reshape(-1, STATES_PER_AGENT).any(axis=1)
    return set(np.flatnonzero(beyond).tolist())


@dataclass(frozen=True, slots=True)
class _Outcome:
    z: Vector
    cost: float
    converged: bool
    iterations: int
    programs: int
    active: int


def _finished(problem: WindowProblem, prepared: PreparedWindow, outcome: _Outcome) -> WindowSolution | None:
    n = len(problem.vector)
    path, information = np.empty((len(problem.accel) + 1, n)), np.empty((n, n))
    if not finish(plain(prepared.region), plain(prepared.window), outcome.z, plain(problem), path, information):
        return None
    status = Status.OK if outcome.converged else Status.NOT_CONVERGED
    report = SolverReport(outcome.iterations, outcome.programs, outcome.cost, outcome.active)
    return WindowSolution(path, information, status, report)


class _Sqp:
    """One run of sequential quadratic programming."""

    def __init__(self, window: Window, settings: EstimatorSettings, engine: QpEngine) -> None:
        self.window = plain(window)
        self.settings = settings
        self.engine = engine
        data, row_start, gains, prior_mean = window.data, window.start, window.gains, window.prior_mean
        self.bounds_on = bound_kind(settings, len(gains) > 0)
        self.rows, self.d, self.ticks = len(data), len(prior_mean), len(row_start) - 2
        half = np.where(np.arange(self.rows) >= row_start[1], data[:, 3], np.inf)
        self.half = half if self.bounds_on != NOTHING else np.full(self.rows, np.inf)
        self.limit = np.tile(np.tile(np.repeat(box(settings), 3), self.d // STATES_PER_AGENT), self.ticks + 1)
        # f is half of the cost (9), so is the price of an excess
        price = 0.5 * settings.noise_bounds_penalty / np.where(np.isfinite(half), half, 1.0)
        self.boxed = bool(np.isfinite(self.limit).any())
        self.penalty = np.concatenate([price, np.full(len(self.limit), np.inf)])
        self.bound = np.concatenate([self.half, self.limit])
        self.box_price = 1.0
        self.programs = 0

    def values(self, z: Vector) -> tuple[float, Vector]:
        """f and all bounded quantities: residuals, then states."""
        states, residuals = np.empty((self.ticks + 1, self.d)), np.empty(self.rows)
        f = evaluate(self.window, z, self.bounds_on, states, residuals)
        return f, np.concatenate([residuals, states.ravel()])

    def merit(self, f: float, values: Vector) -> float:
        """f plus the price of all excess; the hard box has a price above all its multipliers so far."""
        excess = np.maximum(np.abs(values) - self.bound, 0.0)
        total = f + float(self.penalty[: self.rows] @ excess[: self.rows])
        return total + self.box_price * float(excess[self.rows :].sum()) if self.boxed else total

    def run(self, start: Vector, limit: int) -> _Outcome | None:
        """Iterate from ``start``; None where a program has no solution."""
        z: Vector = start.copy()
        multipliers: Vector = np.zeros(len(self.bound))
        f, values = self.values(z)
        last, iterations, converged = np.inf, 0, False
        while iterations < limit and not converged:
            iterations += 1
            solved = self._program(z, values, multipliers, iterations > 1)
            if solved is None:
                return None
            step, multipliers, model = solved
            size = float(np.abs(step).max())
            length, z, f, values = self._search(z, f, values, step, model)
            contraction = min(1.0, size / last) if length == 1.0 and np.isfinite(last) else 1.0
            converged = size * contraction < self.settings.tolerance
            if length == 0.0:  # no descent left: rounding
                converged = size < 100.0 * self.settings.tolerance
                break
            last = size
        excess = np.maximum(np.abs(values[: self.rows]) - self.half, 0.0)
        cost = 2.0 * (f + float(self.penalty[: self.rows] @ excess))
        active = int(np.count_nonzero(multipliers))
        return _Outcome(z, cost, converged, iterations, self.programs, active)

    def _program(
        self, z: Vector, values: Vector, multipliers: Vector, exact: bool
    ) -> tuple[Vector, Vector, float] | None:
        """Step, multipliers, and the decrease of the merit that the quadratic model promises."""
        n = len(z)
        made = LinearProgram(np.empty(n), np.empty((n, n)), np.empty((len(self.bound), n)))
        linear, inverse_root, rows = made
        state_multipliers = np.ascontiguousarray(multipliers[self.rows :]).reshape(self.ticks + 1, self.d)
        point = BoundPoint(z, multipliers[: self.rows], state_multipliers, self.bounds_on, self.boxed)
        if not linearise_bounds(self.window, plain(point), exact, plain(made)):
            return None
        entered = (np.abs(values) > NEAR * self.bound) | (multipliers != 0.0)
        while True:
            chosen = np.flatnonzero(entered)
            bound, now = self.bound[chosen], values[chosen]
            program = QuadraticProgram(linear, rows[chosen], -bound - now, bound - now, self.penalty[chosen])
            answer = solve_exactly(program, self.engine, multipliers[chosen])
            self.programs += 1
            if not answer.solved:
                return None
            predicted = values + rows @ answer.q
            beyond = np.abs(predicted) > self.bound * (1.0 + 1e-9)
            if not (beyond & ~entered).any():
                break
            entered |= beyond
        found = np.zeros(len(self.bound))
        found[chosen] = answer.multipliers
        if self.boxed:
            self.box_price = max(self.box_price, 2.0 * float(np.abs(found[self.rows :]).max()))
        model = self.merit(0.0, values) - self.merit(0.0, predicted)
        model -= float(linear @ answer.q) + 0.5 * float(answer.q @ answer.q)
        return inverse_root @ answer.q, found, model

    def _search(
        self, z: Vector, f: float, values: Vector, step: Vector, model: float
    ) -> tuple[float, Vector, float, Vector]:
        """Backtrack on the merit; a length of 0 says that nothing decreases it."""
        merit = self.merit(f, values)
        length = 1.0
        while length > SHORTEST_STEP:
            trial = z + length * step
            new_f, new_values = self.values(trial)
            new = self.merit(new_f, new_values)
            enough = SUFFICIENT_DECREASE * length * max(model, 0.0) - ROUNDING * abs(merit)
            if np.isfinite(new) and new <= merit - enough:
                return length, trial, new_f, new_values
            length *= 0.5
        return 0.0, z, f, values

