"""One step of a relative filter, compiled: what the set of a neighbour's relative position goes through in a tick."""

from __future__ import annotations

import numpy as np

from estimators.compiled.entries import entry, kernel
from estimators.integrity.sets.kernels import EMPTY, add_ellipsoid, cut_strip, range_strip
from estimators.model.measurements import Matrix, Vector

PREDICTION_EMPTY, SNAPSHOT_EMPTY, BOTH_EMPTY = 1, 2, 3
"""What of a tick's bounds contradict each other; 0: none. `SNAPSHOT_EMPTY` is what was measured now by itself."""


@entry(
    "int64(float64[::1], float64[:, ::1], boolean, float64[::1], float64[::1], "
    "float64[::1], float64[::1], float64[:, ::1])"
)
def step(
    c: Vector, p: Matrix, known: bool, moved: Vector, slack: Vector, low: Vector, high: Vector, ranges: Matrix
) -> int:
    """(c, P) <- the set after a tick, in place; gives what was empty. Metres, NED.

    ``known``: whether there was a set. It ``moved`` ``(3,)``, give or take ``slack`` ``(3,)`` per axis, infinite
    where nothing is known. ``low``, ``high`` ``(3,)``: the box of now, infinite where there is none. ``ranges``
    ``(m, 5)``: range, half width, and how far the set has moved since. The set that moved and the box are both cut;
    the smaller by trace is kept. Where the box is empty, that is the set that moved; where that is, it is kept
    uncut: what was measured may be what is wrong. P is infinite where there is neither.
    """
    predictable = known and np.isfinite(slack).all()
    boxed = np.isfinite(low).all() and np.isfinite(high).all()
    found = 0
    if predictable:
        add_ellipsoid(c, p, moved, _box(slack))
        cut_c, cut_p = c.copy(), p.copy()
        if _cut_by_box(cut_c, cut_p, low, high) == EMPTY or _cut_by_ranges(cut_c, cut_p, ranges) == EMPTY:
            found |= PREDICTION_EMPTY
    else:
        for i in range(3):
            p[i, i] = np.inf
        cut_c, cut_p = c.copy(), p.copy()
    if boxed:
        box_c, box_p = 0.5 * (low + high), _box(0.5 * (high - low))
        if _cut_by_ranges(box_c, box_p, ranges) == EMPTY:
            found |= SNAPSHOT_EMPTY
        elif (found & PREDICTION_EMPTY) == 0 and not _trace(cut_p) <= _trace(box_p):
            cut_c, cut_p = box_c, box_p
    if (found & PREDICTION_EMPTY) == 0:
        c[:] = cut_c
        p[:] = cut_p
    return found


@kernel
def _box(half_widths: Vector) -> Matrix:
    """Shape of the ellipsoid of least trace around a box."""
    shape, total = np.zeros((3, 3)), half_widths.sum()
    for i in range(3):
        shape[i, i] = half_widths[i] * total
    return shape


@kernel
def _trace(p: Matrix) -> float:
    return float(p[0, 0] + p[1, 1] + p[2, 2])


@kernel
def _cut_by_box(c: Vector, p: Matrix, low: Vector, high: Vector) -> int:
    row, done = np.zeros(3), 0
    for i in range(3):
        if np.isfinite(low[i]) and np.isfinite(high[i]):
            row[:] = 0.0
            row[i] = 1.0
            done = cut_strip(c, p, row, low[i], high[i])[0]
            if done == EMPTY:
                return EMPTY
    return 0


@kernel
def _cut_by_ranges(c: Vector, p: Matrix, ranges: Matrix) -> int:
    """Each range holds for where the set was then: its strip is made there and moved along."""
    u = np.zeros(3)
    for k in range(ranges.shape[0]):
        then = c - ranges[k, 2:]
        distance = np.sqrt(then[0] * then[0] + then[1] * then[1] + then[2] * then[2])
        u[:] = 0.0
        u[0] = 1.0
        if distance > 0.0:
            u[:] = then / distance
        low, high, _ = range_strip(then, p, u, ranges[k, 0], ranges[k, 1])
        along = u[0] * ranges[k, 2] + u[1] * ranges[k, 3] + u[2] * ranges[k, 4]
        if cut_strip(c, p, u, low + along, high + along)[0] == EMPTY:
            return EMPTY
    return 0
