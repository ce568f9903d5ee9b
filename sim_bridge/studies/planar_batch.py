"""Everything at once: the least-squares path of planar robots over a whole recording, with biases of their ranges.

Gauss-Newton on the places at every tick, joined by the odometry over each tick, the ranges at their own instants
between two ticks (by linear interpolation), and one constant bias a pair. No priors but a loose one on the biases and
the start. It sees all data before and after, so it is a reference, not an estimator that flies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

from sim_bridge.studies.study_input import StudyInput
from sim_bridge.studies.study_rows import RowKind

Floats = NDArray[np.float64]
BIAS_M = 1.0
"""1-sigma of a bias before anything is measured."""
ITERATIONS = 12


@dataclass(frozen=True, slots=True)
class BatchSolution:
    """``position_m`` ``(T+1, n, 2)`` north and east; ``bias_m`` by pair of places, empty where none was asked for."""

    position_m: Floats
    bias_m: dict[tuple[int, int], float]


def solve_batch(recording: StudyInput, *, biases: bool) -> BatchSolution:
    """The whole recording; it begins where the recording's first estimate is. Raises `ValueError` without rows."""
    if recording.rows is None:
        raise ValueError("rows: expected a study input of version 2")
    n, count = len(recording.agents), recording.ticks + 1
    pairs = [(a, b) for a in range(n) for b in range(a + 1, n)] if biases else []
    problem = _Problem(recording, pairs)
    state: Floats = np.zeros(count * n * 2 + len(pairs))
    state[: count * n * 2] = problem.dead_reckoned()
    for _ in range(ITERATIONS):
        step = problem.step(state)
        state = state + step
        if np.abs(step).max() < 1e-6:
            break
    bias = state[count * n * 2 :]
    return BatchSolution(
        state[: count * n * 2].reshape(count, n, 2), {pair: float(bias[k]) for k, pair in enumerate(pairs)}
    )


class _Problem:
    """Residuals and their sparse Jacobian, each divided by its sigma."""

    def __init__(self, recording: StudyInput, pairs: list[tuple[int, int]]) -> None:
        rows = recording.rows
        assert rows is not None
        self._n, self._count, self._pairs = len(recording.agents), recording.ticks + 1, pairs
        self._period_s, self._rows = recording.period_s, rows
        self._start = recording.x0[0].reshape(self._n, 6)[:, :2]
        self._start_sigma = np.sqrt(np.diag(recording.P0)[0])
        ranged = np.isin(rows.kind, (RowKind.RANGE, RowKind.ANCHOR_RANGE))
        self._ranged = np.flatnonzero(ranged)
        self._moved = np.flatnonzero(np.isin(rows.kind, (RowKind.VELOCITY_N, RowKind.VELOCITY_E)))
        self._pair_at = {pair: k for k, pair in enumerate(pairs)}

    def _at(
        self, tick: NDArray[np.int64], body: NDArray[np.int64], axis: NDArray[np.int64] | int
    ) -> NDArray[np.int64]:
        return np.asarray((tick * self._n + body) * 2 + axis, np.int64)

    def _begins(self, chosen: NDArray[np.int64]) -> tuple[NDArray[np.int64], Floats]:
        """The tick before each row's instant, and how far it is to the next, 0..1."""
        time = self._rows.tick[chosen] + self._rows.offset_s[chosen] / self._period_s
        tick = np.clip(np.floor(time), 0, self._count - 2).astype(np.int64)
        return tick, time - tick

    def dead_reckoned(self) -> Floats:
        """The path that odometry makes."""
        place = np.zeros((self._count, self._n, 2))
        tick, _ = self._begins(self._moved)
        moved = np.zeros((self._count - 1, self._n, 2))
        axis = self._rows.kind[self._moved] - int(RowKind.VELOCITY_N)
        moved[tick, self._rows.body[self._moved], axis] = self._rows.value[self._moved] * self._period_s
        place[0] = self._start
        place[1:] = self._start + np.cumsum(moved, axis=0)
        return place.ravel()

    def step(self, state: Floats) -> Floats:
        """The Gauss-Newton step."""
        blocks = [self._odometry(state), self._ranges(state), self._priors(state)]
        heights = [len(residual) for residual, *_ in blocks]
        offsets = np.concatenate(([0], np.cumsum(heights)[:-1]))
        row = np.concatenate([at + offset for (_, at, _, _), offset in zip(blocks, offsets, strict=True)])
        column = np.concatenate([each for _, _, each, _ in blocks])
        value = np.concatenate([each for *_, each in blocks])
        residual = np.concatenate([each for each, *_ in blocks])
        jacobian = coo_matrix((value, (row, column)), shape=(len(residual), len(state))).tocsr()
        return np.asarray(spsolve((jacobian.T @ jacobian).tocsc(), jacobian.T @ residual), float)

    def _odometry(self, state: Floats) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64], Floats]:
        chosen = self._moved
        tick, _ = self._begins(chosen)
        body, axis = self._rows.body[chosen], self._rows.kind[chosen] - int(RowKind.VELOCITY_N)
        sigma_m = np.sqrt(self._rows.variance[chosen]) * self._period_s
        begin, end = self._at(tick, body, axis), self._at(tick + 1, body, axis)
        residual = (self._rows.value[chosen] * self._period_s - (state[end] - state[begin])) / sigma_m
        at = np.arange(len(chosen))
        return (
            residual,
            np.concatenate((at, at)),
            np.concatenate((begin, end)),
            np.concatenate((-1.0 / sigma_m, 1.0 / sigma_m)),
        )

    def _ranges(self, state: Floats) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64], Floats]:
        rows, chosen = self._rows, self._ranged
        tick, share = self._begins(chosen)
        body, other, sigma_m = rows.body[chosen], rows.other[chosen], np.sqrt(rows.variance[chosen])
        between = rows.kind[chosen] == RowKind.RANGE
        place = state[: self._count * self._n * 2].reshape(self._count, self._n, 2)

        def then(who: NDArray[np.int64]) -> Floats:
            return np.asarray((1.0 - share)[:, None] * place[tick, who] + share[:, None] * place[tick + 1, who])

        far = then(np.where(between, other, 0))
        far[~between] = rows.anchors_m[other[~between], :2]
        apart = then(body) - far
        distance = np.maximum(np.linalg.norm(apart, axis=1), 1e-6)
        toward = apart / distance[:, None]
        residual, at = rows.value[chosen] - distance, np.arange(len(chosen))
        entries = []
        for who, sign, which in ((body, 1.0, np.ones(len(chosen), bool)), (other, -1.0, between)):
            for axis in range(2):
                for later, weight in ((0, 1.0 - share), (1, share)):
                    column = self._at(tick + later, who, axis)[which]
                    entries.append((at[which], column, (sign * weight * toward[:, axis] / sigma_m)[which]))
        if self._pairs:
            ends = np.sort(np.column_stack((body, other))[between], axis=1)
            which = np.array([self._pair_at[a, b] for a, b in ends.tolist()], np.int64)
            first = self._count * self._n * 2
            residual[between] -= state[first + which]
            entries.append((at[between], first + which, 1.0 / sigma_m[between]))
        rows_at, columns, values = (np.concatenate(each) for each in zip(*entries, strict=True))
        return residual / sigma_m, rows_at, columns, values

    def _priors(self, state: Floats) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64], Floats]:
        first, begin = self._count * self._n * 2, self._start.ravel()
        sigma_m = np.concatenate((np.full(len(begin), self._start_sigma), np.full(len(self._pairs), BIAS_M)))
        at = np.arange(len(sigma_m))
        column = np.concatenate((np.arange(len(begin)), first + np.arange(len(self._pairs))))
        expected = np.concatenate((begin, np.zeros(len(self._pairs))))
        return (expected - state[column]) / sigma_m, at, column, 1.0 / sigma_m
