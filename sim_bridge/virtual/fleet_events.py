"""What happens to a fleet in virtual time besides flying: drones come and go, the radio falls apart and heals."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

from sim_bridge.world.scenario import Interval
from transport.link.channel import Outage


@dataclass(frozen=True, slots=True)
class Partition:
    """No packet crosses between the drones of ``island`` and the others; seconds since the start."""

    island: frozenset[int]
    from_s: float
    to_s: float


@dataclass(frozen=True, slots=True)
class FleetEvents:
    """Of a run; times in seconds since its start.

    Attributes
    ----------
    away : tuple of Interval
        When a drone is not there: its daemon and its UWB module are off, it begins anew afterwards and remembers
        nothing. One that is away from the start joins later.
    partitions : tuple of Partition
    """

    away: tuple[Interval, ...] = ()
    partitions: tuple[Partition, ...] = ()

    def is_there(self, agent_id: int, time_s: float) -> bool:
        """Whether a drone is there."""
        return not any(each.agent == agent_id and each.holds(time_s) for each in self.away)

    def changes_s(self) -> list[float]:
        """When anybody comes or goes, ascending, the start left out."""
        times = {time_s for each in self.away for time_s in (each.from_s, each.to_s)}
        return sorted(time_s for time_s in times if time_s > 0.0)

    def outages(self, receiver: int, ids: Iterable[int], start_s: float) -> tuple[Outage, ...]:
        """What a drone cannot hear, on a clock that shows ``start_s`` at the start."""
        return tuple(
            Outage(start_s + cut.from_s, start_s + cut.to_s, _others(cut.island, receiver, ids))
            for cut in self.partitions
        )


def _others(island: Collection[int], receiver: int, ids: Iterable[int]) -> tuple[int, ...]:
    return tuple(agent for agent in ids if (agent in island) != (receiver in island))
