"""The fleet's agents on recorded flights, in the time of the logs and as fast as the processor can.

What they hear comes in order of arrival (`sim_bridge.replay.feed`), a little ahead of the agents, so that ranges made
of the truth come when a UWB module would have brought them. Memory does not grow with the logs, no clock is read, and
one input gives one result, bit by bit.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

from agent.config.tables import FleetConfig
from agent.core import EstimatorFactory
from agent.onboard import OnboardAgent
from agent.sensing.samples import Sample
from sim_bridge.faults.member_faults import corrupt
from sim_bridge.replay.feed import Arrival, Feed, Heard
from sim_bridge.replay.side_files.range_files import RangeLine
from sim_bridge.virtual.event_queue import EventQueue
from sim_bridge.virtual.virtual_fleet import OnEstimate, VirtualDrone, VirtualFleet, channel_of
from transport.messages.uwb_body import UwbFrame, UwbRange
from transport.security.auth import Identity

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


@dataclass(slots=True)
class ReplayCounts:
    """How it went: counters by agent and name as a daemon reports them, and what the replay itself left out."""

    agents: dict[int, dict[str, int]] = field(default_factory=dict)
    ranges: Counter[str] = field(default_factory=Counter)
    leaps: int = 0
    """Silences that were left out."""
    left_out_s: float = 0.0
    """How long they were together."""
    last_s: float = 0.0
    """Fleet time of the last event."""


class Replay:
    """One replay; `run` does it."""

    def __init__(
        self,
        config: FleetConfig,
        feed: Feed,
        make_estimator: EstimatorFactory,
        on_estimate: OnEstimate,
        on_range: Callable[[RangeLine], None] = lambda _line: None,
    ) -> None:
        """``on_estimate`` gets every estimate, ``on_range`` every range that an agent gets."""
        self._feed = feed
        self._on_measured = on_range
        self._anchors = config.places_m
        self._inputs = inputs = feed.inputs
        self._queue = EventQueue(inputs.from_s)
        agents = [vehicle.agent_id for vehicle in inputs.plan.vehicles]
        epoch_s = config.fleet.epoch_unix_s
        self.drones = {
            agent_id: VirtualDrone(
                OnboardAgent(
                    config, agent_id, make_estimator, Identity(), unix_s=epoch_s, host_s=0.0, linked=False
                ),
                channel_of(config, agent_id),
            )
            for agent_id in agents
        }
        """By agent; for what is to be known of them after the run. Their monotonic clock is fleet time."""
        injection = inputs.injection
        for drone in self.drones.values():
            corrupt(drone.agent, config, Identity(), injection.faults, epoch_s + injection.start_s)
        self._fleet = VirtualFleet(config, self._queue, on_estimate, unix_offset_s=epoch_s)
        self._period_s = config.fleet.period_s
        self._ahead_s = AHEAD_OF_STAMPS_S if inputs.at_stamps else AHEAD_S
        self._left: set[int] = set()
        self._counts = ReplayCounts()
        self._sequence = 0

    def run(
        self, progress: Callable[[float], None] | None = None, arrivals: Iterable[Arrival] | None = None
    ) -> ReplayCounts:
        """Replay everything; ``progress`` is told the fleet time about once a second of it.

        ``arrivals`` are those of the feed where somebody else makes them (`sim_bridge.replay.reading`).
        """
        self._schedule_agents()
        told_s = last_s = self._inputs.from_s
        for now_s, agent_id, heard in arrivals or self._feed.arrivals():
            if now_s - last_s > MAX_SILENCE_S:
                self._leap(last_s, now_s)
            last_s = max(last_s, now_s)
            if heard is not None:
                self._take(now_s, agent_id, heard)
            self._queue.run_until(now_s - self._ahead_s)
            if progress is not None and now_s >= told_s + 1.0:
                progress(now_s)
                told_s = now_s
        self._queue.run_until(last_s + LINGER_TICKS * self._period_s)
        return self._finished(last_s)

    # --- events ---------------------------------------------------------------------------------------------

    def _schedule_agents(self) -> None:
        """Each agent runs while its log does, as far as that is replayed."""
        for vehicle in self._inputs.plan.vehicles:
            first_s = max(vehicle.first_s, self._inputs.from_s)
            last_s = vehicle.last_s + LINGER_TICKS * self._period_s
            if last_s <= first_s:
                self._left.add(vehicle.agent_id)
                continue
            self._queue.at(first_s, functools.partial(self._fleet.join, self.drones[vehicle.agent_id]))
            self._queue.at(last_s, functools.partial(self._leave, vehicle.agent_id))

    def _leave(self, agent_id: int) -> None:
        self._left.add(agent_id)
        self._fleet.leave(agent_id)

    def _leap(self, last_s: float, now_s: float) -> None:
        """Finish what the silence interrupted, then go on at its end; the cores notice by themselves."""
        self._queue.run_until(last_s + self._ahead_s)
        self._queue.leap(now_s - self._ahead_s)
        self._counts.leaps += 1
        self._counts.left_out_s += now_s - last_s - 2 * self._ahead_s

    def _take(self, now_s: float, agent_id: int, heard: Heard) -> None:
        if isinstance(heard, RangeLine):
            self._queue.at(heard.time_s + WIRE_S, functools.partial(self._on_range, heard))
            return
        arrival_s = heard.t_s + LINK_S if self._inputs.at_stamps else now_s
        self._queue.at(arrival_s, functools.partial(self._on_sample, agent_id, heard))

    def _on_sample(self, agent_id: int, sample: Sample) -> None:
        if agent_id in self._left:
            self._counts.ranges["sample after its log's end"] += 1
            return
        self.drones[agent_id].agent.on_sample(sample, self._queue.now_s)

    def _on_range(self, line: RangeLine) -> None:
        """Hand a range to its observer as its UWB module would."""
        if line.observer in self._anchors:  # it is the drone's module that measures, whoever wrote the file
            line = replace(line, observer=line.target, target=line.observer, tag=line.other_tag, other_tag=line.tag)
        drone = self.drones.get(line.observer)
        if drone is None or line.observer in self._left:
            self._counts.ranges["observer without a log"] += 1
            return
        self._sequence += 1
        measured = UwbRange(line.target, line.range_m, line.sigma_m, tag=line.tag, other_tag=line.other_tag)
        frame = UwbFrame(self._sequence, "unix", 0, (measured,), line.observer)
        now_s = self._queue.now_s
        drone.agent.on_uwb_frame(frame, now_s - line.time_s, now_s)
        self._counts.ranges["delivered"] += 1
        self._on_measured(line)

    def _finished(self, last_s: float) -> ReplayCounts:
        for agent_id, drone in self.drones.items():
            counters = drone.counters()
            if self._feed.dropped[agent_id]:
                counters["skipped gps: dropped on request"] = self._feed.dropped[agent_id]
            self._counts.agents[agent_id] = counters
        self._counts.last_s = last_s
        return self._counts
