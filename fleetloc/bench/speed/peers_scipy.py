"""The same windows for scipy's SLSQP, with exact gradients: what a first MHE is often built on."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import Bounds as BoxBounds
from scipy.optimize import minimize

from estimators.model.measurements import Matrix, Vector
from fleetloc.bench.speed.bounds import Bounds
from fleetloc.bench.speed.cases import Case
from fleetloc.bench.speed.plain_numpy import Linearised, PlainModel, prior_moments

MOST_VARIABLES = 150
"""SLSQP is dense and cubic; beyond this a single solution takes minutes and is left out."""

COST_TOLERANCE = 1e-9
"""Absolute, of half the cost; below it SLSQP stops with a failed line search rather than with success."""


class SlsqpSolver:
    """One window: variables are its first state and, with bounds, the excess of every row that has one."""

    def __init__(self, case: Case, eps: float) -> None:
        problem = case.window.problem(case.window.fused())
        self.model = PlainModel(problem, eps)
        self.information = problem.information
        self.mean, covariance = prior_moments(problem)
        self.gains = self.model.gains(self.mean, covariance)
        self.bounds = case.bounds
        self.d = len(self.mean)
        self.half_width = np.concatenate([tick.half_width for tick in self.model.ticks[1:]])
        self._point: Vector = np.full(self.d, np.nan)
        self._path: Linearised | None = None

    @staticmethod
    def variables(case: Case) -> int:
        """How many variables a case has."""
        later = len(case.window.rows) - int(case.window.start[1])
        return len(case.window.own.vector) + (0 if case.bounds is None else later)

    def run(self) -> tuple[Vector, Vector, bool]:
        """First and last state ``(6n,)``, success."""
        self._point = np.full(self.d, np.nan)  # nothing is known from the last call
        extra: dict[str, Any] = {}
        start = self.mean
        if self.bounds is not None:
            extra, start = self._bounded(self.bounds)
        answer = minimize(
            self._cost,
            start,
            jac=True,
            method="SLSQP",
            options={"ftol": COST_TOLERANCE, "maxiter": 500},
            **extra,
        )
        path = self._along(answer.x[: self.d])
        return path.states[0], path.states[-1], bool(answer.success)

    def _along(self, z: Vector) -> Linearised:
        """The trajectory at ``z``; cost and constraints ask for the same one in turn."""
        if self._path is None or not np.array_equal(z, self._point):
            self._point, self._path = z.copy(), self.model.linearise(z, self.gains)
        return self._path

    def _cost(self, variables: Vector) -> tuple[float, Vector]:
        z = variables[: self.d]
        path = self._along(z)
        off = self.information @ (z - self.mean)
        value = 0.5 * (float(off @ (z - self.mean)) + self.model.objective(path))
        slope: Vector = off.copy()
        for tick, r, jacobian in zip(self.model.ticks, path.residuals, path.jacobians, strict=True):
            slope -= jacobian.T @ (tick.precision * r)
        if self.bounds is None:
            return value, slope
        price = self.bounds.penalty / 2.0
        excess = variables[self.d :]
        return value + price * float(excess.sum()), np.concatenate([slope, np.full(len(excess), price)])

    def _bounded(self, bounds: Bounds) -> tuple[dict[str, Any], Vector]:
        """Arguments of ``minimize`` for the bounds, and a start; excess in half widths."""
        box, m = bounds.box(self.d), len(self.half_width)
        later_box = np.tile(box, len(self.model.ticks) - 1)
        limits = BoxBounds(np.concatenate([-box, np.zeros(m)]), np.concatenate([box, np.full(m, np.inf)]))

        def room(variables: Vector) -> Vector:
            path = self._along(variables[: self.d])
            states = np.concatenate(path.states[1:])
            residuals = np.concatenate(path.residuals[1:]) / self.half_width
            allowed = 1.0 + variables[self.d :]
            return np.concatenate(
                [later_box - states, later_box + states, allowed - residuals, allowed + residuals]
            )

        def slopes(variables: Vector) -> Matrix:
            path = self._along(variables[: self.d])
            states = np.vstack(path.sensitivities[1:])
            residuals = np.vstack(path.jacobians[1:]) / self.half_width[:, None]  # -d residual
            nothing = np.zeros((len(states), m))
            return np.block(
                [[-states, nothing], [states, nothing], [residuals, np.eye(m)], [-residuals, np.eye(m)]]
            )

        constraint = {"type": "ineq", "fun": room, "jac": slopes}
        start = np.concatenate([np.clip(self.mean, -box, box), np.zeros(m)])
        return {"bounds": limits, "constraints": [constraint]}, start
