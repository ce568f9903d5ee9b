"""The local problem of the consensus MHE: the own drone and the targets that it ranges, over a window.

Bassolillo, D'Amato and Notaro 2025 (Drones 9(2):127), reconstructed. Linearised at the states X that the agent holds
of the whole fleet, over the states x of its own drone and of the targets that it ranges, in all slots s:

    minimise    |x_0 - prior|^2_P  +  sum |x_{s+1} - A x_s - B u_s|^2_Q  +  sum |y_s - h(X_s) - H_s (x_s - X_s)|^2_R
    subject to  |p_target - p_own| <= box  per axis,    p_target,D >= -ceiling.

Other drones stay where X has them. They are not there for sure, so their standard deviation widens their ranges':
without it the estimates diverge. Limits are looked at only where the free solution goes beyond one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.integrity.observability import row_jacobian
from estimators.model.layout import STATES_PER_AGENT, block, states_of
from estimators.model.measurements import Kind, Matrix, RowTable, Vector
from estimators.model.motion import input_matrix, transition_matrix
from estimators.solvers.qp import QpEngine, QuadraticProgram, solve_exactly

AXES = 3


@dataclass(frozen=True, slots=True)
class LocalModel:
    """Standard deviations of the local problem, position in m and velocity in m/s, and its limits.

    Process noise is that of a second; over a tick of T seconds its variance is T times as large. The defaults were
    found by trying: the paper's table is lost.
    """

    own_process: tuple[float, float] = (0.05, 0.1)
    target_process: tuple[float, float] = (0.05, 0.02)
    own_prior: tuple[float, float] = (0.5, 0.1)
    target_prior: tuple[float, float] = (2.0, 0.3)
    neighbour_sigma_m: float = 3.0
    """Of a neighbour's position along a range."""
    range_gate_m: float = np.inf
    """Ranges to neighbours that are further off are left out."""
    box_m: float = np.inf
    """How far the target sensor reaches, per axis."""
    ceiling_m: float = np.inf
    """Altitude that no target is above."""


@dataclass(frozen=True, slots=True)
class LocalWindow:
    """What the local problem is made of.

    ``path`` ``(S, 6n)`` are the states it is linearised at; ``bodies`` the slots of the own drone and of the targets;
    ``prior`` ``(B, 6)`` of their oldest states; ``rows`` the own measurements, ``start`` ``(S+1,)`` the first of each
    tick; ``accel`` ``(S-1, 3)`` of the own drone.
    """

    path: Matrix
    bodies: tuple[int, ...]
    prior: Matrix
    rows: RowTable
    start: NDArray[np.int64]
    accel: Matrix
    period_s: float
    eps: float


@dataclass(frozen=True, slots=True)
class LocalSolution:
    """States ``(S, B, 6)``, their information ``(6SB, 6SB)`` without limits, and what it took."""

    states: NDArray[np.float64]
    information: Matrix
    programs: int
    active: int
    solved: bool

    def newest_covariance(self) -> Matrix:
        """``(6B, 6B)`` of the newest states."""
        newest = STATES_PER_AGENT * self.states.shape[1]
        return np.asarray(np.linalg.inv(self.information)[-newest:, -newest:], np.float64)


def own_measurements(rows: RowTable, start: NDArray[np.int64], own: int) -> tuple[RowTable, NDArray[np.int64]]:
    """Those of a window that the own sensors made, and the first of each tick."""
    kept = rows["observer"] == own
    return rows[kept], np.concatenate(([0], np.cumsum(kept)))[start]


def ranged_targets(rows: RowTable, targets: Sequence[int]) -> tuple[int, ...]:
    """The targets that a table of rows has a range to, or a position of."""
    seen = {*rows["other"].tolist(), *rows["agent"].tolist()}
    return tuple(slot for slot in targets if slot in seen)


def solve_local(window: LocalWindow, model: LocalModel, engine: QpEngine) -> LocalSolution:
    """The minimum of a local problem."""
    jacobian, values = _equations(window, model)
    information = jacobian.T @ jacobian
    free = np.asarray(np.linalg.solve(information, jacobian.T @ values), np.float64)
    x, programs, active, solved = free, 0, 0, True
    rows, low, high = _limits(window, model)
    if len(rows) and not _within(rows @ free, low, high):
        # x = free + L^-T q makes the program one in q, with a unit Hessian
        unroot = np.linalg.inv(np.linalg.cholesky(information))
        at = rows @ free
        across = np.ascontiguousarray(rows @ unroot.T)
        program = QuadraticProgram(np.zeros(len(free)), across, low - at, high - at, np.full(len(rows), np.inf))
        solution = solve_exactly(program, engine, np.zeros(len(rows)))
        programs, active, solved = 1, int(np.count_nonzero(solution.multipliers)), solution.solved
        if solution.solved:
            x = free + unroot.T @ solution.q
    states = np.asarray(x.reshape(len(window.path), len(window.bodies), STATES_PER_AGENT), np.float64)
    return LocalSolution(states, information, programs, active, solved)


def _within(at: Vector, low: Vector, high: Vector) -> bool:
    return bool(((at >= low) & (at <= high)).all())


def _equations(window: LocalWindow, model: LocalModel) -> tuple[Matrix, Vector]:
    """All residuals, linear in the states and divided by their standard deviations: ``jacobian x - values``."""
    slots, bodies = len(window.path), len(window.bodies)
    width = STATES_PER_AGENT * bodies
    blocks, values = [], []

    first = np.zeros((width, slots * width))
    first[:, :width] = np.diag(1.0 / _per_state(model.own_prior, model.target_prior, bodies))
    blocks.append(first)
    values.append(window.prior.ravel() / _per_state(model.own_prior, model.target_prior, bodies))

    noise = _per_state(model.own_process, model.target_process, bodies) * np.sqrt(window.period_s)
    move, push = transition_matrix(bodies, window.period_s), input_matrix(1, window.period_s)
    for s in range(slots - 1):
        step = np.zeros((width, slots * width))
        step[:, s * width : (s + 1) * width] = -move
        step[:, (s + 1) * width : (s + 2) * width] = np.eye(width)
        pushed = np.zeros(width)
        pushed[:STATES_PER_AGENT] = push @ window.accel[s]
        blocks.append(step / noise[:, None])
        values.append(pushed / noise)

    at = states_of(window.bodies)
    for s in range(slots):
        rows = window.rows[window.start[s] : window.start[s + 1]]
        predicted, slopes = row_jacobian(rows, window.path[s], window.eps)
        variance, kept = _range_noise(rows, predicted, window.bodies, model)
        here = np.zeros((len(rows), slots * width))
        here[:, s * width : (s + 1) * width] = slopes[:, at]
        target = rows["value"] - predicted + slopes[:, at] @ window.path[s, at]
        sigma = np.sqrt(variance)
        blocks.append((here / sigma[:, None])[kept])
        values.append((target / sigma)[kept])
    return np.concatenate(blocks), np.concatenate(values)


def _range_noise(
    rows: RowTable, predicted: Vector, bodies: Sequence[int], model: LocalModel
) -> tuple[Vector, NDArray[np.bool_]]:
    """Variance of each row, with that of a neighbour's place, and whether the row is used."""
    to_neighbour = np.isin(rows["kind"], (Kind.RANGE, Kind.RELATIVE)) & ~_among(rows["other"], bodies)
    variance = rows["variance"] + np.where(to_neighbour, model.neighbour_sigma_m**2, 0.0)
    return variance, ~to_neighbour | (np.abs(rows["value"] - predicted) <= model.range_gate_m)


def _among(slots: NDArray[np.int32], bodies: Sequence[int]) -> NDArray[np.bool_]:
    return np.asarray((slots[:, None] == np.array(bodies)).any(axis=1))


def _per_state(own: tuple[float, float], target: tuple[float, float], bodies: int) -> Vector:
    """Standard deviations ``(6B,)`` of the states of the own drone and the targets."""
    return np.concatenate([np.repeat(own, AXES), np.tile(np.repeat(target, AXES), bodies - 1)])


def _limits(window: LocalWindow, model: LocalModel) -> tuple[Matrix, Vector, Vector]:
    """Rows ``(m, D)`` on all states, and between what they have to be."""
    slots, bodies = len(window.path), len(window.bodies)
    width = STATES_PER_AGENT * bodies
    rows: list[Vector] = []
    low: list[float] = []
    high: list[float] = []
    for s in range(slots):
        for body in range(1, bodies):
            there = s * width + block(body).start
            for axis in range(AXES if np.isfinite(model.box_m) else 0):
                row = np.zeros(slots * width)
                row[there + axis], row[s * width + axis] = 1.0, -1.0
                rows.append(row)
                low.append(-model.box_m)
                high.append(model.box_m)
            if np.isfinite(model.ceiling_m):
                row = np.zeros(slots * width)
                row[there + AXES - 1] = 1.0
                rows.append(row)
                low.append(-model.ceiling_m)
                high.append(np.inf)
    return np.array(rows).reshape(len(rows), slots * width), np.array(low), np.array(high)
