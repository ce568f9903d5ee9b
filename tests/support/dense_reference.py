"""The estimators once more, as one would write them on a blackboard: plain 6n by 6n matrices, no kernels.

What the tests compare the compiled code with. It shares with it the row table and nothing else: models,
derivatives, gains, least squares, rank and closed loop are written a second time, dense and slow.
Equation numbers are those of Borelle et al. 2023.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimators.model.measurements import Kind, RowTable
from estimators.window.problem import WindowProblem

Array = NDArray[np.float64]
ANCHOR_RANGE, HEIGHT, ODOMETRY, POSITION, RANGE, RELATIVE, SPEED, VELOCITY = (
    Kind.ANCHOR_RANGE,
    Kind.HEIGHT,
    Kind.ODOMETRY,
    Kind.POSITION,
    Kind.RANGE,
    Kind.RELATIVE,
    Kind.SPEED,
    Kind.VELOCITY,
)
"""Looked up once: in an enumeration that costs more than what is done with a row."""


def transition(agents: int, dt: float) -> Array:
    """A of (27): positions first, then velocities, in every block of six."""
    a = np.eye(6 * agents)
    for s in range(agents):
        for i in range(3):
            a[6 * s + i, 6 * s + 3 + i] = dt
    return a


def inputs(agents: int, dt: float) -> Array:
    """B of (27)."""
    b = np.zeros((6 * agents, 3 * agents))
    for s in range(agents):
        for i in range(3):
            b[6 * s + i, 3 * s + i] = dt**2 / 2
            b[6 * s + 3 + i, 3 * s + i] = dt
    return b


def predicted_row(row: np.void, x: Array, eps: float) -> float:
    """h of one row at a fleet state."""
    a, o = int(row["agent"]), float(row["offset_s"])
    kind, direction = int(row["kind"]), np.array([row["x"], row["y"], row["z"]])
    p, v = x[6 * a : 6 * a + 3], x[6 * a + 3 : 6 * a + 6]
    if kind == POSITION:
        return float(direction @ (p + o * v))
    if kind == HEIGHT:
        return float(p[2] + o * v[2])
    if kind in (VELOCITY, ODOMETRY):
        return float(direction @ v)
    if kind == SPEED:
        return float(np.sqrt(v @ v + eps**2))
    if kind == RELATIVE:
        b = int(row["other"])
        return float(direction @ (p + o * v - x[6 * b : 6 * b + 3] - o * x[6 * b + 3 : 6 * b + 6]))
    if kind == RANGE:
        b = int(row["other"])
        away = p + o * v - x[6 * b : 6 * b + 3] - o * x[6 * b + 3 : 6 * b + 6]
    else:
        away = p + o * v - direction
    return float(np.sqrt(away @ away + eps**2))


def predicted(rows: RowTable, x: Array, eps: float) -> Array:
    """h ``(m,)``."""
    return np.array([predicted_row(row, x, eps) for row in rows])


def jacobian(rows: RowTable, x: Array, eps: float) -> Array:
    """C ``(m, 6n)`` (19)."""
    out = np.zeros((len(rows), len(x)))
    for r, row in enumerate(rows):
        a, o = int(row["agent"]), float(row["offset_s"])
        p, v = slice(6 * a, 6 * a + 3), slice(6 * a + 3, 6 * a + 6)
        kind, direction = int(row["kind"]), np.array([row["x"], row["y"], row["z"]])
        if kind in (VELOCITY, ODOMETRY):
            out[r, v] = direction
        elif kind == SPEED:
            out[r, v] = x[v] / np.sqrt(x[v] @ x[v] + eps**2)
        elif kind == POSITION:
            out[r, p], out[r, v] = direction, o * direction
        elif kind == HEIGHT:
            down = np.array([0.0, 0.0, 1.0])
            out[r, p], out[r, v] = down, o * down
        elif kind == ANCHOR_RANGE:
            away = x[p] + o * x[v] - direction
            unit = away / np.sqrt(away @ away + eps**2)
            out[r, p], out[r, v] = unit, o * unit
        elif kind == RELATIVE:
            b = int(row["other"])
            q, w = slice(6 * b, 6 * b + 3), slice(6 * b + 3, 6 * b + 6)
            out[r, p], out[r, v], out[r, q], out[r, w] = direction, o * direction, -direction, -o * direction
        else:
            b = int(row["other"])
            q, w = slice(6 * b, 6 * b + 3), slice(6 * b + 3, 6 * b + 6)
            away = x[p] + o * x[v] - x[q] - o * x[w]
            unit = away / np.sqrt(away @ away + eps**2)
            out[r, p], out[r, v], out[r, q], out[r, w] = unit, o * unit, -unit, -o * unit
    return out


def rows_by_tick(problem: WindowProblem) -> list[RowTable]:
    """The rows of every tick of a window."""
    return [problem.rows[a:b] for a, b in pairwise(problem.start)]


@dataclass(frozen=True, slots=True)
class Optimum:
    """``z``, the path ``(N+1, 6n)`` along it, the cost (9) without a factor one half, the largest gradient entry."""

    z: Array
    path: Array
    cost: float
    slope: float


class DenseWindow:
    """The window's problem over the whole fleet: cost, derivatives, optimum, next arrival cost.

    z is the first state ``(6n,)``; without gains (DMHE-1) it goes on with one correction ``(3n,)`` per tick.
    """

    def __init__(self, problem: WindowProblem, eps: float) -> None:
        self.problem, self.eps = problem, eps
        self.n = len(problem.vector)
        self.ticks = len(problem.accel)
        self.a, self.b = transition(self.n // 6, problem.period_s), inputs(self.n // 6, problem.period_s)
        self.rows = rows_by_tick(problem)
        self.mean = np.linalg.solve(problem.information, problem.vector)
        self.gains: list[Array] = []
        self.filtered, self.pre_covariance = self._pre_estimate()

    def _noise(self, k: int) -> Array:
        return self.b @ np.diag(self.problem.accel_variance[k]) @ self.b.T

    def _pre_estimate(self) -> tuple[Array, Array]:
        """The EKF (20)-(23) from the prior on; the rows of the first tick are not used."""
        x, cov = self.mean, np.linalg.inv(self.problem.information)
        for k in range(self.ticks):
            x = self.a @ x + self.b @ self.problem.accel[k]
            cov = self.a @ cov @ self.a.T + self._noise(k)
            rows = self.rows[k + 1]
            c = jacobian(rows, x, self.eps)
            gain = cov @ c.T @ np.linalg.inv(c @ cov @ c.T + np.diag(rows["variance"]))
            self.gains.append(gain)
            x = x + gain @ (rows["value"] - predicted(rows, x, self.eps))
            cov = cov - gain @ c @ cov
        return x, cov

    def correction(self, z: Array, k: int) -> Array:
        """w_k, zero with gains."""
        width = len(self.b.T)
        return np.zeros(width) if self.problem.with_gains else z[self.n + k * width : self.n + (k + 1) * width]

    def before_update(self, x: Array, z: Array, k: int) -> Array:
        """A x_k + B (u_k + w_k)."""
        return self.a @ x + self.b @ (self.problem.accel[k] + self.correction(z, k))

    def path(self, z: Array) -> Array:
        """States ``(N+1, 6n)``, (6)-(7)."""
        states = [z[: self.n]]
        for k in range(self.ticks):
            x = self.before_update(states[-1], z, k)
            if self.problem.with_gains:
                rows = self.rows[k + 1]
                x = x + self.gains[k] @ (rows["value"] - predicted(rows, x, self.eps))
            states.append(x)
        return np.array(states)

    def cost(self, z: Array) -> float:
        """(9), without a factor one half."""
        away = z[: self.n] - self.mean
        total = away @ self.problem.information @ away
        for x, rows in zip(self.path(z), self.rows, strict=True):
            total += np.sum((rows["value"] - predicted(rows, x, self.eps)) ** 2 / rows["variance"])
        if not self.problem.with_gains:
            total += np.sum(z[self.n :] ** 2 / self.problem.accel_variance.ravel())
        return float(total)

    def sensitivities(self, z: Array) -> list[Array]:
        """dx_k/dz for every tick."""
        states, width = self.path(z), len(self.b.T)
        sens = [np.eye(self.n, len(z))]
        for k in range(self.ticks):
            step = self.a @ sens[-1]
            if self.problem.with_gains:
                before = self.before_update(states[k], z, k)
                step = step - self.gains[k] @ jacobian(self.rows[k + 1], before, self.eps) @ step
            else:
                step[:, self.n + k * width : self.n + (k + 1) * width] += self.b
            sens.append(step)
        return sens

    def normal_equations(self, z: Array) -> tuple[Array, Array]:
        """Gauss-Newton Hessian and gradient of half the cost."""
        hessian = np.zeros((len(z), len(z)))
        hessian[: self.n, : self.n] = self.problem.information
        slope = np.zeros(len(z))
        slope[: self.n] = self.problem.information @ (z[: self.n] - self.mean)
        if not self.problem.with_gains:
            precision = 1.0 / self.problem.accel_variance.ravel()
            hessian[self.n :, self.n :] += np.diag(precision)
            slope[self.n :] += precision * z[self.n :]
        for x, rows, sens in zip(self.path(z), self.rows, self.sensitivities(z), strict=True):
            c = jacobian(rows, x, self.eps) @ sens
            hessian += c.T @ (c / rows["variance"][:, None])
            slope -= c.T @ ((rows["value"] - predicted(rows, x, self.eps)) / rows["variance"])
        return hessian, slope

    def start(self) -> Array:
        """The prior mean, and no corrections."""
        extra = 0 if self.problem.with_gains else self.problem.accel.size
        return np.concatenate([self.mean, np.zeros(extra)])

    def minimise(self, iterations: int = 400) -> Optimum:
        """Gauss-Newton with backtracking until nothing moves."""
        z = self.start()
        cost = self.cost(z)
        for _ in range(iterations):
            hessian, slope = self.normal_equations(z)
            step = -np.linalg.solve(hessian, slope)
            length = 1.0
            while length > 1e-10 and self.cost(z + length * step) > cost + 1e-13 * abs(cost):
                length /= 2
            z = z + length * step
            cost = self.cost(z)
            if np.abs(length * step).max() < 1e-13:
                break
        hessian, slope = self.normal_equations(z)
        # what a Newton step would still change, in metres: a gradient has no scale of its own
        return Optimum(z, self.path(z), cost, float(np.abs(np.linalg.solve(hessian, slope)).max()))

    def next_information(self, path: Array) -> Array:
        """(17)-(18): predicted over the first tick, updated by the rows of the second."""
        covariance = self.a @ np.linalg.inv(self.problem.information) @ self.a.T + self._noise(0)
        c = jacobian(self.rows[1], path[1], self.eps)
        return np.linalg.inv(covariance) + c.T @ (c / self.rows[1]["variance"][:, None])


def observability_rank(rows: Sequence[RowTable], states: Sequence[Array], dt: float, eps: float) -> int:
    """Rank (25) of the stacked C_k A^k (24)."""
    a = transition(len(states[0]) // 6, dt)
    pairs = enumerate(zip(rows, states, strict=True))
    blocks = [jacobian(r, x, eps) @ np.linalg.matrix_power(a, k) for k, (r, x) in pairs]
    return int(np.linalg.matrix_rank(np.vstack(blocks)))


@dataclass
class Kalman:
    """A Kalman filter over the fleet (on norm rows: an extended one)."""

    mean: Array
    covariance: Array
    period_s: float
    eps: float = 1e-3

    def predict(self, accel: Array, variance: Array) -> None:
        """Over one tick; ``accel`` and ``variance`` ``(3n,)``."""
        n = len(self.mean) // 6
        a, b = transition(n, self.period_s), inputs(n, self.period_s)
        self.mean = a @ self.mean + b @ accel
        self.covariance = a @ self.covariance @ a.T + b @ np.diag(variance) @ b.T

    def update(self, rows: RowTable) -> None:
        """In information form, so that nothing resembles the code under test."""
        c = jacobian(rows, self.mean, self.eps)
        innovation = rows["value"] - predicted(rows, self.mean, self.eps)
        weighted = c.T / rows["variance"]
        self.covariance = np.linalg.inv(np.linalg.inv(self.covariance) + weighted @ c)
        self.mean = self.mean + self.covariance @ weighted @ innovation
