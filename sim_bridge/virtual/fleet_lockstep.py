"""A whole fleet in virtual time: the simulated world and the agents' own cores in one process.

What the daemon does with sockets and timers happens here by a queue of events. Nothing reads a clock, so that
one configuration gives one result, bit by bit, as fast as the processor can. Two fidelities share everything
else:

- ``"values"``: samples and packets change hands as objects; for studies, twice as fast.
- ``"bytes"``: the fake autopilots' MAVLink bytes go through the agent's session, with its handshakes and
  clock synchronisation, and packets are sealed and opened as on the radio (unsigned).
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from agent.config.tables import FleetConfig
from agent.core import EstimatorFactory
from sim_bridge.virtual.fleet_events import FleetEvents
from sim_bridge.virtual.lockstep_members import ByteMember, ValueMember
from sim_bridge.virtual.virtual_fleet import EventQueue, OnEstimate, VirtualFleet
from sim_bridge.world.scenario_config import scenario_from_config
from sim_bridge.world.sensor_feed import Sensed, SensorFeed
from sim_bridge.world.sensors import RangeSet
from sim_bridge.world.simulation import STEP_TOLERANCE_S, Simulation
from sim_bridge.world.truth import Truth
from sim_bridge.world.uwb_frames import UwbDrivers

HOST_START_S = 1000.0
"""The virtual monotonic clock at the start."""
START_FLEET_S = 10_000.0
"""Fleet time about the start; it begins on a tick."""
WIRE_S = 0.001
"""How long a datagram takes between an autopilot or UWB module and its daemon."""
SERVICE_S = 0.05
"""How often an agent looks what is due on its autopilot's link; the daemon's own period."""
HOUSEKEEPING_S = 1.0
LAST_TICKS = 1.0
"""The agents get one period more than the world, for the estimate of its last tick."""

Fidelity = Literal["values", "bytes"]


@dataclass(frozen=True, slots=True)
class LockstepReport:
    """How a run went; ``counters`` by agent and name as a daemon reports them."""

    duration_s: float
    start_unix_s: float
    truth: Truth
    counters: dict[int, dict[str, int]]


class FleetLockstep:
    """One run; ``on_estimate`` gets every estimate in the order in which they are made.

    The configuration's ``[sim]`` is flown, loss and delay are those of ``[transport]``; packets are not signed,
    whatever ``[security]`` says. Raises `ScenarioError` for what the simulator cannot do.
    """

    def __init__(
        self,
        config: FleetConfig,
        make_estimator: EstimatorFactory,
        on_estimate: OnEstimate,
        fidelity: Fidelity = "values",
        events: FleetEvents | None = None,
    ) -> None:
        self._config = config
        self._make_estimator = make_estimator
        self._happenings = events or FleetEvents()
        period_s = config.fleet.period_s
        fleet_start_s = math.ceil(START_FLEET_S / period_s) * period_s
        self._fleet_offset_s = fleet_start_s - HOST_START_S
        self._unix_offset_s = self._fleet_offset_s + config.fleet.epoch_unix_s
        self._simulation = Simulation(scenario_from_config(config), HOST_START_S, self._unix_offset_s)
        self._feed: SensorFeed | None = None
        self._fleet_start_s = fleet_start_s
        if fidelity == "values":
            rates_hz = config.mavlink.imu_hz, config.mavlink.attitude_hz
            self._feed = SensorFeed(self._simulation, *rates_hz, fleet_start_s)
        self._lives: Counter[int] = Counter()
        present = [i for i in config.ids if self._happenings.is_there(i, 0.0)]
        self._members = {i: self._member(i) for i in present}
        self._counters: dict[int, dict[str, int]] = {}
        self._drivers = UwbDrivers()
        self._queue = EventQueue(HOST_START_S)
        self._fleet = VirtualFleet(
            config,
            self._members,
            self._queue,
            on_estimate,
            fleet_offset_s=self._fleet_offset_s,
            unix_offset_s=self._unix_offset_s,
        )
        self._end_s = HOST_START_S

    def _member(self, agent_id: int) -> ValueMember | ByteMember:
        """An agent that begins; ``away`` ones begin anew when they come back."""
        member: ValueMember | ByteMember
        if self._feed is not None:
            member = ValueMember(self._config, agent_id, self._make_estimator, self._fleet_start_s)
        else:
            self._lives[agent_id] += 1
            boot = self._lives[agent_id]
            member = ByteMember(self._config, agent_id, self._make_estimator, self._fleet_offset_s, boot)
        member.set_outages(self._happenings.outages(agent_id, self._config.ids, HOST_START_S), HOST_START_S)
        return member

    def _come_and_go(self) -> None:
        for agent_id in self._config.ids:
            is_there = self._happenings.is_there(agent_id, self._queue.now_s - HOST_START_S)
            if is_there and agent_id not in self._members:
                member = self._members[agent_id] = self._member(agent_id)
                self._fleet.join(member)
                if isinstance(member, ByteMember):
                    self._serve(member)
            elif not is_there and agent_id in self._members:
                self._counters[agent_id] = self._members.pop(agent_id).counters()
                self._fleet.leave(agent_id)

    def run(self, duration_s: float, progress: Callable[[float], None] | None = None) -> LockstepReport:
        """Fly for a time; ``progress`` is told the simulated time about once a second of it."""
        self._end_s = HOST_START_S + duration_s
        for member in self._members.values():
            self._fleet.advance(member)
            if isinstance(member, ByteMember):
                self._serve(member)
        self._queue.at(self._simulation.next_step_s(), self._step)
        self._queue.at(HOST_START_S + HOUSEKEEPING_S, lambda: self._keep_house(progress))
        for time_s in self._happenings.changes_s():
            self._queue.at(HOST_START_S + time_s, self._come_and_go)
        last_s = self._end_s + LAST_TICKS * self._config.fleet.period_s
        self._queue.run_until(last_s)
        return LockstepReport(
            duration_s=self._simulation.world.time_s,
            start_unix_s=HOST_START_S + self._unix_offset_s,
            truth=self._simulation.truth() if self._feed is None else self._feed.truth(),
            counters=self._counters | {i: member.counters() for i, member in sorted(self._members.items())},
        )

    # --- the world ------------------------------------------------------------------------------------------

    def _step(self) -> None:
        if self._feed is None:
            self._step_autopilots()
        else:
            self._step_feed(self._feed)
        if self._simulation.next_step_s() <= self._end_s + STEP_TOLERANCE_S:
            self._queue.at(self._simulation.next_step_s(), self._step)

    def _step_feed(self, feed: SensorFeed) -> None:
        sensed = feed.step()
        if sensed.samples or sensed.fixes or sensed.ranges:
            self._queue.at(self._queue.now_s + WIRE_S, functools.partial(self._on_sensed, sensed, self._queue.now_s))

    def _on_sensed(self, sensed: Sensed, taken_s: float) -> None:
        now_s = self._fleet.fleet_s
        for agent_id, sample in sensed.samples:
            if agent_id in self._members:
                self._members[agent_id].core.on_sample(sample, now_s)
        for agent_id, message in sensed.fixes:
            member = self._members.get(agent_id)
            if isinstance(member, ValueMember):
                member.on_fix(message, now_s)
        for measured in sensed.ranges:
            self._on_ranges(measured, taken_s)

    def _step_autopilots(self) -> None:
        """What an autopilot sends in one step travels as one datagram, as from the simulator's sockets."""
        outputs = self._simulation.advance(self._queue.now_s)
        waiting: dict[int, bytes] = {}
        for agent_id, frame in outputs.frames:
            waiting[agent_id] = waiting.get(agent_id, b"") + frame
        for agent_id, data in waiting.items():
            self._to_daemon(agent_id, data)
        for taken_s, measured in outputs.ranges:
            self._queue.at(self._queue.now_s + WIRE_S, functools.partial(self._on_ranges, measured, taken_s))

    def _to_daemon(self, agent_id: int, data: bytes) -> None:
        member = self._members.get(agent_id)
        if isinstance(member, ByteMember):
            self._queue.at(self._queue.now_s + WIRE_S, lambda: member.on_mavlink(data, self._queue.now_s))

    def _serve(self, member: ByteMember) -> None:
        """Send what is due on the autopilot's link, as the daemon does."""
        if self._members.get(member.agent_id) is not member:
            return
        for frame in member.to_autopilot(self._queue.now_s):
            self._queue.at(self._queue.now_s + WIRE_S, functools.partial(self._on_autopilot, member.agent_id, frame))
        self._queue.at(self._queue.now_s + SERVICE_S, lambda: self._serve(member))

    def _on_autopilot(self, agent_id: int, data: bytes) -> None:
        for frame in self._simulation.receive(agent_id, data, self._queue.now_s):
            self._to_daemon(agent_id, frame)

    def _on_ranges(self, measured: RangeSet, taken_s: float) -> None:
        member = self._members.get(measured.observer)
        heard = tuple(each for each in measured.ranges if each.target in self._members)
        if member is None or (measured.ranges and not heard):
            return
        measured = replace(measured, ranges=heard)
        if isinstance(member, ByteMember):
            payload = self._drivers.payload(taken_s, measured)
            member.on_uwb(payload, self._fleet.fleet_s, self._queue.now_s, self._queue.now_s + self._unix_offset_s)
        else:
            member.on_uwb(self._drivers.frame(taken_s, measured), self._queue.now_s - taken_s, self._fleet.fleet_s)

    def _keep_house(self, progress: Callable[[float], None] | None) -> None:
        for member in self._members.values():
            if isinstance(member, ByteMember):
                member.expire(self._queue.now_s)
        if progress is not None:
            progress(self._queue.now_s - HOST_START_S)
        self._queue.at(self._queue.now_s + HOUSEKEEPING_S, lambda: self._keep_house(progress))
