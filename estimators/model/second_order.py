"""What the linearisation of a norm misses, of a range or a speed: the mean square of its second-order term.

A range row is linearised at the estimated places of its two ends. With a relative position error delta of
covariance D about an estimated distance rho along the unit vector u,

    |r + delta| = rho + u' delta + 1/2 delta' T delta + ...,      T = (I - u u') / rho,

and for Gaussian delta the neglected term has the mean square 1/2 tr(T D T D) + 1/4 tr(T D)^2 (second-order
extended Kalman filter, e.g. Bar-Shalom, Li, Kirubarajan 2001, section 10.3; its mean is not corrected here). Where
a place is known well against the distance it vanishes; where it is not, the row says next to nothing about a
direction, and counting it with the sensor's variance alone makes the estimate overconfident for good, because
what an arrival cost once holds is never linearised anew.

A speed without a direction is the same with a velocity in place of the way between two ends: a fleet that starts
slowly, with a velocity that is not known, would be sure of the first one that fits.
"""

from __future__ import annotations

import numpy as np

from estimators.compiled.entries import kernel
from estimators.model.layout import STATES_PER_AGENT
from estimators.model.measurements import Kind, Matrix, Vector

_SPEED, _RANGE, _ANCHOR_RANGE = int(Kind.SPEED), int(Kind.RANGE), int(Kind.ANCHOR_RANGE)


@kernel
def linearisation_variance(row: np.void, state: Vector, covariance: Matrix, eps: float) -> float:
    """Mean square in m2 of what a row's linearisation misses, 1/2 tr(TDTD) + 1/4 tr(TD)^2; zero for linear rows.

    In m2/s2 for a speed.

    ``state`` ``(6n,)``: where the row is linearised; ``covariance`` ``(6n, 6n)`` of the fleet state; ``eps`` as in
    the rows' smoothed norm, m.
    """
    away, spread = np.empty(3), np.empty((3, 3))
    a = STATES_PER_AGENT * row["agent"]
    if row["kind"] == _SPEED:
        shift = (row["x"], row["y"], row["z"])
        for i in range(3):
            away[i] = state[a + 3 + i] + shift[i]
            for j in range(3):
                spread[i, j] = covariance[a + 3 + i, a + 3 + j]
    elif row["kind"] == _RANGE or row["kind"] == _ANCHOR_RANGE:
        _between_ends(row, state, covariance, away, spread)
    else:
        return 0.0
    bent = np.empty((3, 3))
    distance = np.sqrt(away[0] * away[0] + away[1] * away[1] + away[2] * away[2] + eps * eps)
    for i in range(3):
        for j in range(3):
            bent[i, j] = 0.0
            for k in range(3):
                identity = 1.0 if i == k else 0.0
                curvature = (identity - away[i] / distance * (away[k] / distance)) / distance
                bent[i, j] += curvature * spread[k, j]
    squares, trace = 0.0, 0.0
    for i in range(3):
        trace += bent[i, i]
        for j in range(3):
            squares += bent[i, j] * bent[j, i]
    return float(0.5 * squares + 0.25 * trace * trace)


@kernel
def _between_ends(row: np.void, state: Vector, covariance: Matrix, away: Vector, spread: Matrix) -> None:
    """away ``(3,)``, spread ``(3, 3)`` <- from one end of a range to the other, and its covariance."""
    a, o = STATES_PER_AGENT * row["agent"], row["offset_s"]
    b = STATES_PER_AGENT * row["other"]  # negative for anchors
    anchor = (row["x"], row["y"], row["z"])  # or, between agents, the shift of the one against the other
    for i in range(3):
        there = state[b + i] + o * state[b + 3 + i] - anchor[i] if b >= 0 else anchor[i]
        away[i] = state[a + i] + o * state[a + 3 + i] - there
        for j in range(3):
            middle = _relative(covariance, a, b, i + 3, j) + _relative(covariance, a, b, i, j + 3)
            ends = o * o * _relative(covariance, a, b, i + 3, j + 3)
            spread[i, j] = _relative(covariance, a, b, i, j) + o * middle + ends


@kernel
def _relative(covariance: Matrix, a: int, b: int, i: int, j: int) -> float:
    """Element of the covariance of the difference of two agents' states that begin at ``a`` and ``b``.

    With ``b`` negative of the one at ``a`` alone.
    """
    value: float = covariance[a + i, a + j]
    if b >= 0:
        value = value + covariance[b + i, b + j] - covariance[a + i, b + j] - covariance[a + j, b + i]
    return value
