"""A fleet that changes: who stays, who is new, and what that makes of a belief about the fleet's state.

Removal is marginalisation: in moment form the rows and columns of an agent are dropped, in information form its
block is eliminated (Schur complement), so that the estimates of the others stay what they were. A new agent gets
an independent block with a wide prior, which says nothing of the others either.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from estimators.model.gaussian import Pair, Prior, marginal_pair, symmetrised
from estimators.model.layout import ALL_VEHICLES, Kinds, Layout, block, states_of
from estimators.model.measurements import Matrix, Vector


@dataclass(frozen=True, slots=True)
class MemberChange:
    """From one fleet to the next; every part of an estimator finds its new places by it.

    Attributes
    ----------
    before, after
        The fleets, in the order of their blocks.
    own
        This agent's slot in the new fleet.
    fresh
        By slot in the new fleet: the agents that begin with a prior, also if they were there before.
    stayed
        By slot in the new fleet: the slots in the old one of those who keep their block.
    known
        The same of all who were there before: what was told of their motion stays true of a replaced one too.
    """

    before: Layout
    after: Layout
    own: int
    fresh: Mapping[int, Prior]
    stayed: Mapping[int, int]
    known: Mapping[int, int]

    @classmethod
    def between(
        cls,
        before: Layout,
        agents: Sequence[int],
        own: int,
        fresh: Mapping[int, Prior],
        kinds: Kinds = ALL_VEHICLES,
    ) -> Self:
        """The change to the fleet ``agents`` (ids) with the agent ``own``; ``fresh`` by id, ``kinds`` of all.

        Raises ``KeyError`` for an agent that is neither in the old fleet nor fresh, and for a fresh or own one that
        is not in the new fleet.
        """
        after = Layout.of(agents, kinds)
        stayed = {slot: before.slot(agent) for slot, agent in enumerate(after.agents) if agent not in fresh}
        replaced = {after.slot(agent): before.slot(agent) for agent in fresh if agent in before.agents}
        priors = {after.slot(agent): prior for agent, prior in fresh.items()}
        return cls(before, after, after.slot(own), priors, stayed, {**stayed, **replaced})

    def mean(self, mean: Vector) -> Vector:
        """A mean ``(6n,)`` of the old fleet as one of the new: a fresh agent has that of its prior."""
        out = np.zeros(self.after.dimension)
        out[states_of(list(self.stayed))] = mean[states_of(list(self.stayed.values()))]
        for slot, (prior_mean, _) in self.fresh.items():
            out[block(slot)] = prior_mean
        return out

    def information(self, information: Matrix) -> Matrix:
        """Information ``(6n, 6n)`` on the old fleet as one on the new, a fresh agent's independent of all others.

        Raises ``numpy.linalg.LinAlgError`` where that on the agents to be removed is singular.
        """
        out = np.zeros((self.after.dimension, self.after.dimension))
        if self.stayed:
            at = states_of(list(self.stayed))
            pair = information, np.zeros(len(information))
            out[np.ix_(at, at)] = marginal_pair(pair, list(self.stayed.values()))[0]
        for slot, (_, covariance) in self.fresh.items():
            out[block(slot), block(slot)] = symmetrised(np.linalg.inv(covariance))
        return out


@dataclass(frozen=True, slots=True)
class InformationState:
    """A belief about the fleet at one tick: mean ``(6n,)``, NED m and m/s, and information ``(6n, 6n)``."""

    mean: Vector
    information: Matrix

    @classmethod
    def from_moments(cls, mean: Vector, covariance: Matrix) -> Self:
        """Raises ``numpy.linalg.LinAlgError`` where the covariance is singular."""
        return cls(np.array(mean, float), symmetrised(np.linalg.inv(covariance)))

    def pair(self) -> Pair:
        """Its information pair."""
        return self.information, self.information @ self.mean

    def covariance(self) -> Matrix:
        """``(6n, 6n)``; raises ``numpy.linalg.LinAlgError`` where the information is singular."""
        return symmetrised(np.linalg.inv(self.information))

    def reindexed(self, change: MemberChange) -> InformationState:
        """The belief about the fleet after a change."""
        return InformationState(change.mean(self.mean), change.information(self.information))
