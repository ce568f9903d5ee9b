"""Whom a drone's joint state holds in a fleet that is larger than `fleet.joint_bodies`: its own neighbourhood.

Itself, then who is one hop away, then who is two, as many as there is room for. Among those of one distance the best
linked come first: what ranges tell of a drone, they tell through its links.
"""

from __future__ import annotations

from agent.config.tables import FleetConfig
from agent.fleet.neighbourhood import Neighbourhood, is_limited

STAYING_LINKS = 2
"""So many links more than one who is in must a newcomer of the same distance have to take its place."""


class JointChoice:
    """Chooses tick by tick; who is in stays until it is out of reach or somebody clearly nearer comes."""

    def __init__(self, config: FleetConfig, agent_id: int) -> None:
        self._limited = is_limited(config)
        self._most = config.fleet.joint_bodies
        self._agent_id = agent_id
        self._chosen: frozenset[int] = frozenset((agent_id,))

    def choose(self, tick: int, hood: Neighbourhood) -> frozenset[int] | None:
        """Who is to be in the joint state, the own drone among them; ``None``: everybody."""
        if not self._limited:
            return None
        own = self._agent_id
        first = hood.linked(own, tick)
        links = {one: hood.linked(one, tick) for one in first}
        inner = first | {own}
        shared = dict.fromkeys(first, 1)  # the link to the own drone
        for one in first:
            for other in links[one] - {own}:
                shared[other] = shared.get(other, 0) + 1

        def rank(agent: int) -> tuple[int, int, int]:
            stays = STAYING_LINKS if agent in self._chosen else 0
            return (1 if agent in inner else 2), -(shared[agent] + stays), agent

        self._chosen = frozenset((own, *sorted(shared, key=rank)[: self._most - 1]))
        return self._chosen
