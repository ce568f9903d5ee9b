"""What the core knows of its neighbours' packets: who is heard, up to which tick, and what to wait for."""

from __future__ import annotations

import math
from dataclasses import dataclass

from agent.config_tables import FleetConfig


@dataclass(slots=True)
class _Neighbour:
    heard_s: float = -math.inf
    informed_s: float = -math.inf
    measured_tick: int = -1


class NeighbourTable:
    """The configured neighbours of an agent; times are fleet time."""

    def __init__(self, config: FleetConfig, agent_id: int) -> None:
        self._timeout_s = config.transport.neighbour_timeout_s
        self._table = {other: _Neighbour() for other in config.neighbours(agent_id)}

    def __contains__(self, agent_id: int) -> bool:
        return agent_id in self._table

    def on_packet(self, agent_id: int, now_s: float) -> None:
        """Something came from a neighbour."""
        self._table[agent_id].heard_s = now_s

    def on_measurements(self, agent_id: int, tick: int) -> None:
        """A neighbour's measurements up to a tick came."""
        neighbour = self._table[agent_id]
        neighbour.measured_tick = max(neighbour.measured_tick, tick)

    def on_information(self, agent_id: int, now_s: float) -> None:
        """A neighbour takes part in the rounds."""
        self._table[agent_id].informed_s = now_s

    def on_gone(self, agent_id: int) -> None:
        """A neighbour has left; what it has sent stands."""
        self._table[agent_id] = _Neighbour(measured_tick=self._table[agent_id].measured_tick)

    def all_measured(self, tick: int, now_s: float) -> bool:
        """Whether every neighbour that is heard has sent its measurements of a tick."""
        return all(n.measured_tick >= tick for n in self._table.values() if self._is_recent(n.heard_s, now_s))

    def informing(self, now_s: float) -> frozenset[int]:
        """Neighbours whose information a round waits for."""
        return frozenset(a for a, n in self._table.items() if self._is_recent(n.informed_s, now_s))

    def silent(self, now_s: float) -> tuple[int, ...]:
        """Neighbours that have not been heard lately."""
        return tuple(a for a, n in self._table.items() if not self._is_recent(n.heard_s, now_s))

    def ages_s(self, now_s: float) -> dict[int, float]:
        """Time since each neighbour was heard, those never heard left out."""
        return {a: now_s - n.heard_s for a, n in self._table.items() if n.heard_s > -math.inf}

    def _is_recent(self, when_s: float, now_s: float) -> bool:
        return now_s - when_s <= self._timeout_s
