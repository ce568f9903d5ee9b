"""A window over its first state, within limits: sequential quadratic programming on the joint problem.

Each program has one variable for each bound that may be active, see `estimators.window.first_state_bounds`: with A
the gradients of these quantities and H the Hessian of the joint problem, the values v of the quantities cost
1/2 v'(A H^-1 A')^-1 v beyond the unbounded optimum's. Limits of states are hard; bounds of the noise are soft, with
an exact (l1) penalty. A limit of speed is linearised, and its curvature is in the Hessian, as is that of the rows
where convergence is slow without. Rows are added until a program's answer violates none that it does not have.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.compiled.entries import plain
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.limits import StateLimits
from estimators.model.measurements import Matrix, Vector
from estimators.model.row_kernels import HALF_WIDTH, IntArray
from estimators.solvers.qp import QpEngine, QuadraticProgram, solve_exactly
from estimators.window.first_state import EXPECTED_CONTRACTION_M, ROUNDING, SHORTEST_STEP, SlowWindow
from estimators.window.first_state_bounds import (
    bends,
    joint_objective,
    keeps_limits,
    newton_responses,
    quantities,
    quantity_changes,
    quantity_gradients,
)

OUTSIDE = 1e-9
"""How far, m or m/s, a quantity may be outside its bounds without being violated."""
PRICE_MARGIN = 2.0
"""The merit's price of leaving a hard limit, relative to the largest multiplier so far."""

SLOW = 0.3
"""Where an iteration leaves more than this of the last one's change, the rows' curvature enters the Hessian."""
SLIGHT = 0.03
"""Curvature, relative to the largest, that is left out."""
POSITIVE = 0.01
"""Least eigenvalue, relative to Gauss-Newton's Hessian, of one with curvature."""
DEPENDENT = 1e-12
"""Relative size below which a variance is none."""


@dataclass(frozen=True, slots=True)
class BoundedSolution:
    """Where a bounded window comes to rest."""

    path: Matrix
    """``(N+1, d)``."""
    slow: Vector
    """``(q,)``."""
    variances: Vector
    """``(m,)`` of the rows by their weights."""
    cost: float
    """The joint objective, without a factor one half, and the price of what exceeds soft bounds."""
    converged: bool
    iterations: int
    programs: int
    active: int
    """Bounds with a multiplier."""


def violates(window: SlowWindow, limits: StateLimits, path: Matrix, slow: Vector) -> bool:
    """Whether a path is outside the limits."""
    noise = limits.noise_price > 0.0
    return not keeps_limits(plain(window), path, slow, limits.low, limits.high, limits.speed_mps, noise)


def solve_bounded(
    window: SlowWindow,
    prior: Matrix,
    limits: StateLimits,
    engine: QpEngine,
    guess: tuple[Matrix, Vector],
    max_iterations: int,
    tolerance: float,
) -> BoundedSolution:
    """The optimum within limits, from a ``guess`` of path and slow errors, mostly the optimum without them.

    ``prior`` ``(D, D)`` is the prior's information. Where a program cannot be solved the last iterate is given, as
    not converged.
    """
    return _BoundedSqp((window, prior), limits, engine, *guess).run(max_iterations, tolerance)


@dataclass(frozen=True, slots=True)
class _Direction:
    """What a program says: a change of path and slow errors."""

    path: Matrix
    slow: Vector
    multipliers: Vector


class _BoundedSqp:
    """One run."""

    def __init__(
        self,
        problem: tuple[SlowWindow, Matrix],
        limits: StateLimits,
        engine: QpEngine,
        path: Matrix,
        slow: Vector,
    ) -> None:
        window, self.prior = problem
        self.window, self.engine = plain(window), engine
        self.path, self.slow = path, slow
        ticks, d = path.shape
        speeds, rows = ticks * (d // STATES_PER_AGENT), len(window.data)
        priced = limits.noise_price > 0.0
        half = window.data[:, HALF_WIDTH] if priced else np.full(rows, np.inf)
        self.low = np.concatenate([np.tile(limits.low, ticks), np.full(speeds, -np.inf), -half])
        self.high = np.concatenate([np.tile(limits.high, ticks), np.full(speeds, limits.speed_mps), half])
        self.hard = ticks * d + speeds
        self.speeds_from = ticks * d
        # a program minimises half of the objective
        soft = 0.5 * limits.noise_price / np.where(np.isfinite(half), half, 1.0)
        self.price = np.concatenate([np.full(self.hard, np.inf), soft])
        self.variables, self.rows = len(window.prior_mean), rows
        self.hard_price, self.programs = 1.0, 0

    def values(self, path: Matrix, slow: Vector) -> Vector:
        """All quantities."""
        out = np.empty(len(self.low))
        quantities(self.window, path, slow, out)
        return out

    def outside(self, values: Vector) -> Vector:
        """How far each quantity is outside its bounds."""
        return np.asarray(np.maximum(np.maximum(values - self.high, self.low - values), 0.0))

    def merit(self, cost: float, values: Vector) -> float:
        """Half of the objective and the price of all that is outside."""
        outside = self.outside(values)
        soft = float(self.price[self.hard :] @ outside[self.hard :])
        return 0.5 * cost + soft + self.hard_price * float(outside[: self.hard].sum())

    def run(self, max_iterations: int, tolerance: float) -> BoundedSolution:
        """Iterate."""
        path, slow, variances, curved = self.path, self.slow, np.empty(self.rows), False
        trial_variances = np.empty(self.rows)
        cost = joint_objective(self.window, self.prior, path, slow, variances)
        values = self.values(path, slow)
        multipliers: Vector = np.zeros(len(self.low))
        last, iterations, converged = EXPECTED_CONTRACTION_M, 0, False
        while iterations < max_iterations and not converged:
            direction = self._program(path, slow, variances, values, multipliers, curved)
            if direction is None:
                break
            iterations, multipliers = iterations + 1, direction.multipliers
            self.hard_price = max(self.hard_price, PRICE_MARGIN * float(np.abs(multipliers[: self.hard]).max()))
            merit, share = self.merit(cost, values), 1.0
            allowed = merit + ROUNDING * (1.0 + abs(merit))
            size = float(np.abs(direction.path).max())
            while True:
                trial, there = path + share * direction.path, slow + share * direction.slow
                trial_cost = joint_objective(self.window, self.prior, trial, there, trial_variances)
                trial_values = self.values(trial, there)
                better = self.merit(trial_cost, trial_values) <= allowed
                if better or share <= SHORTEST_STEP:
                    break
                share *= 0.5
            if not better:
                converged = size < tolerance
                break
            path, slow, cost, values = trial, there, trial_cost, trial_values
            variances[:] = trial_variances
            converged = share == 1.0 and size * min(size / last, 1.0) < tolerance
            curved = curved or size > SLOW * last
            last = size * share
        excess = float(self.price[self.hard :] @ self.outside(values)[self.hard :])
        active = int(np.count_nonzero(multipliers))
        return BoundedSolution(
            path, slow, variances, cost + 2.0 * excess, converged, iterations, self.programs, active
        )

    def _program(
        self, path: Matrix, slow: Vector, variances: Vector, values: Vector, multipliers: Vector, curved: bool
    ) -> _Direction | None:
        """The step of one program; None where it has no answer."""
        entered = multipliers != 0.0
        bent = self._bends(path, slow, variances, multipliers, curved)
        while True:
            chosen = np.flatnonzero(entered)
            model = self._model(path, slow, variances, chosen, bent)
            if model is None:
                return None
            now = values[chosen] + self._changes(path, model.step, model.slow_step)[chosen]
            found = self._solved(chosen, model.covariance, now, multipliers[chosen])
            if found is None:
                return None
            step = model.step - np.tensordot(found, model.responses, 1)
            slow_step = model.slow_step - found @ model.slow_responses
            beyond = self.outside(values + self._changes(path, step, slow_step)) > OUTSIDE
            if not (beyond & ~entered).any():
                break
            entered |= beyond
        multipliers = np.zeros(len(self.low))
        multipliers[chosen] = found
        return _Direction(step, slow_step, multipliers)

    def _changes(self, path: Matrix, step: Matrix, slow_step: Vector) -> Vector:
        out = np.empty(len(self.low))
        quantity_changes(self.window, path, step, slow_step, out)
        return out

    def _solved(self, chosen: IntArray, covariance: Matrix, now: Vector, guess: Vector) -> Vector | None:
        """Multipliers of the chosen quantities, from their values now and their covariance."""
        if not len(chosen):
            return np.zeros(0)
        sigma = np.sqrt(covariance.diagonal())
        if not (np.isfinite(covariance).all() and (sigma > 0.0).all()):
            return None
        size, axes = np.linalg.eigh(covariance / np.outer(sigma, sigma))
        rows = np.ascontiguousarray(axes * np.sqrt(np.maximum(size, 0.0)))
        low, high = (self.low[chosen] - now) / sigma, (self.high[chosen] - now) / sigma
        program = QuadraticProgram(np.zeros(len(now)), rows, low, high, self.price[chosen] * sigma)
        answer = solve_exactly(program, self.engine, guess * sigma)
        self.programs += 1
        return answer.multipliers / sigma if answer.solved else None

    def _bends(self, path: Matrix, slow: Vector, variances: Vector, multipliers: Vector, of_rows: bool) -> _Bends:
        """What Gauss-Newton's Hessian leaves out, see `estimators.window.first_state_bounds.bends`."""
        room = 2 * (self.hard - self.speeds_from + self.rows)
        tick, along, curvature = np.empty(room, np.int64), np.empty((room, self.variables)), np.empty(room)
        count = bends(self.window, path, slow, variances, multipliers, of_rows, tick, along, curvature)
        size = np.abs(curvature[:count])
        kept = np.flatnonzero(size > SLIGHT * size.max(initial=0.0))
        return _Bends(tick[kept], along[kept], curvature[kept])

    def _model(self, path: Matrix, slow: Vector, variances: Vector, chosen: IntArray, bent: _Bends) -> _Model | None:
        """The quadratic model about a path: its unbounded step, and how the chosen quantities respond to pulls."""
        ticks, d = path.shape
        p, b, q = len(chosen), len(bent.tick), self.variables - d
        of_chosen, gradients = np.empty(p, np.int64), np.empty((p, self.variables))
        quantity_gradients(self.window, path, chosen, of_chosen, gradients)
        tick, along = np.concatenate([of_chosen, bent.tick]), np.concatenate([gradients, bent.along])
        trial, there = np.empty((ticks, d)), np.empty(q)
        responses: NDArray[np.float64] = np.empty((p + b, ticks, d))
        slow_responses = np.empty((p + b, q))
        if not newton_responses(
            self.window, self.prior, path, slow, variances, tick, along, trial, there, responses, slow_responses
        ):
            return None
        step, slow_step = trial - path, there - slow
        states, errors = along[:, :d], along[:, d:]
        covariance = np.einsum("cpd,pd->cp", responses[:, tick], states) + slow_responses @ errors.T
        if b:  # as if the bent directions had been measured to stay, with their curvature as precision
            here, rest = slice(p, p + b), slice(0, p)
            moved = np.einsum("pd,pd->p", step[tick[here]], states[here]) + errors[here] @ slow_step
            across = np.column_stack([moved, covariance[here, rest]])
            back = _bending(bent.curvature, covariance[here, here]) @ across
            step = step - np.tensordot(back[:, 0], responses[here], 1)
            slow_step = slow_step - back[:, 0] @ slow_responses[here]
            responses = responses[rest] - np.tensordot(back[:, 1:].T, responses[here], 1)
            slow_responses = slow_responses[rest] - back[:, 1:].T @ slow_responses[here]
            covariance = covariance[rest, rest] - covariance[rest, here] @ back[:, 1:]
        return _Model(step, slow_step, responses, slow_responses, 0.5 * (covariance + covariance.T))


@dataclass(frozen=True, slots=True)
class _Bends:
    tick: IntArray
    along: Matrix
    curvature: Vector


@dataclass(frozen=True, slots=True)
class _Model:
    step: Matrix
    slow_step: Vector
    responses: Matrix
    slow_responses: Matrix
    covariance: Matrix


def _bending(curvature: Vector, covariance: Matrix) -> Matrix:
    """K ``(b, b)`` with (H + A'cA)^-1 = H^-1 - H^-1 A'K A H^-1, by the ``covariance`` A H^-1 A' of what is bent.

    Where negative curvatures c make the Hessian indefinite, they are reversed in the directions that do so: it may be
    positive along the bounds, and what it is across these does not matter.
    """
    size, axes = np.linalg.eigh(covariance)
    known = size > DEPENDENT * size[-1]
    root, inverse = axes[:, known] * np.sqrt(size[known]), axes[:, known] / np.sqrt(size[known])
    size, axes = np.linalg.eigh(np.eye(root.shape[1]) + root.T @ (curvature[:, None] * root))
    half = inverse @ axes
    return np.asarray((half * (1.0 - 1.0 / np.maximum(np.abs(size), POSITIVE))) @ half.T, np.float64)
