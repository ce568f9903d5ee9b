"""Quadratic programs of the constrained step, and the engines that solve them.

One form for all of them, after the Hessian's Cholesky factor has been put into the variables:

    minimise  1/2 q'q + linear'q + sum_i penalty_i excess_i      over q
    subject to  lower <= rows q <= upper

where excess_i is how far row i is outside; a row with infinite penalty is hard. An engine's answer is made
exact by `polish`, which finds the active set next to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from estimators.model.measurements import Matrix, Vector
from estimators.solvers.active_set import FEASIBILITY, settle

ENGINE_ACCURACY = 1e-5
"""How near its bound an engine leaves a row that is held there; an order above the tolerances it is run with."""

POLISH_ROUNDS = 30
GUESS_ROUNDS = 8

_NONE = 1e30
"""What DAQP takes for infinity."""


@dataclass(frozen=True, slots=True)
class QuadraticProgram:
    """See the module's text. ``linear`` ``(d,)``, ``rows`` ``(m, d)``, the others ``(m,)``."""

    linear: Vector
    rows: Matrix
    lower: Vector
    upper: Vector
    penalty: Vector


@dataclass(frozen=True, slots=True)
class QpSolution:
    """``multipliers`` ``(m,)``: positive at the upper bound; q + linear + rows' multipliers = 0."""

    q: Vector
    multipliers: Vector
    solved: bool


class QpEngine(Protocol):
    """Something that solves a `QuadraticProgram`, roughly at least."""

    def solve(self, problem: QuadraticProgram) -> QpSolution:
        """Solve; an infeasible or failed problem comes back with ``solved`` False."""
        ...


def make_engine(name: Literal["osqp", "daqp"]) -> QpEngine:
    """The engine of a name; its library is loaded when it is first needed."""
    return OsqpEngine() if name == "osqp" else DaqpEngine()


def solve_exactly(problem: QuadraticProgram, engine: QpEngine, guess: Vector) -> QpSolution:
    """Optimum of a program, started at multipliers ``guess`` (zero: the unconstrained step).

    Where the active set next to the guess is the right one, as it mostly is, that is all; else the engine.
    """
    polished = polish(problem, guess, rounds=GUESS_ROUNDS)
    if polished is not None:
        return polished
    rough = engine.solve(problem)
    if not rough.solved:
        return rough
    return polish(problem, rough.multipliers, rough.q) or rough


def polish(
    problem: QuadraticProgram, multipliers: Vector, q: Vector | None = None, rounds: int = POLISH_ROUNDS
) -> QpSolution | None:
    """The exact optimum, by a primal-dual active set started at an approximate solution.

    Rows are free, held at a bound (multiplier to be found) or saturated (outside at the price of the
    penalty). None where the set does not settle.
    """
    accuracy = FEASIBILITY if q is None else ENGINE_ACCURACY
    found = multipliers.copy()
    exact = -problem.linear - problem.rows.T @ multipliers if q is None else q.copy()
    arrays = (problem.linear, np.ascontiguousarray(problem.rows), problem.lower, problem.upper, problem.penalty)
    return QpSolution(exact, found, True) if settle(*arrays, accuracy, rounds, exact, found) else None


class OsqpEngine:
    """OSQP with one slack variable per soft row."""

    def __init__(self, accuracy: float = 1e-7, max_iterations: int = 4000) -> None:
        self.accuracy = accuracy
        self.max_iterations = max_iterations

    def solve(self, problem: QuadraticProgram) -> QpSolution:
        """Solve to ``accuracy`` (absolute and relative)."""
        import osqp
        from scipy.sparse import csc_matrix

        d, m = len(problem.linear), len(problem.lower)
        soft = np.flatnonzero(np.isfinite(problem.penalty))
        s = len(soft)
        pick = np.zeros((m, s))
        pick[soft, np.arange(s)] = 1.0
        # lower <= A q + s (soft rows), A q - s <= upper, s >= 0; a hard row has no slack on either side
        constraint = np.block(
            [[problem.rows, pick], [problem.rows, -pick], [np.zeros((s, d)), np.eye(s)]]
        )
        low = np.concatenate([problem.lower, np.full(m, -np.inf), np.zeros(s)])
        high = np.concatenate([np.full(m, np.inf), problem.upper, np.full(s, np.inf)])
        solver = osqp.OSQP()
        solver.setup(
            csc_matrix(np.diag(np.concatenate([np.ones(d), np.zeros(s)]))),
            np.concatenate([problem.linear, problem.penalty[soft]]),
            csc_matrix(constraint),
            low,
            high,
            verbose=False,
            eps_abs=self.accuracy,
            eps_rel=self.accuracy,
            max_iter=self.max_iterations,
        )
        result = solver.solve(raise_error=False)
        # an answer that is not accurate yet still names the active set that `polish` looks for
        usable = result.info.status_val in (1, 2, 7) and np.isfinite(result.x).all()
        if not usable:
            return QpSolution(np.zeros(d), np.zeros(m), False)
        multipliers = result.y[:m] + result.y[m : 2 * m]
        return QpSolution(result.x[:d], np.clip(multipliers, -problem.penalty, problem.penalty), True)


class DaqpEngine:
    """DAQP, a dual active-set solver for strictly convex programs, with one slack per soft row.

    A slack t gets a little curvature beside the penalty's slope (scaled into t, so that the Hessian stays the
    identity); `polish` removes what that leaves.
    """

    SLACK_CURVATURE = 1e-4

    def solve(self, problem: QuadraticProgram) -> QpSolution:
        """Solve exactly, up to the slacks' curvature."""
        import daqp

        d, m = len(problem.linear), len(problem.lower)
        soft = np.flatnonzero(np.isfinite(problem.penalty))
        s = len(soft)
        scale = 1.0 / np.sqrt(self.SLACK_CURVATURE)
        # variables (t, q): t >= 0 as simple bounds; A q - t <= upper for all rows, A q + t >= lower for soft ones
        constraint = np.zeros((m + s, s + d))
        constraint[:m, s:] = problem.rows
        constraint[m:, s:] = problem.rows[soft]
        constraint[soft, np.arange(s)] = -scale
        constraint[m + np.arange(s), np.arange(s)] = scale
        one_sided = np.where(np.isfinite(problem.penalty), -_NONE, problem.lower)
        x, _, flag, info = daqp.solve(
            np.eye(s + d),
            np.concatenate([problem.penalty[soft] * scale, problem.linear]),
            constraint,
            np.concatenate([np.full(s, _NONE), np.minimum(problem.upper, _NONE), np.full(s, _NONE)]),
            np.concatenate([np.zeros(s), np.maximum(one_sided, -_NONE), problem.lower[soft]]),
            np.zeros(2 * s + m, dtype=np.int32),
        )
        if flag < 1 or not np.isfinite(x).all():
            return QpSolution(np.zeros(d), np.zeros(m), False)
        multipliers = np.array(info["lam"][s : s + m])
        multipliers[soft] += info["lam"][s + m :]
        return QpSolution(np.array(x[s:]), np.clip(multipliers, -problem.penalty, problem.penalty), True)
