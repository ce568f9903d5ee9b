"""The same step as one would write it first: dense numpy matrices, Gauss-Newton, OSQP.

Also the model that the other peers are fed from (gains, prior), written without any of the compiled kernels,
so that agreement of the results means something. GPS position, speed norm and range rows at the tick's own
instant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import osqp
from numpy.typing import NDArray
from scipy import sparse

from estimators.consensus.information import rank_weights
from estimators.estimator import Payload
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import Kind, Matrix, RowTable, Vector, is_shifted
from estimators.model.motion import input_matrix, transition_matrix
from estimators.window.problem import WindowProblem
from fleetloc.bench.speed.bounds import Bounds
from fleetloc.bench.speed.windows import BenchWindow

GAUSS_NEWTON_STEPS = 3
OSQP_TOLERANCE = 1e-6
AXES = np.arange(3)

Indices = NDArray[np.intp]


class TickRows:
    """The rows of one tick, sorted by kind into index arrays once, so that evaluating them is vectorised."""

    def __init__(self, rows: RowTable) -> None:
        kinds = set(rows["kind"].tolist())
        if kinds - {Kind.POSITION, Kind.SPEED, Kind.RANGE} or rows["offset_s"].any() or is_shifted(rows):
            raise ValueError("plain model: expected positions, speeds, ranges at the tick's instant, no lever arms")
        self.value: Vector = rows["value"].copy()
        self.precision: Vector = 1.0 / rows["variance"]
        self.half_width: Vector = rows["half_width"].copy()
        self.fix, self.fix_at = self._select(rows, Kind.POSITION)
        self.direction: Matrix = np.stack([rows[axis][self.fix] for axis in "xyz"], axis=1)
        self.speed, self.speed_at = self._select(rows, Kind.SPEED)
        self.range, self.range_at = self._select(rows, Kind.RANGE)
        self.other_at: Indices = STATES_PER_AGENT * rows["other"][self.range, None] + AXES

    @staticmethod
    def _select(rows: RowTable, kind: Kind) -> tuple[Indices, Indices]:
        """Places of a kind's rows, and of the three states ``(rows, 3)`` that each speaks of."""
        place = np.flatnonzero(rows["kind"] == kind)
        first = STATES_PER_AGENT * rows["agent"][place, None] + (3 if kind == Kind.SPEED else 0)
        return place, first + AXES

    def evaluate(self, x: Vector, eps: float) -> tuple[Vector, Matrix]:
        """h ``(m,)`` and its Jacobian ``(m, 6n)`` at the fleet state ``x``."""
        h, jacobian = np.empty(len(self.value)), np.zeros((len(self.value), len(x)))
        h[self.fix] = np.einsum("ij,ij->i", self.direction, x[self.fix_at])
        jacobian[self.fix[:, None], self.fix_at] = self.direction
        velocity = x[self.speed_at]
        h[self.speed] = np.sqrt(np.einsum("ij,ij->i", velocity, velocity) + eps**2)
        jacobian[self.speed[:, None], self.speed_at] = velocity / h[self.speed, None]
        between = x[self.range_at] - x[self.other_at]
        h[self.range] = np.sqrt(np.einsum("ij,ij->i", between, between) + eps**2)
        unit = between / h[self.range, None]
        jacobian[self.range[:, None], self.range_at] = unit
        jacobian[self.range[:, None], self.other_at] = -unit
        return h, jacobian


@dataclass(frozen=True, slots=True)
class Linearised:
    """Along one trajectory: states ``(6n,)``, dx_k/dz, residuals and their Jacobians -dr/dz, tick by tick."""

    states: list[Vector]
    sensitivities: list[Matrix]
    residuals: list[Vector]
    jacobians: list[Matrix]


class PlainModel:
    """The model of a window, without its prior."""

    def __init__(self, problem: WindowProblem, eps: float) -> None:
        agents = len(problem.vector) // STATES_PER_AGENT
        self.eps = eps
        self.a = transition_matrix(agents, problem.period_s)
        self.b = input_matrix(agents, problem.period_s)
        self.accel = problem.accel
        self.accel_variance = problem.accel_variance
        self.ticks = [TickRows(problem.rows[i:j]) for i, j in pairwise(problem.start)]

    def gains(self, mean: Vector, covariance: Matrix) -> list[Matrix]:
        """EKF gains (20)-(23) of every tick after the first, from the prior ``(6n,)``, ``(6n, 6n)``."""
        found, x, p = [], mean, covariance
        for k, tick in enumerate(self.ticks[1:]):
            x = self.a @ x + self.b @ self.accel[k]
            p = self.a @ p @ self.a.T + (self.b * self.accel_variance[k]) @ self.b.T
            h, c = tick.evaluate(x, self.eps)
            pc = p @ c.T
            gain = np.linalg.solve(c @ pc + np.diag(1.0 / tick.precision), pc.T).T
            x = x + gain @ (tick.value - h)
            p = p - gain @ pc.T
            found.append(gain)
        return found

    def linearise(self, z: Vector, gains: Sequence[Matrix]) -> Linearised:
        """Roll the window out from its first state ``z`` ``(6n,)`` with frozen gains."""
        x, sens = z, np.eye(len(z))
        out = Linearised([], [], [], [])
        for k, tick in enumerate(self.ticks):
            if k > 0:
                x, sens = self.a @ x + self.b @ self.accel[k - 1], self.a @ sens
                h, c = tick.evaluate(x, self.eps)
                x = x + gains[k - 1] @ (tick.value - h)
                sens = sens - gains[k - 1] @ (c @ sens)
            h, c = tick.evaluate(x, self.eps)
            out.states.append(x)
            out.sensitivities.append(sens)
            out.residuals.append(tick.value - h)
            out.jacobians.append(c @ sens)
        return out

    def objective(self, path: Linearised) -> float:
        """Sum over the rows of r^2 / variance, without the prior."""
        pairs = zip(self.ticks, path.residuals, strict=True)
        return float(sum((tick.precision * r**2).sum() for tick, r in pairs))

    def quadratic(
        self, z: Vector, path: Linearised, mean: Vector, information: Matrix
    ) -> tuple[Matrix, Vector]:
        """Gauss-Newton Hessian ``(6n, 6n)`` and gradient ``(6n,)`` of half the cost (9)."""
        h, g = information.copy(), information @ (z - mean)
        for tick, r, j in zip(self.ticks, path.residuals, path.jacobians, strict=True):
            weighted = j.T * tick.precision
            h += weighted @ j
            g -= weighted @ r
        return h, g


def prior_moments(problem: WindowProblem) -> tuple[Vector, Matrix]:
    """Mean ``(6n,)`` and covariance ``(6n, 6n)`` of a window's fused prior."""
    covariance = np.asarray(np.linalg.inv(problem.information), np.float64)
    return np.asarray(np.linalg.solve(problem.information, problem.vector), np.float64), covariance


class PlainStep:
    """Fuse, pre-estimate, three Gauss-Newton steps, next arrival cost.

    With bounds every step is a QP that OSQP solves, always the same instance, updated and warm started. Index
    arrays are made beforehand: only what depends on the numbers is in `run`.
    """

    def __init__(self, window: BenchWindow, eps: float, bounds: Bounds | None) -> None:
        self.window = window
        self.model = PlainModel(window.problem(window.fused()), eps)
        self.qp = None if bounds is None else _BoundedQp(self.model, bounds)

    def run(self) -> tuple[Vector, Vector, Matrix]:
        """First and last state of the window ``(6n,)``, and the next prior information ``(6n, 6n)``."""
        model = self.model
        information, vector = _fuse(self.window.own, self.window.received)
        covariance: Matrix = np.asarray(np.linalg.inv(information), np.float64)
        mean = covariance @ vector
        gains = model.gains(mean, covariance)
        z = mean
        for _ in range(GAUSS_NEWTON_STEPS):
            path = model.linearise(z, gains)
            h, g = model.quadratic(z, path, mean, information)
            z = z + (np.linalg.solve(h, -g) if self.qp is None else self.qp.step(h, g, path))
        path = model.linearise(z, gains)
        noise = (model.b * model.accel_variance[0]) @ model.b.T
        update = model.ticks[1]
        _, c = update.evaluate(path.states[1], model.eps)
        following = np.linalg.inv(model.a @ covariance @ model.a.T + noise) + (c.T * update.precision) @ c
        return path.states[0], path.states[-1], following


def _fuse(own: Payload, received: Any) -> tuple[Matrix, Vector]:
    others = list(received.values())
    weight, shares = rank_weights(own.rank, [payload.rank for payload in others])
    information = weight * own.information
    vector = weight * own.vector
    for share, payload in zip(shares, others, strict=True):
        information = information + share * payload.information
        vector = vector + share * payload.vector
    return information, vector


class _BoundedQp:
    """The QP of one Gauss-Newton step over (step ``(6n,)``, excess ``(m,)``), built once and updated.

    m counts the rows after the window's first tick: those have noise bounds.
    """

    def __init__(self, model: PlainModel, bounds: Bounds) -> None:
        self.bounds = bounds
        self.half_width = np.concatenate([tick.half_width for tick in model.ticks[1:]])
        d, m, states = len(model.a), len(self.half_width), len(model.a) * len(model.ticks)
        self.d, self.m = d, m
        self.box = np.tile(bounds.box(d), len(model.ticks))
        self.cost = bounds.penalty / 2.0 / self.half_width
        self.upper = np.triu_indices(d)
        ones = np.ones((d, d))
        hessian = sparse.block_diag([np.triu(ones), sparse.csc_matrix((m, m))], format="csc")
        rows = sparse.csc_matrix(np.ones((m, d)))
        self.rows = sparse.bmat(
            [
                [np.ones((states, d)), None],
                [rows, sparse.identity(m)],
                [rows, -sparse.identity(m)],
                [None, sparse.identity(m)],
            ],
            format="csc",
        )
        self.hessian_order = np.argsort(self.upper[1] * d + self.upper[0], kind="stable")
        self.solver = osqp.OSQP()
        self.q = np.concatenate([np.zeros(d), self.cost])
        count = self.rows.shape[0]
        self.solver.setup(
            hessian,
            self.q,
            self.rows,
            np.full(count, -np.inf),
            np.full(count, np.inf),
            eps_abs=OSQP_TOLERANCE,
            eps_rel=OSQP_TOLERANCE,
            max_iter=20000,
            verbose=False,
        )
        self.dense_columns = self.rows.indptr[d]

    def step(self, h: Matrix, g: Vector, path: Linearised) -> Vector:
        """The step ``(6n,)`` that minimises the quadratic model within the linearised bounds."""
        d, m = self.d, self.m
        x, r = np.concatenate(path.states), np.concatenate(path.residuals[1:])
        jacobian = np.vstack(path.jacobians[1:])
        dense = np.vstack([*path.sensitivities, -jacobian, -jacobian])
        values = self.rows.data.copy()
        values[: self.dense_columns] = dense.T.ravel()
        unlimited = np.full(m, np.inf)
        lower = np.concatenate([-self.box - x, -self.half_width - r, -unlimited, np.zeros(m)])
        upper = np.concatenate([self.box - x, unlimited, self.half_width - r, unlimited])
        self.q[:d] = g
        triangle = h[self.upper][self.hessian_order]
        self.solver.update(Px=triangle, Ax=values, q=self.q, l=lower, u=upper)
        return np.asarray(self.solver.solve(raise_error=False).x[:d], np.float64)
