"""Compiled evaluation of measurement rows: value, gradient, curvature.

A window's rows enter the kernels as two arrays, sorted by tick: ``code`` ``(m, 3)`` int64 holds kind (VELOCITY for
ODOMETRY, which differs in whose sensor it is) and the first state index of the two agents (-1: none); ``data``
``(m, 7)`` float64 holds offset, value, 1/variance, half width, and the vector ``x y z`` of
`estimators.measurements.ROW`.

A gradient has the same shape for all kinds: a 3-vector u that acts on the position (and, times the offset, on
the velocity) of one or two agents, or on the velocity of one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimators.compiled.entries import entry, kernel
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import ROW, Kind, Matrix, RowTable, Vector

IntArray = NDArray[np.int64]

POSITION = int(Kind.POSITION)
VELOCITY = int(Kind.VELOCITY)
SPEED = int(Kind.SPEED)
RANGE = int(Kind.RANGE)
ANCHOR_RANGE = int(Kind.ANCHOR_RANGE)
HEIGHT = int(Kind.HEIGHT)
ODOMETRY = int(Kind.ODOMETRY)
RELATIVE = int(Kind.RELATIVE)
LAST_KIND = int(max(Kind))

OFFSET, VALUE, PRECISION, HALF_WIDTH, X, Y, Z = range(7)


@entry("void(ROW[::1], int64, boolean[::1])", ROW=ROW)
def mark_usable(rows: RowTable, agents: int, usable: NDArray[np.bool_]) -> None:
    """usable ``(m,)`` <- whether an estimator of so many agents can use each row.

    Finite, with a positive variance and bound, of a known kind, of agents in the fleet; a range, or a relative
    position, between two of them.
    """
    for r in range(rows.shape[0]):
        row = rows[r]
        kind = row["kind"]
        other = row["other"]
        finite = np.isfinite(row["offset_s"]) and np.isfinite(row["value"]) and np.isfinite(row["variance"])
        finite = finite and np.isfinite(row["x"]) and np.isfinite(row["y"]) and np.isfinite(row["z"])
        known = 0 <= row["agent"] < agents and 0 <= row["observer"] < agents and 0 <= kind <= LAST_KIND
        paired = (0 <= other < agents and other != row["agent"]) if kind in (RANGE, RELATIVE) else other == -1
        usable[r] = finite and row["variance"] > 0.0 and row["half_width"] > 0.0 and known and paired


@entry("boolean(ROW[::1], int64, int64)", ROW=ROW)
def any_of(rows: RowTable, kind: int, agent: int) -> bool:
    """Whether a row of a kind measures an agent."""
    found = False
    for r in range(rows.shape[0]):
        found = found or (rows[r]["kind"] == kind and rows[r]["agent"] == agent)
    return found


@kernel
def encode_rows(rows: RowTable, local: IntArray, code: IntArray, data: Matrix) -> None:
    """Fill ``code`` and ``data`` from the row table; ``local[slot]`` is the slot in the reduced problem."""
    for r in range(rows.shape[0]):
        row = rows[r]
        code[r, 0] = VELOCITY if row["kind"] == ODOMETRY else row["kind"]
        code[r, 1] = STATES_PER_AGENT * local[row["agent"]]
        code[r, 2] = -1 if row["other"] < 0 else STATES_PER_AGENT * local[row["other"]]
        data[r, OFFSET] = row["offset_s"]
        data[r, VALUE] = row["value"]
        data[r, PRECISION] = 1.0 / row["variance"]
        data[r, HALF_WIDTH] = row["half_width"]
        data[r, X] = row["x"]
        data[r, Y] = row["y"]
        data[r, Z] = row["z"]


@kernel
def predict_row(code: IntArray, data: Matrix, r: int, x: Vector, eps: float, unit: Vector) -> float:
    """h of row r at state x; ``unit`` ``(4,)`` gets u and, for norm rows, the norm (0 for linear rows).

    The norm sqrt(e'e + eps^2) has gradient u = e / norm and curvature (I - u u') / norm.
    """
    kind = code[r, 0]
    a = code[r, 1]
    offset = data[r, OFFSET]
    if kind == VELOCITY:
        unit[0] = data[r, X]
        unit[1] = data[r, Y]
        unit[2] = data[r, Z]
        unit[3] = 0.0
        return float(unit[0] * x[a + 3] + unit[1] * x[a + 4] + unit[2] * x[a + 5])
    if kind == SPEED:
        e0 = x[a + 3] + data[r, X]
        e1 = x[a + 4] + data[r, Y]
        e2 = x[a + 5] + data[r, Z]
    else:
        e0 = x[a] + offset * x[a + 3]
        e1 = x[a + 1] + offset * x[a + 4]
        e2 = x[a + 2] + offset * x[a + 5]
        if kind == POSITION:
            unit[0] = data[r, X]
            unit[1] = data[r, Y]
            unit[2] = data[r, Z]
            unit[3] = 0.0
            return float(unit[0] * e0 + unit[1] * e1 + unit[2] * e2)
        if kind == HEIGHT:
            unit[0] = 0.0
            unit[1] = 0.0
            unit[2] = 1.0
            unit[3] = 0.0
            return float(e2)
        if kind == RELATIVE:
            b = code[r, 2]
            unit[0] = data[r, X]
            unit[1] = data[r, Y]
            unit[2] = data[r, Z]
            unit[3] = 0.0
            e0 -= x[b] + offset * x[b + 3]
            e1 -= x[b + 1] + offset * x[b + 4]
            e2 -= x[b + 2] + offset * x[b + 5]
            return float(unit[0] * e0 + unit[1] * e1 + unit[2] * e2)
        if kind == RANGE:
            b = code[r, 2]
            e0 -= x[b] + offset * x[b + 3] - data[r, X]
            e1 -= x[b + 1] + offset * x[b + 4] - data[r, Y]
            e2 -= x[b + 2] + offset * x[b + 5] - data[r, Z]
        else:
            e0 -= data[r, X]
            e1 -= data[r, Y]
            e2 -= data[r, Z]
    norm = np.sqrt(e0 * e0 + e1 * e1 + e2 * e2 + eps * eps)
    unit[0] = e0 / norm
    unit[1] = e1 / norm
    unit[2] = e2 / norm
    unit[3] = norm
    return float(norm)


@kernel
def add_gradient(code: IntArray, data: Matrix, r: int, unit: Vector, weight: float, out: Vector) -> None:
    """out += weight * dh/dx of row r, a vector over the state."""
    a = code[r, 1]
    if code[r, 0] == VELOCITY or code[r, 0] == SPEED:
        for i in range(3):
            out[a + 3 + i] += weight * unit[i]
        return
    offset = data[r, OFFSET]
    b = code[r, 2]
    for i in range(3):
        w = weight * unit[i]
        out[a + i] += w
        out[a + 3 + i] += w * offset
        if b >= 0:
            out[b + i] -= w
            out[b + 3 + i] -= w * offset


@kernel
def dot_gradient(code: IntArray, data: Matrix, r: int, unit: Vector, vector: Vector) -> float:
    """dh/dx of row r times a vector over the state."""
    a = code[r, 1]
    total = 0.0
    if code[r, 0] == VELOCITY or code[r, 0] == SPEED:
        for i in range(3):
            total += unit[i] * vector[a + 3 + i]
        return total
    offset = data[r, OFFSET]
    b = code[r, 2]
    for i in range(3):
        e = vector[a + i] + offset * vector[a + 3 + i]
        if b >= 0:
            e -= vector[b + i] + offset * vector[b + 3 + i]
        total += unit[i] * e
    return total


@kernel
def chain_gradient(code: IntArray, data: Matrix, r: int, unit: Vector, sens: Matrix, out: Vector) -> None:
    """out <- dh/dx of row r times the sensitivity ``sens`` ``(states, variables)``."""
    a = code[r, 1]
    m = sens.shape[1]
    u0 = unit[0]
    u1 = unit[1]
    u2 = unit[2]
    if code[r, 0] == VELOCITY or code[r, 0] == SPEED:
        for j in range(m):
            out[j] = u0 * sens[a + 3, j] + u1 * sens[a + 4, j] + u2 * sens[a + 5, j]
        return
    offset = data[r, OFFSET]
    for j in range(m):
        out[j] = u0 * sens[a, j] + u1 * sens[a + 1, j] + u2 * sens[a + 2, j]
    b = code[r, 2]
    if b >= 0:
        for j in range(m):
            out[j] -= u0 * sens[b, j] + u1 * sens[b + 1, j] + u2 * sens[b + 2, j]
    if offset != 0.0:
        for j in range(m):
            out[j] += offset * (u0 * sens[a + 3, j] + u1 * sens[a + 4, j] + u2 * sens[a + 5, j])
        if b >= 0:
            for j in range(m):
                out[j] -= offset * (u0 * sens[b + 3, j] + u1 * sens[b + 4, j] + u2 * sens[b + 5, j])


@kernel
def add_curvature(
    code: IntArray, data: Matrix, r: int, unit: Vector, outer: float, second: float, hessian: Matrix
) -> None:
    """hessian += outer * dh dh' + second * d2h of row r, both triangles, over the state."""
    m00 = np.empty((3, 3))
    curvature = second / unit[3] if unit[3] > 0.0 else 0.0
    for i in range(3):
        for j in range(3):
            m00[i, j] = (outer - curvature) * unit[i] * unit[j]
        m00[i, i] += curvature
    a = code[r, 1]
    if code[r, 0] == VELOCITY or code[r, 0] == SPEED:
        for i in range(3):
            for j in range(3):
                hessian[a + 3 + i, a + 3 + j] += m00[i, j]
        return
    offset = data[r, OFFSET]
    b = code[r, 2]
    _add_position_block(hessian, a, a, m00, 1.0, offset)
    if b >= 0:
        _add_position_block(hessian, b, b, m00, 1.0, offset)
        _add_position_block(hessian, a, b, m00, -1.0, offset)
        _add_position_block(hessian, b, a, m00, -1.0, offset)


@kernel
def _add_position_block(hessian: Matrix, a: int, b: int, m: Matrix, sign: float, offset: float) -> None:
    """Add sign * m to the block of agents a, b: position by position, and velocities times the offset."""
    for i in range(3):
        for j in range(3):
            hessian[a + i, b + j] += sign * m[i, j]
            if offset != 0.0:
                hessian[a + 3 + i, b + j] += sign * offset * m[i, j]
                hessian[a + i, b + 3 + j] += sign * offset * m[i, j]
                hessian[a + 3 + i, b + 3 + j] += sign * offset * offset * m[i, j]
