"""Where each body of the fleet lives in the state vector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

STATES_PER_AGENT = 6
"""Position and velocity, ``[pN pE pD vN vE vD]`` in NED metres and metres per second."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Order of the agents in the fleet state.

    Attributes
    ----------
    agents : tuple of int
        Agent ids (1..999) in the order of their blocks. The block of ``agents[s]`` is the *slot* ``s``;
        everything below the estimator interface speaks of slots.
    """

    agents: tuple[int, ...]

    def __post_init__(self) -> None:
        if len(set(self.agents)) != len(self.agents):
            raise ValueError(f"layout: agent ids must be distinct, found {self.agents}")
        if not self.agents:
            raise ValueError("layout: a fleet needs at least one agent")

    @property
    def size(self) -> int:
        """Number of agents n."""
        return len(self.agents)

    @property
    def dimension(self) -> int:
        """Length of the fleet state, 6n."""
        return STATES_PER_AGENT * len(self.agents)

    def slot(self, agent_id: int) -> int:
        """Slot of an agent id; raises ``KeyError`` naming the id if it is not in the fleet."""
        try:
            return self.agents.index(agent_id)
        except ValueError:
            raise KeyError(f"agent {agent_id} is not in the fleet {self.agents}") from None


def block(slot: int) -> slice:
    """The six states of one agent."""
    return slice(STATES_PER_AGENT * slot, STATES_PER_AGENT * (slot + 1))


def position(slot: int) -> slice:
    """The position of one agent, NED m."""
    return slice(STATES_PER_AGENT * slot, STATES_PER_AGENT * slot + 3)


def velocity(slot: int) -> slice:
    """The velocity of one agent, NED m/s."""
    return slice(STATES_PER_AGENT * slot + 3, STATES_PER_AGENT * (slot + 1))


def states_of(slots: Sequence[int]) -> NDArray[np.int64]:
    """Indices ``(6 len(slots),)`` of the states of some slots, in their order."""
    firsts = STATES_PER_AGENT * np.asarray(slots, np.int64)
    return np.asarray((firsts[:, None] + np.arange(STATES_PER_AGENT)).ravel(), np.int64)
