"""Where a body is by ranges that share errors, between limits.

Ranges to one anchor share the error of its place, and all share a bias of their sensor. Places are sought with few
ranges, each with so large a variance that they can be taken for independent (`estimators.model.multilateration`);
then all ranges judge them, whitened by their joint covariance. How ranges change over time is free of what they
share: of a body that drives ahead of a fleet it says more than the ranges themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.model.measurements import Matrix, Vector
from estimators.model.multilateration import Place, RangeSet, chosen, search

SEARCHED = 48
"""Ranges with which places are sought."""
ITERATIONS = 40
CONVERGED = 1e-6
"""Gain of a step, in cost, below which all descents have arrived."""
_WEAK = 1e-8
"""Position information, 1/m2, added so that a covariance exists."""


@dataclass(frozen=True, slots=True)
class SharedErrors:
    """Errors that m ranges to k anchors share.

    ``source`` ``(m,)``: the anchor of each; ``covariance`` ``(k, 3, 3)`` of the anchors' places, m2, of errors that
    last for as long as the ranges; ``bias_variance_m2``: of what all are too long by.
    """

    source: NDArray[np.int64]
    covariance: NDArray[np.float64]
    bias_variance_m2: float


def locate_jointly(
    ranges: RangeSet, shared: SharedErrors, speed_sigma_mps: float, limits: tuple[Vector, Vector]
) -> Place | None:
    """As `estimators.model.multilateration.multilaterate`; ``ranges`` have their variances without what is shared.

    ``limits``: lowest and highest state ``(6,)``, between which places are sought. Noise puts a body that is near a
    limit beyond it half of the time; its place is at the limit then.
    """
    if not len(ranges.range_m):
        return None
    states, costs = search(_as_if_independent(ranges, shared), speed_sigma_mps)
    states = np.clip(states[np.argsort(costs)], *limits)
    apart = np.unique(np.round(states[:, :3]), axis=0, return_index=True)[1]
    problem = _Whitened(ranges, _whitener(ranges, shared, states[0]), speed_sigma_mps)
    states, costs = problem.descend(states[np.sort(apart)], limits)
    return chosen(states, costs, problem.information(states[np.argmin(costs)]), len(ranges.range_m))


def _as_if_independent(ranges: RangeSet, shared: SharedErrors) -> RangeSet:
    """`SEARCHED` of them at most, evenly over all, each with a variance that makes up for what they share."""
    kept = slice(None, None, -(-len(ranges.range_m) // SEARCHED))
    source = shared.source[kept]
    along_m2 = np.linalg.eigvalsh(shared.covariance)[:, -1] + shared.bias_variance_m2
    each_m2 = np.bincount(source, minlength=len(along_m2)) * along_m2
    return RangeSet(
        ranges.anchor_m[kept],
        ranges.lead_s[kept],
        ranges.moved_m[kept],
        ranges.range_m[kept],
        ranges.variance_m2[kept] + each_m2[source],
    )


def _whitener(ranges: RangeSet, shared: SharedErrors, state: Vector) -> Matrix:
    """``(m, m)``, from residuals to independent ones of variance one, for the directions in which a state is."""
    away = state[:3] + ranges.lead_s[:, None] * state[3:] + ranges.moved_m - ranges.anchor_m
    unit = away / np.sqrt(np.sum(away**2, axis=1) + 1e-12)[:, None]
    source = shared.source
    of_places = np.einsum("mi,mij,nj->mn", unit, shared.covariance[source], unit)
    joint = np.where(source[:, None] == source, of_places, 0.0) + shared.bias_variance_m2
    return np.asarray(np.linalg.inv(np.linalg.cholesky(joint + np.diag(ranges.variance_m2))), np.float64)


@dataclass(frozen=True, slots=True)
class _Whitened:
    """Ranges of one body, with a prior on its velocity."""

    ranges: RangeSet
    whitener: Matrix
    speed_sigma_mps: float

    def _prior(self) -> Matrix:
        return np.diag([_WEAK] * 3 + [1.0 / self.speed_sigma_mps**2] * 3)

    def _residuals(self, states: Matrix) -> tuple[Matrix, NDArray[np.float64]]:
        """Whitened residuals ``(s, m)`` of states ``(s, 6)`` and their derivatives ``(s, m, 6)``."""
        ranges = self.ranges
        there = states[:, None, :3] + ranges.lead_s[:, None] * states[:, None, 3:] + ranges.moved_m
        away = there - ranges.anchor_m
        distance = np.sqrt(np.sum(away**2, axis=2) + 1e-12)
        unit = away / distance[..., None]
        jacobian = np.concatenate((unit, ranges.lead_s[:, None] * unit), axis=2)
        return (distance - ranges.range_m) @ self.whitener.T, self.whitener @ jacobian

    def _cost(self, states: Matrix) -> Vector:
        residuals, _ = self._residuals(states)
        prior = np.sum(states[:, 3:] ** 2, axis=1) / self.speed_sigma_mps**2
        return np.asarray(np.sum(residuals**2, axis=1) + prior)

    def information(self, state: Vector) -> Matrix:
        """Of all, ``(6, 6)``, at a state."""
        _, jacobian = self._residuals(state[None])
        return np.asarray(jacobian[0].T @ jacobian[0] + self._prior())

    def descend(self, states: Matrix, limits: tuple[Vector, Vector]) -> tuple[Matrix, Vector]:
        """Levenberg-Marquardt from all starts ``(s, 6)`` at once; where they end and at which cost ``(s,)``.

        A coordinate at a limit that the cost falls beyond is held, and the others go on (projected Newton).
        """
        low, high = limits
        costs = self._cost(states)
        damping: Vector = np.full(len(states), 1e-3)
        for _ in range(ITERATIONS):
            residuals, jacobian = self._residuals(states)
            hessian = np.einsum("smi,smj->sij", jacobian, jacobian) + self._prior()
            gradient = np.einsum("smi,sm->si", jacobian, residuals)
            gradient[:, 3:] += states[:, 3:] / self.speed_sigma_mps**2
            free = ~((states <= low) & (gradient > 0.0) | (states >= high) & (gradient < 0.0))
            scale = np.einsum("sii->si", hessian)
            damped = hessian + damping[:, None, None] * scale[:, :, None] * np.eye(6)
            damped = np.where(free[:, :, None] & free[:, None, :], damped, np.eye(6))
            step = np.linalg.solve(damped, np.where(free, gradient, 0.0)[..., None])[..., 0]
            tried = np.clip(states - step, low, high)
            tried_costs = self._cost(tried)
            better = tried_costs < costs
            gain = np.where(better, costs - tried_costs, 0.0)
            states, costs = np.where(better[:, None], tried, states), np.where(better, tried_costs, costs)
            damping = np.clip(np.where(better, damping / 5.0, damping * 4.0), 1e-9, 1e9)
            if better.any() and gain.max() < CONVERGED:
                break
        return states, costs
