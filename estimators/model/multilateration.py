"""Where a drone is that has nothing but ranges: least squares from many starts, and whether there is one answer.

The drone's own motion over the time of the ranges is known but for its velocity: with the acceleration integrated to
displacements d_k, the position at instant t_k is ``p + (t_k - t_ref) v + d_k``, p and v being those at t_ref. The
cost is the squared range residuals over their variances plus a prior on v alone. Ranges to coplanar anchors, or to
few of them, leave mirror images; they are other minima of the same cost, found by starting on all sides of the
anchors and at the mirror images of what was found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimators.model.measurements import Matrix, Vector
from estimators.model.multilateration_kernels import WEAK, descend

DISTINCT_SIGMA = 4.0
"""Two minima this many sigma apart are two places."""
RIVAL_COST = 18.0
"""A second place that explains the ranges with this much more cost or less is not ruled out (odds of 8000)."""
MAX_COST_RATIO = 9.0
"""Cost per surplus range above which no place explains the ranges."""


@dataclass(frozen=True, slots=True)
class RangeSet:
    """m ranges of one drone; positions NED m.

    ``anchor_m`` ``(m, 3)`` the other ends at the instants of the ranges, ``lead_s`` ``(m,)`` those instants relative
    to the reference (negative: before), ``moved_m`` ``(m, 3)`` the displacement by acceleration from the reference
    to there, ``range_m`` ``(m,)``, ``variance_m2`` ``(m,)`` of everything that keeps them from fitting.
    """

    anchor_m: Matrix
    lead_s: Vector
    moved_m: Matrix
    range_m: Vector
    variance_m2: Vector


@dataclass(frozen=True, slots=True)
class Place:
    """Position and velocity at the reference, ``mean`` ``(6,)`` and ``covariance`` ``(6, 6)``.

    ``rivals`` ``(k, 6)`` are other minima that the ranges do not rule out, to the centimetre.
    """

    mean: Vector
    covariance: Matrix
    cost: float
    surplus: int
    """Ranges beyond the number of unknowns."""
    rivals: Matrix

    @property
    def sigma_m(self) -> float:
        """1-sigma of the position along its worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    @property
    def fits(self) -> bool:
        """Whether the place explains the ranges."""
        return self.cost <= MAX_COST_RATIO * max(self.surplus, 3)


def multilaterate(ranges: RangeSet, speed_sigma_mps: float) -> Place | None:
    """The place of least cost with all others that cost nearly as little; ``None`` without ranges.

    ``speed_sigma_mps`` is the 1-sigma per axis of the velocity about zero. An unobservable place comes with the
    covariance that says so.
    """
    if not len(ranges.range_m):
        return None
    states, costs = search(ranges, speed_sigma_mps)
    information = _information(states[np.argmin(costs)], ranges, speed_sigma_mps)
    return chosen(states, costs, information, len(ranges.range_m))


def search(ranges: RangeSet, speed_sigma_mps: float) -> tuple[Matrix, Vector]:
    """The minima ``(s, 6)`` of the cost, some of them several times, and their costs ``(s,)``."""
    states, costs = _descend(_starts(ranges), ranges, speed_sigma_mps)
    more, more_costs = _descend(_mirrored(states, ranges.anchor_m), ranges, speed_sigma_mps)
    return np.concatenate((states, more)), np.concatenate((costs, more_costs))


def chosen(states: Matrix, costs: Vector, information: Matrix, ranges: int) -> Place:
    """The least of some minima ``(s, 6)``, where so many ``ranges`` have an ``information`` ``(6, 6)``."""
    best = int(np.argmin(costs))
    covariance = np.linalg.inv(information)
    away = states[:, :3] - states[best, :3]
    distance = np.einsum("si,ij,sj->s", away, np.linalg.inv(covariance[:3, :3]), away)
    rivals = (costs - costs[best] < RIVAL_COST) & (distance > DISTINCT_SIGMA**2)
    return Place(
        mean=states[best],
        covariance=0.5 * (covariance + covariance.T),
        cost=float(costs[best]),
        surplus=ranges - 6,
        rivals=np.unique(np.round(states[rivals], 2), axis=0),
    )


def _starts(ranges: RangeSet) -> Matrix:
    """Starts ``(s, 6)`` at rest on all sides of the anchors, at the distance of the ranges."""
    steps = np.array([-1.0, 0.0, 1.0])
    directions = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    directions = directions[np.abs(directions).sum(axis=1) % 2 == 1]  # faces and corners of a cube
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    places = ranges.anchor_m.mean(axis=0) + np.median(ranges.range_m) * directions
    return np.concatenate((places, np.zeros_like(places)), axis=1)


def _mirrored(states: Matrix, anchors: Matrix) -> Matrix:
    """States ``(s, 6)`` mirrored through the plane that fits the anchors best."""
    centre = anchors.mean(axis=0)
    normal = np.linalg.svd(anchors - centre, full_matrices=True)[2][2]
    out = states.copy()
    out[:, :3] -= 2.0 * ((states[:, :3] - centre) @ normal)[:, None] * normal
    out[:, 3:] -= 2.0 * (states[:, 3:] @ normal)[:, None] * normal
    return out


def _information(state: Vector, ranges: RangeSet, speed_sigma_mps: float) -> Matrix:
    """Of the ranges at a state, ``(6, 6)``, with that of the prior on the velocity."""
    away = state[:3] + ranges.lead_s[:, None] * state[3:] + ranges.moved_m - ranges.anchor_m
    unit = away / np.sqrt(np.sum(away**2, axis=1) + 1e-12)[:, None]
    jacobian = np.concatenate((unit, ranges.lead_s[:, None] * unit), axis=1) / np.sqrt(ranges.variance_m2)[:, None]
    prior = np.diag([WEAK] * 3 + [1.0 / speed_sigma_mps**2] * 3)
    return np.asarray(jacobian.T @ jacobian + prior)


def _descend(states: Matrix, ranges: RangeSet, speed_sigma_mps: float) -> tuple[Matrix, Vector]:
    """Where the descents from all starts ``(s, 6)`` end, and at which cost ``(s,)``."""
    reached = np.ascontiguousarray(states, dtype=float).copy()
    table = np.column_stack((ranges.lead_s, ranges.range_m, 1.0 / np.sqrt(ranges.variance_m2)))
    ends = np.ascontiguousarray(ranges.anchor_m - ranges.moved_m, dtype=float)
    return reached, descend(reached, ends, np.ascontiguousarray(table), speed_sigma_mps)
