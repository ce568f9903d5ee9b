"""Measurement rows as corrections of a belief in information form."""

from __future__ import annotations

import numpy as np

from estimators.compiled.entries import kernel
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import Matrix, RowTable, Vector
from estimators.model.row_kernels import (
    PRECISION,
    VALUE,
    add_curvature,
    add_gradient,
    dot_gradient,
    encode_rows,
    predict_row,
)


@kernel
def add_corrections(
    rows: RowTable, predicted: Vector, eps: float, information: Matrix, vector: Vector
) -> None:
    """Add rows to an information pair, linearised at ``predicted``: C'R^-1 C and C'R^-1 (y - h + C x)."""
    m = rows.shape[0]
    code = np.empty((m, 3), np.int64)
    data = np.empty((m, 7))
    unit = np.empty(4)
    encode_rows(rows, np.arange(predicted.shape[0] // STATES_PER_AGENT), code, data)
    for r in range(m):
        innovation = data[r, VALUE] - predict_row(code, data, r, predicted, eps, unit)
        pseudo = innovation + dot_gradient(code, data, r, unit, predicted)
        add_gradient(code, data, r, unit, data[r, PRECISION] * pseudo, vector)
        add_curvature(code, data, r, unit, data[r, PRECISION], 0.0, information)


@kernel
def add_row_information(rows: RowTable, state: Vector, eps: float, information: Matrix) -> None:
    """information += C' R^-1 C of rows linearised at ``state`` ``(6n,)``."""
    m = rows.shape[0]
    code = np.empty((m, 3), np.int64)
    data = np.empty((m, 7))
    unit = np.empty(4)
    encode_rows(rows, np.arange(state.shape[0] // STATES_PER_AGENT), code, data)
    for r in range(m):
        predict_row(code, data, r, state, eps, unit)
        add_curvature(code, data, r, unit, data[r, PRECISION], 0.0, information)
