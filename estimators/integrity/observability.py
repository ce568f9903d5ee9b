"""Observability of a fleet from the rows one agent has."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimators.compiled.entries import entry
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import ROW, Matrix, RowTable, Vector
from estimators.model.row_kernels import add_gradient, encode_rows, predict_row


@entry("void(ROW[::1], float64[::1], float64, float64[::1], float64[:, ::1])", ROW=ROW)
def linearise(rows: RowTable, state: Vector, eps: float, predicted: Vector, jacobian: Matrix) -> None:
    """predicted ``(m,)`` <- h(state), jacobian ``(m, 6n)`` <- its derivative (19), whatever the rows' ticks."""
    m = rows.shape[0]
    code = np.empty((m, 3), np.int64)
    data = np.empty((m, 7))
    unit = np.empty(4)
    encode_rows(rows, np.arange(state.shape[0] // STATES_PER_AGENT), code, data)
    jacobian[:, :] = 0.0
    for r in range(m):
        predicted[r] = predict_row(code, data, r, state, eps, unit)
        add_gradient(code, data, r, unit, 1.0, jacobian[r])


def row_jacobian(rows: RowTable, state: Vector, eps: float) -> tuple[Vector, Matrix]:
    """h ``(m,)`` and its derivative ``(m, 6n)`` at a fleet state."""
    predicted, jacobian = np.empty(len(rows)), np.empty((len(rows), len(state)))
    linearise(np.ascontiguousarray(rows), state, eps, predicted, jacobian)
    return predicted, jacobian


def observability_matrix(
    rows_by_tick: Sequence[RowTable], states: Sequence[Vector], dt: float, eps: float
) -> Matrix:
    """Stacked C_k A^k of the regional rows, Borelle et al. 2023, eq. (24), ``(rows, 6n)``."""
    blocks = []
    for k, (rows, state) in enumerate(zip(rows_by_tick, states, strict=True)):
        block = row_jacobian(rows, state, eps)[1]
        # C A^k: positions move with k dt times the velocity
        shaped = block.reshape(len(rows), len(state) // STATES_PER_AGENT, STATES_PER_AGENT)
        shaped[:, :, 3:] += k * dt * shaped[:, :, :3]
        blocks.append(block)
    return np.vstack(blocks)


def observability_rank(
    rows_by_tick: Sequence[RowTable], states: Sequence[Vector], dt: float, eps: float
) -> int:
    """Rank of (24), eq. (25), with numpy's default tolerance; 0 without rows."""
    matrix = observability_matrix(rows_by_tick, states, dt, eps)
    if not matrix.size:
        return 0
    values = np.linalg.svd(matrix, compute_uv=False)
    return int(np.count_nonzero(values > values[0] * max(matrix.shape) * np.finfo(np.float64).eps))
