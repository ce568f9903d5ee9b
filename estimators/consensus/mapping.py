"""Information pairs between agents that see different fleets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimators.estimator import Payload
from estimators.model.gaussian import Pair, marginal_pair
from estimators.model.layout import STATES_PER_AGENT, states_of
from estimators.model.measurements import Vector

FLAT_INFORMATION = 1e-8
"""What stands for no information (1/m2, s2/m2) where a pair must stay definite: a sigma of 10 km."""


def mapped_pair(
    pair: Pair, sender: Sequence[int], receiver: Sequence[int], flat: float = 0.0, centre: Vector | None = None
) -> Pair:
    """A pair over the agents ``sender`` (ids) as a pair over the agents ``receiver``.

    Agents that only the sender has are marginalised; those that only the receiver has get the information
    ``flat`` about ``centre`` ``(6n,)`` (zero: none at all). Raises ``numpy.linalg.LinAlgError`` where what is to be
    marginalised is singular.
    """
    common = [agent for agent in receiver if agent in sender]
    reduced, right = marginal_pair(pair, [list(sender).index(agent) for agent in common])
    dimension = STATES_PER_AGENT * len(receiver)
    information, vector = flat * np.eye(dimension), np.zeros(dimension)
    if centre is not None:
        vector = flat * centre
    at = states_of([list(receiver).index(agent) for agent in common])
    information[np.ix_(at, at)], vector[at] = reduced, right
    return information, vector


def mapped_payload(payload: Payload, sender: Sequence[int], receiver: Sequence[int], centre: Vector) -> Payload:
    """A neighbour's payload as one over the receiver's agents; unknown agents are as good as unknown."""
    information, vector = mapped_pair(
        (payload.information, payload.vector), sender, receiver, FLAT_INFORMATION, centre
    )
    return Payload(payload.tick, information, vector, payload.rank, payload.degree)
