"""A belief about a fleet's state and the slow errors of its sensors, at one tick: the arrival cost of a window."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from estimators.compiled.entries import entry
from estimators.model.gaussian import Pair, symmetrised
from estimators.model.layout import block, states_of
from estimators.model.measurements import Matrix, Vector
from estimators.model.members import InformationState, MemberChange
from estimators.systematic.slow_errors import places_before

WORTHWHILE = 1.02
"""A size that has changed by less than this factor is left what it is."""
LOOSENED = 1.1
"""A variance beyond so much of its prior's is no longer what measurements made of it: a pair has loosened it, and a
larger prior adds to it alone."""


@dataclass(frozen=True, slots=True)
class SlowBelief:
    """Mean ``(D,)`` and covariance ``(D, D)`` of ``6n`` states, NED m and m/s, followed by q slow errors."""

    mean: Vector
    covariance: Matrix
    sizes: Vector
    """``(q,)``: the priors that the slow errors have had."""

    @classmethod
    def first(cls, mean: Vector, covariance: Matrix, sizes: Vector) -> Self:
        """From a prior of the states alone."""
        states, total = len(mean), len(mean) + len(sizes)
        whole = np.zeros((total, total))
        whole[:states, :states] = covariance
        whole[range(states, total), range(states, total)] = sizes**2
        return cls(np.concatenate((mean, np.zeros(len(sizes)))), whole, sizes.copy())

    @property
    def states(self) -> int:
        """How many states there are, ``6n``."""
        return len(self.mean) - len(self.sizes)

    def kinematic(self) -> InformationState:
        """The states alone; raises ``numpy.linalg.LinAlgError`` where their covariance is singular."""
        d = self.states
        return InformationState.from_moments(self.mean[:d], self.covariance[:d, :d])

    def with_pair(self, own: Pair, pair: Pair) -> SlowBelief:
        """The belief whose states are those of ``pair`` instead of those of ``own``, its present ones.

        What the states say of the slow errors stays what it was: p(x, s) = p_pair(x) p_own(s | x). Raises
        ``numpy.linalg.LinAlgError`` where the pair's information is singular.
        """
        d = self.states
        states = symmetrised(np.linalg.inv(pair[0]))
        mean = states @ pair[1]
        slope = self.covariance[d:, :d] @ own[0]
        covariance = np.empty_like(self.covariance)
        covariance[:d, :d] = states
        covariance[d:, :d] = slope @ states
        covariance[:d, d:] = covariance[d:, :d].T
        covariance[d:, d:] = symmetrised(
            self.covariance[d:, d:] + slope @ (states - self.covariance[:d, :d]) @ slope.T
        )
        slow = self.mean[d:] + slope @ (mean - self.mean[:d])
        return replace(self, mean=np.concatenate((mean, slow)), covariance=covariance)

    def with_states(self, mean: Vector, covariance: Matrix) -> SlowBelief:
        """The belief with other states, which say nothing of the slow errors."""
        d = self.states
        fresh = SlowBelief.first(mean, covariance, self.sizes)
        fresh.mean[d:], fresh.covariance[d:, d:] = self.mean[d:], self.covariance[d:, d:]
        return fresh

    def resized(self, sizes: Vector) -> SlowBelief:
        """With priors of other sizes.

        It is as if the slow errors had had them from the start: information changes by the difference of those of the
        priors. What was taken for certain because a wander was taken for small is given back when it turns out large:
        the fixes have told the sum of place and wander.
        """
        mean, covariance, known = self.mean.copy(), self.covariance.copy(), self.sizes.copy()
        _resize(self.states, sizes, mean, covariance, known)
        return SlowBelief(mean, covariance, known)

    def reindexed(self, change: MemberChange, sizes: Vector) -> SlowBelief:
        """The belief about the fleet after a change; ``sizes``: those of its slow errors where they begin anew."""
        states = change.after.dimension
        was = np.full(states, -1, np.int64)
        was[states_of(list(change.stayed))] = states_of(list(change.stayed.values()))
        if len(sizes):
            slow = places_before(change.before.size, change.stayed, change.after.size)
            was = np.concatenate((was, np.where(slow >= 0, self.states + slow, -1)))
            sizes = np.where(slow >= 0, self.sizes[slow], sizes)
        made = SlowBelief.first(np.zeros(states), np.eye(states), sizes)
        kept = np.flatnonzero(was >= 0)
        made.mean[kept] = self.mean[was[kept]]
        made.covariance[np.ix_(kept, kept)] = self.covariance[np.ix_(was[kept], was[kept])]
        for slot, (mean, covariance) in change.fresh.items():
            made.mean[block(slot)], made.covariance[block(slot), block(slot)] = mean, covariance
        return made


@entry("void(int64, float64[::1], float64[::1], float64[:, ::1], float64[::1])")
def _resize(states: int, sizes: Vector, mean: Vector, covariance: Matrix, known: Vector) -> None:
    """mean, covariance, known <- those with ``sizes``, where these have changed by a factor that is worthwhile."""
    total = mean.shape[0]
    column = np.empty(total)
    for j in range(sizes.shape[0]):
        if known[j] / WORTHWHILE <= sizes[j] <= WORTHWHILE * known[j]:
            continue
        at, before, after = states + j, known[j] * known[j], sizes[j] * sizes[j]
        known[j] = sizes[j]
        if after > before and covariance[at, at] > LOOSENED * before:
            covariance[at, at] += after - before
            continue
        for i in range(total):
            column[i] = covariance[at, i]
        added, was = 1.0 / after - 1.0 / before, mean[at]
        factor = added / max(1.0 + added * column[at], min(before / after, 1.0))
        for i in range(total):
            mean[i] -= column[i] * factor * was
            for k in range(total):
                covariance[i, k] -= column[i] * factor * column[k]
