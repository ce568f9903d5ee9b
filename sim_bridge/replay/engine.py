"""The fleet's agents on recorded flights, in the time of the logs and as fast as the processor can.

Logs, truth and ranges are streams in order of arrival. They are read a little ahead of the agents, so that ranges
made of the truth come when a UWB module would have brought them. Memory does not grow with the logs, no clock is
read, and one input gives one result, bit by bit.
"""

from __future__ import annotations

import functools
import heapq
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Protocol

from agent.config_tables import FleetConfig
from agent.core import EstimatorFactory
from agent.outputs import EstimateReady
from agent.samples import AttitudeSample, AutopilotEstimate, GpsSample, ImuSample
from sim_bridge.lockstep_members import ObjectMember
from sim_bridge.logs.events import LogSample, TruthSample
from sim_bridge.replay.plan import Plan
from sim_bridge.replay.range_files import RangeLine
from sim_bridge.replay.reading import LogArrival, log_arrivals
from sim_bridge.replay.synthesis import Synthesiser
from sim_bridge.replay.what_if import GpsDrops
from sim_bridge.virtual_fleet import EventQueue, VirtualFleet
from transport.uwb_body import UwbFrame, UwbRange

AHEAD_S = 0.5
"""How far the streams are read ahead: more than a message of truth may be late."""
AHEAD_OF_STAMPS_S = 3.0
"""The same where samples are delivered at their stamps; later ones come late."""
LINK_S = 0.005
"""From the stamp of a sample to its arrival on board, where the logged arrival is that of a slower link."""
WIRE_S = 0.002
"""From the instant of a range to its arrival at the observer's agent."""
MAX_SILENCE_S = 60.0
"""When no log says anything for longer, the time between is left out: the agents begin anew after it."""
LINGER_TICKS = 2.0
"""An agent ends this much after its log, for the estimate of the last tick."""

Arrival = tuple[float, int, LogSample | RangeLine]
"""Fleet time of arrival, agent, and what arrived (stamped in fleet time)."""


class Listener(Protocol):
    """What becomes of the results as they come."""

    def on_estimate(self, agent_id: int, ready: EstimateReady) -> None:
        """The estimate of a tick."""

    def on_reference(
        self, agent_id: int, sample: TruthSample | AutopilotEstimate | GpsSample, arrival_s: float
    ) -> None:
        """What estimates may be compared with; all times are fleet time."""


@dataclass(frozen=True, slots=True)
class Inputs:
    """What a replay runs on.

    ``truth`` are files' samples in fleet time by agent, in place of what the logs hold (``None``: the logs').
    ``ranges`` is a stream in fleet time, or what makes them of the truth, or ``None``. From ``from_s`` to ``to_s`` in
    fleet time. ``at_stamps``: samples arrive as over a fast link on board, not when the log's recorder had them.
    """

    plan: Plan
    drops: GpsDrops
    from_s: float
    to_s: float
    truth: Mapping[int, Iterable[TruthSample]] | None = None
    ranges: Iterable[RangeLine] | Synthesiser | None = None
    at_stamps: bool = False


@dataclass(slots=True)
class ReplayCounts:
    """How it went: counters by agent and name as a daemon reports them, and what the replay itself left out."""

    members: dict[int, dict[str, int]] = field(default_factory=dict)
    ranges: Counter[str] = field(default_factory=Counter)
    leaps: int = 0
    """Silences that were left out."""
    last_s: float = 0.0
    """Fleet time of the last event."""


class Replay:
    """One replay; `run` does it."""

    def __init__(
        self, config: FleetConfig, inputs: Inputs, make_estimator: EstimatorFactory, listener: Listener
    ) -> None:
        self._inputs = inputs
        self._listener = listener
        self._queue = EventQueue(inputs.from_s)
        agents = [vehicle.agent_id for vehicle in inputs.plan.vehicles]
        self.members = {agent_id: ObjectMember(config, agent_id, make_estimator) for agent_id in agents}
        """By agent; for what is to be known of their cores after the run."""
        self._fleet = VirtualFleet(
            config,
            {},
            self._queue,
            listener.on_estimate,
            fleet_offset_s=0.0,
            unix_offset_s=config.fleet.epoch_unix_s,
        )
        self._period_s = config.fleet.period_s
        self._ahead_s = AHEAD_OF_STAMPS_S if inputs.at_stamps else AHEAD_S
        self._left: set[int] = set()
        self._dropped: Counter[int] = Counter()
        self._counts = ReplayCounts()
        self._sequence = 0

    def run(
        self, progress: Callable[[float], None] | None = None, logs: Iterator[LogArrival] | None = None
    ) -> ReplayCounts:
        """Replay everything; ``progress`` is told the fleet time about once a second of it.

        ``logs`` are the samples of the plan's vehicles where somebody else reads them (`sim_bridge.replay.reading`).
        """
        self._schedule_agents()
        told_s = self._inputs.from_s
        last_s = self._inputs.from_s
        for now_s, agent_id, content in self._arrivals(logs or self._read()):
            if now_s > self._inputs.to_s:
                break
            if now_s < self._inputs.from_s:
                continue
            if now_s - last_s > MAX_SILENCE_S:
                self._leap(last_s, now_s)
            last_s = max(last_s, now_s)
            self._take(now_s, agent_id, content)
            self._queue.run_until(now_s - self._ahead_s)
            if progress is not None and now_s >= told_s + 1.0:
                progress(now_s)
                told_s = now_s
        self._queue.run_until(last_s + LINGER_TICKS * self._period_s)
        return self._finished(last_s)

    # --- streams --------------------------------------------------------------------------------------------

    def _read(self) -> Iterator[LogArrival]:
        inputs = self._inputs
        return log_arrivals(inputs.plan.vehicles, to_s=inputs.to_s, with_truth=inputs.truth is None)

    def _arrivals(self, logs: Iterator[LogArrival]) -> Iterator[Arrival]:
        """Everything in order of arrival."""
        streams: list[Iterator[Arrival]] = [logs]
        truth, ranges = self._inputs.truth, self._inputs.ranges
        if truth is not None:
            streams += [_of_truth(agent_id, samples) for agent_id, samples in truth.items()]
        if ranges is not None and not isinstance(ranges, Synthesiser):
            streams.append((line.time_s + WIRE_S, line.observer, line) for line in ranges)
        return heapq.merge(*streams, key=itemgetter(0))

    # --- events ---------------------------------------------------------------------------------------------

    def _schedule_agents(self) -> None:
        """Each agent runs while its log does."""
        for vehicle in self._inputs.plan.vehicles:
            first_s = max(vehicle.first_s, self._inputs.from_s)
            member = self.members[vehicle.agent_id]
            self._queue.at(first_s, functools.partial(self._fleet.join, member))
            last_s = vehicle.last_s + LINGER_TICKS * self._period_s
            self._queue.at(last_s, functools.partial(self._leave, vehicle.agent_id))

    def _leave(self, agent_id: int) -> None:
        self._left.add(agent_id)
        self._fleet.leave(agent_id)

    def _leap(self, last_s: float, now_s: float) -> None:
        """Finish what the silence interrupted, then go on at its end; the cores notice by themselves."""
        self._queue.run_until(last_s + self._ahead_s)
        self._queue.leap(now_s - self._ahead_s)
        self._counts.leaps += 1

    def _take(self, now_s: float, agent_id: int, content: LogSample | RangeLine) -> None:
        if isinstance(content, RangeLine):
            self._queue.at(now_s, functools.partial(self._on_range, content))
            return
        if isinstance(content, TruthSample):
            self._on_truth(agent_id, content, now_s)
            return
        if isinstance(content, AutopilotEstimate):
            self._listener.on_reference(agent_id, content, now_s)
            return
        if isinstance(content, GpsSample):
            self._listener.on_reference(agent_id, content, now_s)
            if self._inputs.drops.holds(agent_id, content.t_s):
                self._dropped[agent_id] += 1
                return
        arrival_s = content.t_s + LINK_S if self._inputs.at_stamps else now_s
        self._queue.at(arrival_s, functools.partial(self._on_sample, agent_id, content))

    def _on_truth(self, agent_id: int, sample: TruthSample, now_s: float) -> None:
        self._listener.on_reference(agent_id, sample, now_s)
        if isinstance(self._inputs.ranges, Synthesiser):
            for line in self._inputs.ranges.on_truth(agent_id, sample):
                self._queue.at(line.time_s + WIRE_S, functools.partial(self._on_range, line))

    def _on_sample(self, agent_id: int, sample: ImuSample | AttitudeSample | GpsSample) -> None:
        if agent_id in self._left:
            self._counts.ranges["sample after its log's end"] += 1
            return
        self.members[agent_id].on_sample(sample, self._queue.now_s)

    def _on_range(self, line: RangeLine) -> None:
        """Hand a range to its observer as its UWB module would."""
        member = self.members.get(line.observer)
        if member is None or line.observer in self._left:
            self._counts.ranges["observer without a log"] += 1
            return
        self._sequence += 1
        measured = UwbRange(line.target, line.range_m, line.sigma_m)
        frame = UwbFrame(self._sequence, "unix", 0, (measured,), line.observer)
        now_s = self._queue.now_s
        for sample in member.uwb.samples_of(frame, now_s - line.time_s, now_s):
            member.core.on_range(sample, now_s)
        self._counts.ranges["delivered"] += 1

    def _finished(self, last_s: float) -> ReplayCounts:
        for agent_id, member in self.members.items():
            counters = member.counters()
            if self._dropped[agent_id]:
                counters["skipped gps: dropped on request"] = self._dropped[agent_id]
            self._counts.members[agent_id] = counters
        self._counts.last_s = last_s
        return self._counts


def _of_truth(agent_id: int, samples: Iterable[TruthSample]) -> Iterator[Arrival]:
    for sample in samples:
        yield sample.t_s, agent_id, sample
