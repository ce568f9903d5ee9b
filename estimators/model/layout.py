"""Where each body of the fleet lives in the state vector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

STATES_PER_AGENT = 6
"""Position and velocity, ``[pN pE pD vN vE vD]`` in NED metres and metres per second."""


class BodyKind(IntEnum):
    """What a body of the state is; each has one block, whatever its kind."""

    VEHICLE = 0
    """Flies with an agent of its own, which measures its acceleration."""
    TARGET = 1
    """Is no part of the fleet: nothing is told of its motion, and it measures nothing."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Order of the bodies in the fleet state.

    Attributes
    ----------
    agents : tuple of int
        Ids (1..999) of the bodies in the order of their blocks. The block of ``agents[s]`` is the *slot* ``s``;
        everything below the estimator interface speaks of slots.
    targets : frozenset of int
        Ids of those that are targets; all others are vehicles.
    """

    agents: tuple[int, ...]
    targets: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        if not self.targets <= set(self.agents):
            raise ValueError(f"layout: targets {sorted(self.targets)} are not all among {self.agents}")
        if len(set(self.agents)) != len(self.agents):
            raise ValueError(f"layout: agent ids must be distinct, found {self.agents}")
        if not self.agents:
            raise ValueError("layout: a fleet needs at least one agent")

    @property
    def size(self) -> int:
        """Number of bodies n."""
        return len(self.agents)

    @property
    def dimension(self) -> int:
        """Length of the fleet state, 6n."""
        return STATES_PER_AGENT * len(self.agents)

    def kind(self, slot: int) -> BodyKind:
        """What the body of a slot is."""
        return BodyKind.TARGET if self.agents[slot] in self.targets else BodyKind.VEHICLE

    @property
    def target_slots(self) -> tuple[int, ...]:
        """Slots of the targets, ascending."""
        return tuple(slot for slot, agent in enumerate(self.agents) if agent in self.targets)

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
