"""Who is how many hops away, and what that means for records."""

from __future__ import annotations

import math
from collections.abc import Set as AbstractSet

from agent.config.tables import FleetConfig
from transport.messages.measurement_body import AccelerationMeasurement, Measurement, RangeMeasurement

NEAR_HOPS = 2
"""In a fleet that is larger than a joint state, records of nobody farther are used, or relayed to here."""
RELAYS_TIMES = 1
"""So often a record of somebody else is relayed in such a fleet: most come by several neighbours, and a packet holds
little more than one tick's of them."""
MOST_ROUNDS = 1
"""Consensus rounds of a tick in such a fleet, at most: a second one changed no error, with loss or without."""
LINK_MEMORY_S = 5.0
"""A link of which nothing was heard or measured for longer is none."""


def is_limited(config: FleetConfig) -> bool:
    """Whether the fleet is larger than a drone's joint state may be."""
    return len(config.ids) > config.fleet.joint_bodies


def rounds_of(config: FleetConfig) -> int:
    """Consensus rounds of a tick."""
    rounds = config.estimator.rounds
    return min(rounds, MOST_ROUNDS) if is_limited(config) else rounds


class Neighbourhood:
    """The hops to each agent, and the links that are seen: who was heard directly, who ranged whom.

    With configured edges the hops are those of the graph. Without, neighbours are who is heard: one hop for a drone
    that was heard directly of late, two for all others (a record does not say how far it came). Where the fleet is
    larger than a joint state (`is_limited`) two are only those who ranged somebody heard directly, or were ranged by
    them; so records go no farther than `NEAR_HOPS`, however large the fleet is.
    """

    def __init__(self, config: FleetConfig, agent_id: int) -> None:
        settings, size = config.estimator, len(config.ids)
        self.relays_times = RELAYS_TIMES if is_limited(config) else None
        """How many packets carry a relayed record; ``None``: as many as it takes until all neighbours have it."""
        self._limited = is_limited(config)
        reach = NEAR_HOPS if self._limited else size
        self._rows_from, self._rows_to = min(1 + settings.relay_hops, reach), min(settings.relay_hops, reach - 1)
        """Hops from which rows are used, and from which they are sent on; the same of inputs."""
        self._inputs_from = {"none": 0, "neighbours": 1, "fleet": reach}[settings.share_inputs]
        self._inputs_to = {"none": -1, "neighbours": 0, "fleet": reach - self._limited}[settings.share_inputs]
        self._recent_ticks = math.ceil(config.transport.neighbour_timeout_s / config.fleet.period_s)
        self._memory_ticks = math.ceil(LINK_MEMORY_S / config.fleet.period_s)
        self._heard: dict[int, int] = {}
        self._ranged: dict[int, dict[int, int]] = {}
        """Tick of the last range between two, by either end."""
        self._second: tuple[int, AbstractSet[int]] = (-1, frozenset())
        """Whom those who are heard directly were linked to, and as of which tick."""
        self._tick = 0
        self._by_reach = config.fleet.edges is None
        self._agent_id = agent_id
        self._graph = _hops_along_edges(config, agent_id)

    def hear(self, agent_id: int, tick: int) -> None:
        """A packet came directly from an agent."""
        self._heard[agent_id] = tick
        self._tick = max(self._tick, tick)

    def note(self, record: Measurement) -> None:
        """A record was taken in: a range is a link between its ends."""
        if self._limited and isinstance(record, RangeMeasurement):
            for one, other in ((record.observer, record.other), (record.other, record.observer)):
                known = self._ranged.setdefault(one, {})
                known[other] = max(record.tick, known.get(other, record.tick))

    def hops(self, agent_id: int) -> int | None:
        """Hops to an agent; ``None`` if no edges lead there."""
        if not self._by_reach or agent_id == self._agent_id:
            return self._graph.get(agent_id)
        heard = self._heard.get(agent_id)
        if heard is not None and self._tick - heard <= self._recent_ticks:
            return 1
        return 2 if not self._limited or agent_id in self._second_hop() else 3

    def is_direct(self, agent_id: int) -> bool:
        """Whether an agent is this one or a direct neighbour."""
        hops = self.hops(agent_id)
        return hops is not None and hops <= 1

    def linked(self, agent_id: int, tick: int) -> set[int]:
        """Who had a link to an agent of late; not the agent itself. Only where the fleet `is_limited`."""
        oldest = tick - self._memory_ticks
        found = {other for other, when in self._ranged.get(agent_id, {}).items() if when >= oldest}
        if agent_id == self._agent_id:
            found |= {other for other, when in self._heard.items() if when >= oldest}
        elif self._heard.get(agent_id, -1) >= oldest:
            found.add(self._agent_id)
        return found - {agent_id}

    def uses(self, record: Measurement) -> bool:
        """Whether this agent's estimator takes the record."""
        hops = self.hops(record.observer)
        limit = self._inputs_from if isinstance(record, AccelerationMeasurement) else self._rows_from
        return hops is not None and hops <= limit

    def sends(self, record: Measurement) -> bool:
        """Whether this agent tells its neighbours: its own records, and others' that are relayed so far.

        Where the fleet `is_limited`, a range between others only if both ends are direct neighbours: then a
        neighbour's joint state may hold both.
        """
        if self._limited and isinstance(record, RangeMeasurement) and record.observer != self._agent_id:
            return self._rows_to > 0 and self.is_direct(record.observer) and self.is_direct(record.other)
        hops = self.hops(record.observer)
        limit = self._inputs_to if isinstance(record, AccelerationMeasurement) else self._rows_to
        return hops is not None and hops <= limit

    def _second_hop(self) -> AbstractSet[int]:
        """Whom those who are heard directly were linked to, worked out once a tick."""
        if self._second[0] != self._tick:
            near = self.linked(self._agent_id, self._tick)
            self._second = self._tick, frozenset().union(*(self.linked(one, self._tick) for one in near))
        return self._second[1]


def _hops_along_edges(config: FleetConfig, agent_id: int) -> dict[int, int]:
    """Hops along the configured edges to each agent that can be reached."""
    graph, frontier, distance = {agent_id: 0}, [agent_id], 0
    while frontier:
        distance += 1
        reached = dict.fromkeys(n for one in frontier for n in config.neighbours(one))
        frontier = [n for n in reached if n not in graph]
        graph |= dict.fromkeys(frontier, distance)
    return graph
