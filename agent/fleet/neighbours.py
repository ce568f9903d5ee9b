"""What the core knows of its neighbours' packets: who is heard, up to which tick, and what to wait for."""

from __future__ import annotations

import math
from dataclasses import dataclass

from agent.config.tables import FleetConfig


@dataclass(slots=True)
class _Neighbour:
    heard_s: float = -math.inf
    informed_s: float = -math.inf
    measured: tuple[int, int] = (-1, 0)
    """Latest tick and exchange that its measurements came of."""
    left_s: float = -math.inf
    """When one that has left was heard last."""


class NeighbourTable:
    """The neighbours of an agent; times are fleet time.

    With configured edges they are the drones at their other ends, without, every drone of the fleet may be one, and
    those are who are heard.
    """

    def __init__(self, config: FleetConfig, agent_id: int) -> None:
        self._timeout_s = config.transport.neighbour_timeout_s
        self._absent_after_s = config.fleet.absent_after_s
        self._by_reach = config.fleet.edges is None
        self._table = {other: _Neighbour() for other in config.neighbours(agent_id)}

    def __contains__(self, agent_id: int) -> bool:
        return agent_id in self._table

    def on_packet(self, agent_id: int, now_s: float) -> None:
        """Something came from a neighbour."""
        self._table[agent_id].heard_s = now_s

    def on_measurements(self, agent_id: int, tick: int, exchange: int) -> None:
        """A neighbour's measurements up to a tick came, in its packet of an exchange."""
        neighbour = self._table[agent_id]
        neighbour.measured = max(neighbour.measured, (tick, exchange))

    def on_information(self, agent_id: int, now_s: float) -> None:
        """A neighbour takes part in the rounds."""
        self._table[agent_id].informed_s = now_s

    def on_gone(self, agent_id: int) -> None:
        """A neighbour has left; what it has sent stands."""
        known = self._table[agent_id]
        self._table[agent_id] = _Neighbour(measured=known.measured, left_s=max(known.heard_s, known.left_s))

    def all_measured(self, tick: int, exchange: int, now_s: float) -> bool:
        """Whether every neighbour that is heard has sent its measurements of a tick's exchange."""
        for neighbour in self._table.values():
            if neighbour.measured < (tick, exchange) and self._is_recent(neighbour.heard_s, now_s):
                return False
        return True

    def heard(self, now_s: float) -> frozenset[int]:
        """Neighbours that are heard."""
        return frozenset(a for a, n in self._table.items() if self._is_recent(n.heard_s, now_s))

    def informing(self, now_s: float) -> frozenset[int]:
        """Neighbours whose information a round waits for."""
        return frozenset(a for a, n in self._table.items() if self._is_recent(n.informed_s, now_s))

    def expected_ages_s(self, now_s: float) -> dict[int, float]:
        """Time since each who should be heard was: the ends of the edges, else who was of late; ``inf``: never."""
        return {a: now_s - n.heard_s for a, n in self._table.items() if self._is_expected(n, now_s)}

    def ages_s(self, now_s: float) -> dict[int, float]:
        """Time since each neighbour was heard, those never heard left out."""
        return {a: now_s - n.heard_s for a, n in self._table.items() if n.heard_s > -math.inf}

    def _is_expected(self, neighbour: _Neighbour, now_s: float) -> bool:
        last_s = max(neighbour.heard_s, neighbour.left_s)
        return not self._by_reach or now_s - last_s <= self._absent_after_s

    def _is_recent(self, when_s: float, now_s: float) -> bool:
        return now_s - when_s <= self._timeout_s
