"""Everything that watches over one drone's position, asked once a tick. Sans-I/O.

The monitors are those of `estimators.integrity`; what only an agent can find (its autopilot's link, its clock) is
found here. `agent.watch.health` says it in words.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.latency_doubt import FixTiming, LatencyMonitor
from estimators.integrity.range_geometry import GeometryMonitor, RangeGeometry
from estimators.integrity.solution import Solution, SolutionMonitor
from estimators.integrity.staleness import Ages, StalenessMonitor

CONNECTED = "connected"
"""State of the autopilot's link that nothing is wrong with."""


@dataclass(frozen=True, slots=True)
class TickEvidence:
    """What is there to be looked at when a tick's estimate is out."""

    solution: Solution
    ages: Ages
    autopilot: str
    """State of the autopilot's link."""
    geometry: RangeGeometry | None = None
    """Of the own ranges, where they alone have to hold the position: after the start, without GPS."""
    location: tuple[Finding, ...] = ()
    """What the search for the own place by ranges found, where that is what the start waits for."""
    contradictions: tuple[Finding, ...] = ()
    """Whose fixes the estimator found to contradict the rest, by id, ``None`` for the own ones."""
    integrity: tuple[Finding, ...] = ()
    """Whose fixes are off, and what guaranteed sets contradict, about ids, ``None`` for the own drone."""
    timing: FixTiming | None = None
    """Of the latest fix; ``None`` before the first."""


class PositionWatch:
    """The monitors of one drone; ``neighbour_timeout_s`` as in the configuration."""

    def __init__(self, neighbour_timeout_s: float) -> None:
        self._solution = SolutionMonitor()
        self._geometry = GeometryMonitor()
        self._staleness = StalenessMonitor(neighbour_timeout_s)
        self._latency = LatencyMonitor()

    def observe(self, evidence: TickEvidence) -> tuple[Finding, ...]:
        """All that is found in a tick, in the order in which it is told."""
        found = list(self._solution.observe(evidence.solution))
        if evidence.geometry is not None:
            found += (*self._geometry.observe(evidence.geometry), *evidence.location)
        if evidence.autopilot != CONNECTED:
            found.append(Finding(What.AUTOPILOT, Gravity.DEGRADED, detail=evidence.autopilot))
        found += (replace(each, detail=_fixes_of(each.about)) for each in evidence.contradictions)
        found += (replace(each, detail=each.detail or _fixes_of(each.about)) for each in evidence.integrity)
        found += self._staleness.observe(evidence.ages)
        if evidence.timing is not None:
            found += self._latency.observe(evidence.timing)
        return tuple(sorted(found, key=lambda each: each.what.value))


def _fixes_of(agent_id: int | None) -> str:
    return "fixes" if agent_id is None else f"fixes of {agent_id}"


def clock_finding(fault: str | None) -> tuple[Finding, ...]:
    """What follows from a clock that is outside the fleet's time (`agent.sensing.clock.clock_fault`)."""
    return () if fault is None else (Finding(What.CLOCK, Gravity.DEGRADED, detail=fault),)
