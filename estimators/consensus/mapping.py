"""What is exchanged between agents that see different fleets: information pairs, and windows of states."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from estimators.estimator import Payload
from estimators.model.gaussian import Pair, marginal_of_states, other_states
from estimators.model.layout import STATES_PER_AGENT, states_of
from estimators.model.measurements import Matrix, Vector

Places = NDArray[np.int64]
PAIRS_OF_FLEETS = 128
"""So many pairs of fleets are remembered: neighbours' fleets seldom change."""
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
    kept, others, at = _places(tuple(sender), tuple(receiver))
    reduced, right = marginal_of_states(pair, kept, others)
    dimension = STATES_PER_AGENT * len(receiver)
    information = flat * np.eye(dimension)
    vector: Vector = np.zeros(dimension) if centre is None else flat * centre
    information[np.ix_(at, at)], vector[at] = reduced, right
    return information, vector


@lru_cache(PAIRS_OF_FLEETS)
def _places(sender: tuple[int, ...], receiver: tuple[int, ...]) -> tuple[Places, Places, Places]:
    """Of the states that both have: their places at the sender and at the receiver, the sender's others between."""
    common = [agent for agent in receiver if agent in sender]
    kept = states_of([sender.index(agent) for agent in common])
    others = other_states(kept, STATES_PER_AGENT * len(sender))
    return kept, others, states_of([receiver.index(agent) for agent in common])


def mapped_payload(payload: Payload, sender: Sequence[int], receiver: Sequence[int], centre: Vector) -> Payload:
    """A neighbour's payload as one over the receiver's agents; unknown agents are as good as unknown."""
    information, vector = mapped_pair(
        (payload.information, payload.vector), sender, receiver, FLAT_INFORMATION, centre
    )
    return Payload(payload.tick, information, vector, payload.rank, payload.degree)


def mapped_path(path: Matrix, sender: Sequence[int], receiver: Sequence[int], own: Payload) -> Matrix:
    """States ``(S, 6n)`` of the bodies ``sender`` as those of the bodies ``receiver``, whose window is ``own``.

    Bodies that the sender has not are where the receiver has them. A window of another length, or for a receiver that
    has none, comes back as it is.
    """
    if tuple(sender) == tuple(receiver) or own.path is None or len(own.path) != len(path):
        return path
    kept, _, at = _places(tuple(sender), tuple(receiver))
    mapped = own.path.copy()
    mapped[:, at] = path[:, kept]
    return mapped
