"""The shared estimator's window once more, over everything that is unknown in it: dense, slow, without kernels.

Variables are z = (x_0, s, w_0 .. w_{N-1}): the first state, the slow errors, and the error of each acceleration.
States along the window are affine in z; what is not linear are the rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.model.measurements import Kind, RowTable
from estimators.systematic import slow_errors
from estimators.systematic.belief import SlowBelief
from tests.support import dense_reference as dense

Array = NDArray[np.float64]
DEGREES_OF_FREEDOM = 4.0
LIMIT_SQUARES = {1: 9.0, 2: 11.8, 3: 14.2}
"""Squares beyond which one, two and three rows that have one weight are outliers."""


def coupling_matrix(rows: RowTable, agents: int, targets: tuple[int, ...] = ()) -> Array:
    """How each row ``(m, q)`` holds the slow errors; ``targets``: slots of the bodies that are no vehicles."""
    out = np.zeros((len(rows), slow_errors.count(agents)))
    for r, row in enumerate(rows):
        if np.isfinite(row["half_width"]):
            continue
        direction = np.array([row["x"], row["y"], row["z"]])
        if row["kind"] == Kind.POSITION:
            out[r, slow_errors.wander_of(int(row["agent"]))] = direction
            out[r, slow_errors.common(agents)] = direction
        elif row["kind"] == Kind.HEIGHT:
            out[r, slow_errors.drifts(agents).start + int(row["agent"])] = row["x"]
            out[r, slow_errors.scales(agents).start + int(row["agent"])] = row["x"] * row["value"]
        elif row["kind"] == Kind.RANGE:
            out[r, slow_errors.pair_of(int(row["agent"]), int(row["other"]), agents)] = 1.0
            for slot in {int(row["agent"]), int(row["other"])}.intersection(targets):
                out[r, slow_errors.drifts(agents).start + slot] = 1.0
    return out


def push_matrix(agents: int) -> Array:
    """How each acceleration ``(3n, q)`` holds them."""
    out = np.zeros((3 * agents, slow_errors.count(agents)))
    for slot in range(agents):
        out[3 * slot : 3 * slot + 3, slow_errors.acceleration_of(slot, agents)] = np.eye(3)
    return out


@dataclass(frozen=True, slots=True)
class JointOptimum:
    """``z``, the path ``(N+1, 6n)``, the slow errors ``(q,)``, the cost without a factor one half."""

    z: Array
    path: Array
    slow: Array
    cost: float
    step: float
    """The largest component that another Gauss-Newton step would change."""


class JointWindow:
    """Cost, derivatives and optimum of a window's rows, accelerations and belief about its start."""

    def __init__(
        self,
        rows: RowTable,
        start: NDArray[np.int64],
        inputs: tuple[Array, Array],
        belief: SlowBelief,
        period_s: float,
        eps: float,
        *,
        white: Array | None = None,
        robust: bool = False,
    ) -> None:
        self.rows, self.start, self.eps, self.robust = rows, start, eps, robust
        self.belief = belief
        self.d, self.q = belief.states, len(belief.sizes)
        self.accel, self.accel_variance = inputs
        self.ticks, agents = len(self.accel), self.d // 6
        self.coupling = coupling_matrix(rows, agents) if self.q else np.zeros((len(rows), 0))
        self.push = push_matrix(agents) if self.q else np.zeros((3 * agents, 0))
        self.variance = rows["variance"].copy()
        if white is not None:
            for r, row in enumerate(rows):
                if row["kind"] == Kind.POSITION and not np.isfinite(row["half_width"]):
                    direction = np.array([row["x"], row["y"], row["z"]])
                    self.variance[r] *= ((direction * white[row["agent"]]) ** 2).sum()
        self.root = np.linalg.cholesky(np.linalg.inv(belief.covariance)).T
        self.size = self.d + self.q + self.ticks * 3 * agents
        self.moves, self.offsets = self._affine(agents, period_s)
        keys = [
            (r,) if row["kind"] not in (Kind.POSITION, Kind.VELOCITY, Kind.ODOMETRY, Kind.RELATIVE)
            else tuple(float(row[name]) for name in ("tick", "observer", "kind", "agent", "other", "offset_s"))
            for r, row in enumerate(rows)
        ]  # fmt: skip
        self.group = np.array([keys.index(key) for key in keys], np.int64)

    def _affine(self, agents: int, dt: float) -> tuple[Array, Array]:
        """Path_k = moves_k z + offsets_k."""
        a, b = dense.transition(agents, dt), dense.inputs(agents, dt)
        moves, offsets = np.zeros((self.ticks + 1, self.d, self.size)), np.zeros((self.ticks + 1, self.d))
        moves[0, :, : self.d] = np.eye(self.d)
        for k in range(self.ticks):
            moves[k + 1] = a @ moves[k]
            moves[k + 1][:, self.d : self.d + self.q] -= b @ self.push
            at = self.d + self.q + k * 3 * agents
            moves[k + 1][:, at : at + 3 * agents] += b
            offsets[k + 1] = a @ offsets[k] + b @ self.accel[k]
        return moves, offsets

    def path(self, z: Array) -> Array:
        """States ``(N+1, 6n)``."""
        return np.asarray(self.moves @ z + self.offsets)

    def variables(self, path: Array, slow: Array) -> Array:
        """The z of a path that the dynamics admit."""
        rest = path[1:] - self.offsets[1:]
        z = np.concatenate([path[0], slow, np.zeros(self.size - self.d - self.q)])
        system = self.moves[1:, :, self.d + self.q :].reshape(-1, self.size - self.d - self.q)
        known = (self.moves[1:, :, : self.d + self.q] @ z[: self.d + self.q])
        z[self.d + self.q :] = np.linalg.lstsq(system, (rest - known).ravel(), rcond=None)[0]
        return z

    def misses(self, z: Array) -> Array:
        """Residuals ``(m,)`` of the rows over their sigmas."""
        path = self.path(z)
        found = [dense.predicted(self._of(k), path[k], self.eps) for k in range(self.ticks + 1)]
        slow = z[self.d : self.d + self.q]
        return np.asarray(
            (self.rows["value"] - np.concatenate(found) - self.coupling @ slow) / np.sqrt(self.variance)
        )

    def _of(self, k: int) -> RowTable:
        return self.rows[self.start[k] : self.start[k + 1]]

    def slopes(self, z: Array) -> Array:
        """-d misses / dz ``(m, size)``."""
        path = self.path(z)
        pieces = [dense.jacobian(self._of(k), path[k], self.eps) @ self.moves[k] for k in range(self.ticks + 1)]
        out = np.concatenate(pieces)
        out[:, self.d : self.d + self.q] += self.coupling
        return np.asarray(out / np.sqrt(self.variance)[:, None])

    def weights_and_cost(self, misses: Array) -> tuple[Array, float]:
        """Weight of each row, and what the rows add to the cost."""
        weights, total, nu = np.ones(len(misses)), 0.0, DEGREES_OF_FREEDOM
        for first in np.unique(self.group):
            members = self.group == first
            square = float((misses[members] ** 2).sum())
            limit = LIMIT_SQUARES[int(members.sum())]
            if self.robust and square > limit:
                weights[members] = (nu + limit) / (nu + square)
                square = limit + (nu + limit) * np.log((nu + square) / (nu + limit))
            total += square
        return weights, total

    def cost(self, z: Array) -> float:
        """Without a factor one half."""
        away = self.root @ (z[: self.d + self.q] - self.belief.mean)
        noise = z[self.d + self.q :] ** 2 / self.accel_variance.ravel()
        return float(away @ away + noise.sum() + self.weights_and_cost(self.misses(z))[1])

    def gauss_newton(self, z: Array) -> tuple[Array, Array]:
        """The Hessian, of reweighted rows where these are robust, and the step."""
        misses, slopes, cut = self.misses(z), self.slopes(z), self.d + self.q
        weights = self.weights_and_cost(misses)[0]
        hessian = slopes.T @ (weights[:, None] * slopes)
        hessian[:cut, :cut] += self.root.T @ self.root
        hessian[range(cut, self.size), range(cut, self.size)] += 1.0 / self.accel_variance.ravel()
        gradient = slopes.T @ (weights * misses)
        gradient[:cut] -= self.root.T @ (self.root @ (z[:cut] - self.belief.mean))
        gradient[cut:] -= z[cut:] / self.accel_variance.ravel()
        return hessian, np.linalg.solve(hessian, gradient)

    def minimise(self, z: Array, iterations: int = 300) -> JointOptimum:
        """From ``z``, by damped Gauss-Newton, until nothing moves."""
        cost = self.cost(z)
        for _ in range(iterations):
            _, step = self.gauss_newton(z)
            length = 1.0
            while length > 1e-8 and self.cost(z + length * step) > cost + 1e-12 * (1.0 + cost):
                length *= 0.5
            z = z + length * step
            cost = self.cost(z)
            if np.abs(length * step).max() < 1e-12:
                break
        # the cost is down to its rounding: half steps contract where whole ones swing, where norms bend smaller parts
        share, before = 0.5, np.inf
        for _ in range(iterations):
            step = self.gauss_newton(z)[1]
            size = float(np.abs(step).max())
            if size < 1e-11:
                break
            share, before = 0.5 * share if size > before else share, size
            z = z + share * step
        cost, step = self.cost(z), self.gauss_newton(z)[1]
        return JointOptimum(z, self.path(z), z[self.d : self.d + self.q], cost, float(np.abs(step).max()))

    def start_at_prior(self) -> Array:
        """The belief's mean and no noise."""
        return np.concatenate([self.belief.mean, np.zeros(self.size - self.d - self.q)])

    def newest_covariance(self, z: Array) -> Array:
        """Of the newest state and the slow errors, by the Hessian over everything."""
        carry = np.zeros((self.d + self.q, self.size))
        carry[: self.d] = self.moves[-1]
        carry[self.d :, self.d : self.d + self.q] = np.eye(self.q)
        return np.asarray(carry @ np.linalg.inv(self.gauss_newton(z)[0]) @ carry.T)
