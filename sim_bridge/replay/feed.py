"""What the agents of a replay hear, in order of arrival, and what becomes of all else that was recorded.

Logs, files of truth and files of ranges are merged here, ranges are made of the truth here, fixes are left out and
faults injected here, and what estimates will be compared with goes to disk from here. Nothing of it depends on the
agents: a process beside theirs may do it (`sim_bridge.replay.reading`).
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import Any, Protocol

from agent.sensing.samples import (
    AttitudeSample,
    AutopilotEstimate,
    BaroSample,
    FlowSample,
    GpsSample,
    GroundSample,
    ImuSample,
    VelocitySample,
)
from sim_bridge.replay.injection import Injection
from sim_bridge.replay.logs.events import LogCounts, LogSample, LogSource, TruthSample
from sim_bridge.replay.plan import PlannedVehicle, ReplayPlan
from sim_bridge.replay.side_files.range_files import RangeCounts, RangeLine
from sim_bridge.replay.synthesis import Synthesiser
from sim_bridge.replay.what_if import GpsDrops

Heard = (
    ImuSample | AttitudeSample | GpsSample | BaroSample | GroundSample | VelocitySample | FlowSample | RangeLine
)
"""What agents get, stamped in fleet time."""
Arrival = tuple[float, int, Heard | None]
"""Fleet time of arrival, agent, and what arrived; ``None``: nothing for an agent, but that late it is."""
MARK_S = 0.5
"""How long agents may go without an arrival while there are others."""


class References(Protocol):
    """Takes what estimates may be compared with."""

    def on_reference(
        self, agent_id: int, sample: TruthSample | AutopilotEstimate | GpsSample, arrival_s: float
    ) -> None:
        """One of them; all times are fleet time."""

    def close(self) -> None:
        """There are no more; may be called again."""


@dataclass(frozen=True, slots=True)
class Inputs:
    """What a replay runs on.

    ``truth`` are files' samples in fleet time by agent, in place of what the logs hold (``None``: the logs').
    ``ranges`` is a stream in fleet time, or what makes them of the truth, or ``None``. From ``from_s`` to ``to_s`` in
    fleet time. ``at_stamps``: samples arrive as over a fast link on board, not when the log's recorder had them.
    ``range_counts`` and ``truth_skipped`` are where the streams from files count, while they are read.
    """

    plan: ReplayPlan
    drops: GpsDrops
    from_s: float
    to_s: float
    truth: Mapping[int, Iterable[TruthSample]] | None = None
    ranges: Iterable[RangeLine] | Synthesiser | None = None
    at_stamps: bool = False
    range_counts: RangeCounts = field(default_factory=RangeCounts)
    truth_skipped: Mapping[int, Counter[str]] = field(default_factory=dict)
    injection: Injection = field(default_factory=Injection)

    @property
    def synthesiser(self) -> Synthesiser | None:
        """What makes ranges of the truth, if they are made."""
        return self.ranges if isinstance(self.ranges, Synthesiser) else None


@dataclass(frozen=True, slots=True)
class Tallies:
    """All that was counted on the way: of each vehicle's log, of the files, of made ranges, of dropped fixes."""

    logs: Sequence[LogCounts]
    ranges: RangeCounts
    truth_skipped: Mapping[int, Counter[str]]
    made: Counter[str]
    dropped: Counter[int]


class Feed:
    """One pass over everything that was recorded."""

    def __init__(self, inputs: Inputs, references: References) -> None:
        self.inputs = inputs
        self.references = references
        self.dropped: Counter[int] = Counter()
        """Fixes left out on request, by agent."""

    def arrivals(self) -> Generator[Arrival, None, None]:
        """What agents hear, in order of arrival; raises `LogError`, `ReplayError` or `OSError`."""
        inputs, marked_s, last_s = self.inputs, -math.inf, -math.inf
        try:
            with closing(self._merged()) as merged:
                for now_s, agent_id, content in merged:
                    if now_s > inputs.to_s:
                        break
                    if now_s < inputs.from_s:
                        continue
                    last_s = now_s
                    for heard in self._heard(now_s, agent_id, content):
                        marked_s = now_s
                        yield now_s, agent_id, heard
                    if now_s > marked_s + MARK_S:
                        marked_s = now_s
                        yield now_s, agent_id, None
            if last_s > marked_s:
                yield last_s, 0, None
        finally:
            self.references.close()

    def tallies(self) -> Tallies:
        """What was counted so far."""
        inputs, maker = self.inputs, self.inputs.synthesiser
        logs = [vehicle.source.counts for vehicle in inputs.plan.vehicles]
        made = Counter[str]() if maker is None else maker.made
        return Tallies(logs, inputs.range_counts, inputs.truth_skipped, made, self.dropped)

    def absorb(self, tallies: Tallies) -> None:
        """What a copy of this counted in another process becomes what this has counted."""
        inputs, maker = self.inputs, self.inputs.synthesiser
        for vehicle, counts in zip(inputs.plan.vehicles, tallies.logs, strict=True):
            vehicle.source.counts = counts
        inputs.range_counts.become(tallies.ranges)
        for agent_id, skipped in inputs.truth_skipped.items():
            skipped.clear()
            skipped.update(tallies.truth_skipped[agent_id])
        if maker is not None:
            maker.made = tallies.made
        self.dropped = tallies.dropped

    def _heard(self, now_s: float, agent_id: int, content: LogSample | RangeLine) -> Iterable[Heard]:
        """What agents hear of one thing that was recorded."""
        injection = self.inputs.injection
        if isinstance(content, TruthSample):
            self.references.on_reference(agent_id, content, now_s)
            maker = self.inputs.synthesiser
            return () if maker is None else map(injection.range, maker.on_truth(agent_id, content))
        if isinstance(content, AutopilotEstimate):
            self.references.on_reference(agent_id, content, now_s)
            return ()
        if isinstance(content, GpsSample):
            fix = injection.fix(agent_id, content)
            self.references.on_reference(agent_id, fix or content, now_s)
            if fix is None or self.inputs.drops.holds(agent_id, content.t_s):
                self.dropped[agent_id] += 1
                return ()
            return (fix,)
        if isinstance(content, ImuSample):
            return (injection.acceleration(agent_id, content),)
        return (injection.range(content) if isinstance(content, RangeLine) else content,)

    def _merged(self) -> Generator[tuple[float, int, Any], None, None]:
        """Everything in order of arrival."""
        truth, ranges = self.inputs.truth, self.inputs.ranges
        with closing(log_arrivals(self.inputs.plan.vehicles, with_truth=truth is None)) as logs:
            streams: list[Iterator[tuple[float, int, Any]]] = [logs]
            if truth is not None:
                streams += [_of_truth(agent_id, samples) for agent_id, samples in truth.items()]
            if ranges is not None and not isinstance(ranges, Synthesiser):
                streams.append((line.time_s, line.observer, line) for line in ranges)
            yield from heapq.merge(*streams, key=itemgetter(0))


def log_arrivals(
    vehicles: Sequence[PlannedVehicle], *, with_truth: bool
) -> Generator[tuple[float, int, LogSample], None, None]:
    """Fleet time of arrival, agent and sample of all vehicles in order of arrival.

    Without ``with_truth`` those of the truth are left out. Raises `LogError`.
    """
    by_source: dict[int, list[PlannedVehicle]] = {}
    for vehicle in vehicles:
        by_source.setdefault(id(vehicle.source), []).append(vehicle)
    streams = [_of_log(of_source[0].source, of_source, with_truth) for of_source in by_source.values()]
    try:
        yield from heapq.merge(*streams, key=itemgetter(0))
    finally:
        for stream in streams:
            stream.close()


def _of_truth(agent_id: int, samples: Iterable[TruthSample]) -> Iterator[tuple[float, int, TruthSample]]:
    for sample in samples:
        yield sample.t_s, agent_id, sample


def _of_log(
    source: LogSource, vehicles: list[PlannedVehicle], with_truth: bool
) -> Generator[tuple[float, int, LogSample], None, None]:
    of_system = {vehicle.survey.system_id: vehicle for vehicle in vehicles}
    for event in source.events():
        vehicle = of_system.get(event.system_id)
        if vehicle is None or (not with_truth and isinstance(event.sample, TruthSample)):
            continue
        shift_s = vehicle.shift_s
        yield event.arrival_s + shift_s, vehicle.agent_id, _shifted(event.sample, shift_s)


def _shifted(sample: LogSample, shift_s: float) -> LogSample:
    """A sample on fleet time; the frequent kinds are made directly, as `replace` is slow."""
    if isinstance(sample, ImuSample):
        return ImuSample(sample.t_s + shift_s, sample.specific_force_mps2, sample.gyro_radps)
    if isinstance(sample, AttitudeSample):
        return AttitudeSample(sample.t_s + shift_s, sample.quaternion, sample.aided, sample.receiver_frozen)
    if isinstance(sample, BaroSample):
        return BaroSample(sample.t_s + shift_s, sample.altitude_m)
    return replace(sample, t_s=sample.t_s + shift_s)
