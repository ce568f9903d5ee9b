"""What the linearisation of a range misses: the mean square of its second-order term.

A range row is linearised at the estimated places of its two ends. With a relative position error delta of
covariance D about an estimated distance rho along the unit vector u,

    |r + delta| = rho + u' delta + 1/2 delta' T delta + ...,      T = (I - u u') / rho,

and for Gaussian delta the neglected term has the mean square 1/2 tr(T D T D) + 1/4 tr(T D)^2 (second-order
extended Kalman filter, e.g. Bar-Shalom, Li, Kirubarajan 2001, section 10.3; its mean is not corrected here). Where
a place is known well against the distance it vanishes; where it is not, the row says next to nothing about a
direction, and counting it with the sensor's variance alone makes the estimate overconfident for good, because
what an arrival cost once holds is never linearised anew.
"""

from __future__ import annotations

import numpy as np

from estimators.layout import STATES_PER_AGENT
from estimators.measurements import Kind, Matrix, RowTable, Vector


def linearisation_variance(rows: RowTable, states: Matrix, covariance: Matrix, eps: float) -> Vector:
    """Mean square ``(m,)`` in m2 of what each row's linearisation misses; zero for rows that are no ranges.

    ``states`` ``(m, 6n)``: where each row is linearised; ``covariance`` ``(6n, 6n)`` of the fleet state; ``eps`` as
    in the rows' smoothed norm, m.
    """
    missed = np.zeros(len(rows))
    ranges = np.flatnonzero((rows["kind"] == Kind.RANGE) | (rows["kind"] == Kind.ANCHOR_RANGE))
    if not len(ranges):
        return missed
    chosen = rows[ranges]
    agents = len(covariance) // STATES_PER_AGENT
    blocks = covariance.reshape(agents, STATES_PER_AGENT, agents, STATES_PER_AGENT)
    bodies = states[ranges].reshape(len(ranges), agents, STATES_PER_AGENT)
    at, a, b, offset = np.arange(len(ranges)), chosen["agent"], chosen["other"], chosen["offset_s"][:, None]
    paired = b >= 0
    anchor = np.stack([chosen["x"], chosen["y"], chosen["z"]], axis=-1)
    other = bodies[at, b]  # for anchors the last body, which is not used
    there = np.where(paired[:, None], other[:, :3] + offset * other[:, 3:], anchor)
    away = bodies[at, a, :3] + offset * bodies[at, a, 3:] - there
    spread = blocks[a, :, a, :]
    cross = blocks[a, :, b, :]
    both = spread + blocks[b, :, b, :] - cross - cross.transpose(0, 2, 1)
    spread = np.where(paired[:, None, None], both, spread)
    o = offset[:, :, None]
    spread = spread[:, :3, :3] + o * (spread[:, 3:, :3] + spread[:, :3, 3:]) + o * o * spread[:, 3:, 3:]
    missed[ranges] = _second_moment(away, spread, eps)
    return missed


def _second_moment(away: Matrix, spread: Matrix, eps: float) -> Vector:
    """1/2 tr(TDTD) + 1/4 tr(TD)^2 for vectors ``(m, 3)`` and covariances ``(m, 3, 3)``."""
    distance = np.sqrt(np.sum(away * away, axis=-1) + eps * eps)
    unit = away / distance[:, None]
    curvature = (np.eye(3) - unit[:, :, None] * unit[:, None, :]) / distance[:, None, None]
    bent = curvature @ spread
    squares = np.einsum("mij,mji->m", bent, bent)
    trace = np.einsum("mii->m", bent)
    return np.asarray(0.5 * squares + 0.25 * trace * trace, np.float64)
