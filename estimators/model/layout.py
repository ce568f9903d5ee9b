"""Where each body of the fleet lives in the state vector."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

STATES_PER_AGENT = 6
"""Position and velocity, ``[pN pE pD vN vE vD]`` in NED metres and metres per second."""


class BodyKind(IntEnum):
    """What a body of the state is; each has one block, whatever its kind."""

    VEHICLE = 0
    """Flies with an agent of its own, which tells its acceleration."""
    TARGET = 1
    """Is no part of the fleet and moves: nothing is told of its motion, and it measures nothing."""
    ANCHOR = 2
    """The same, and stands still."""


Kinds = Mapping[int, BodyKind]
"""What bodies are, by id; who is not in it is a vehicle."""
ALL_VEHICLES: Kinds = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Layout:
    """Order of the bodies in the fleet state.

    Attributes
    ----------
    agents : tuple of int
        Ids (1..999) of the bodies in the order of their blocks. The block of ``agents[s]`` is the *slot* ``s``;
        everything below the estimator interface speaks of slots.
    kinds : tuple of BodyKind
        What they are, in the same order; empty: all are vehicles.
    """

    agents: tuple[int, ...]
    kinds: tuple[BodyKind, ...] = ()

    def __post_init__(self) -> None:
        if not self.kinds:
            object.__setattr__(self, "kinds", (BodyKind.VEHICLE,) * len(self.agents))
        if len(self.kinds) != len(self.agents):
            raise ValueError(f"layout: {len(self.kinds)} kinds for {len(self.agents)} bodies")
        if len(set(self.agents)) != len(self.agents):
            raise ValueError(f"layout: agent ids must be distinct, found {self.agents}")
        if not self.agents:
            raise ValueError("layout: a fleet needs at least one agent")

    @classmethod
    def of(cls, agents: Sequence[int], kinds: Kinds = ALL_VEHICLES) -> Layout:
        """That of bodies in an order, of which those in ``kinds`` are no vehicles."""
        return cls(tuple(agents), tuple(kinds.get(agent, BodyKind.VEHICLE) for agent in agents))

    @property
    def size(self) -> int:
        """Number of bodies n."""
        return len(self.agents)

    @property
    def dimension(self) -> int:
        """Length of the fleet state, 6n."""
        return STATES_PER_AGENT * len(self.agents)

    @property
    def target_slots(self) -> tuple[int, ...]:
        """Slots of the bodies that are no vehicles, ascending."""
        return tuple(slot for slot, kind in enumerate(self.kinds) if kind is not BodyKind.VEHICLE)

    @property
    def is_vehicle(self) -> NDArray[np.bool_]:
        """``(n,)`` which are vehicles."""
        return np.array([kind is BodyKind.VEHICLE for kind in self.kinds])

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
