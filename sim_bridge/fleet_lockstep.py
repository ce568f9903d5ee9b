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
import heapq
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from agent.config_tables import FleetConfig
from agent.core import EstimatorFactory
from agent.outputs import EstimateReady, Output, Send
from sim_bridge.lockstep_members import ByteMember, Member, Parcel, ValueMember
from sim_bridge.scenario_config import scenario_from_config
from sim_bridge.sensor_feed import Sensed, SensorFeed
from sim_bridge.sensors import RangeSet
from sim_bridge.simulation import STEP_TOLERANCE_S, Simulation
from sim_bridge.truth import Truth
from sim_bridge.uwb_frames import UwbDrivers
from transport.estimate_body import FleetEstimate

HOST_START_S = 1000.0
"""The virtual monotonic clock at the start."""
START_FLEET_S = 10_000.0
"""Fleet time about the start; it begins on a tick."""
WIRE_S = 0.001
"""How long a datagram takes between an autopilot or UWB module and its daemon."""
AIR_S = 0.001
"""How long a packet takes between two agents before the configured loss and delay."""
SERVICE_S = 0.05
"""How often an agent looks what is due on its autopilot's link; the daemon's own period."""
HOUSEKEEPING_S = 1.0
LAST_TICKS = 1.0
"""The agents get one period more than the world, for the estimate of its last tick."""

Fidelity = Literal["values", "bytes"]
OnEstimate = Callable[[int, EstimateReady], None]
"""(agent, its estimate of a tick)."""


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
    ) -> None:
        self._config = config
        self._on_estimate = on_estimate
        period_s = config.fleet.period_s
        fleet_start_s = math.ceil(START_FLEET_S / period_s) * period_s
        self._fleet_offset_s = fleet_start_s - HOST_START_S
        self._unix_offset_s = self._fleet_offset_s + config.fleet.epoch_unix_s
        self._simulation = Simulation(scenario_from_config(config), HOST_START_S, self._unix_offset_s)
        self._feed: SensorFeed | None = None
        self._members: dict[int, ValueMember | ByteMember]
        if fidelity == "values":
            rates_hz = config.mavlink.imu_hz, config.mavlink.attitude_hz
            self._feed = SensorFeed(self._simulation, *rates_hz, fleet_start_s)
            self._members = {i: ValueMember(config, i, make_estimator, fleet_start_s) for i in config.ids}
        else:
            self._members = {i: ByteMember(config, i, make_estimator, self._fleet_offset_s) for i in config.ids}
        self._drivers = UwbDrivers()
        self._hearers = {i: config.neighbours(i) for i in config.ids}
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._now_s = HOST_START_S
        self._end_s = HOST_START_S

    def run(self, duration_s: float, progress: Callable[[float], None] | None = None) -> LockstepReport:
        """Fly for a time; ``progress`` is told the simulated time about once a second of it."""
        self._end_s = HOST_START_S + duration_s
        for member in self._members.values():
            self._advance(member)
            if isinstance(member, ByteMember):
                self._serve(member)
        self._at(self._simulation.next_step_s(), self._step)
        self._at(HOST_START_S + HOUSEKEEPING_S, lambda: self._keep_house(progress))
        last_s = self._end_s + LAST_TICKS * self._config.fleet.period_s
        while self._events[0][0] <= last_s:
            self._now_s, _, act = heapq.heappop(self._events)
            act()
        return LockstepReport(
            duration_s=self._simulation.world.time_s,
            start_unix_s=HOST_START_S + self._unix_offset_s,
            truth=self._simulation.truth() if self._feed is None else self._feed.truth(),
            counters={agent_id: member.counters() for agent_id, member in self._members.items()},
        )

    # --- the world ------------------------------------------------------------------------------------------

    def _at(self, time_s: float, act: Callable[[], None]) -> None:
        """Do something at a virtual time; what is due together is done in the order in which it was asked for."""
        heapq.heappush(self._events, (time_s, next(self._order), act))

    def _step(self) -> None:
        if self._feed is None:
            self._step_autopilots()
        else:
            self._step_feed(self._feed)
        if self._simulation.next_step_s() <= self._end_s + STEP_TOLERANCE_S:
            self._at(self._simulation.next_step_s(), self._step)

    def _step_feed(self, feed: SensorFeed) -> None:
        sensed = feed.step()
        if sensed.samples or sensed.fixes or sensed.ranges:
            self._at(self._now_s + WIRE_S, functools.partial(self._on_sensed, sensed, self._now_s))

    def _on_sensed(self, sensed: Sensed, taken_s: float) -> None:
        now_s = self._fleet_s
        for agent_id, sample in sensed.samples:
            self._members[agent_id].on_sample(sample, now_s)
        for agent_id, message in sensed.fixes:
            member = self._members[agent_id]
            assert isinstance(member, ValueMember)
            member.on_fix(message, now_s)
        for measured in sensed.ranges:
            self._on_ranges(measured, taken_s)

    def _step_autopilots(self) -> None:
        """What an autopilot sends in one step travels as one datagram, as from the simulator's sockets."""
        outputs = self._simulation.advance(self._now_s)
        waiting: dict[int, bytes] = {}
        for agent_id, frame in outputs.frames:
            waiting[agent_id] = waiting.get(agent_id, b"") + frame
        for agent_id, data in waiting.items():
            self._to_daemon(agent_id, data)
        for taken_s, measured in outputs.ranges:
            self._at(self._now_s + WIRE_S, functools.partial(self._on_ranges, measured, taken_s))

    def _to_daemon(self, agent_id: int, data: bytes) -> None:
        member = self._members[agent_id]
        assert isinstance(member, ByteMember)
        self._at(self._now_s + WIRE_S, lambda: member.on_mavlink(data, self._now_s))

    def _serve(self, member: ByteMember) -> None:
        """Send what is due on the autopilot's link, as the daemon does."""
        for frame in member.to_autopilot(self._now_s):
            self._at(self._now_s + WIRE_S, functools.partial(self._on_autopilot, member.agent_id, frame))
        self._at(self._now_s + SERVICE_S, lambda: self._serve(member))

    def _on_autopilot(self, agent_id: int, data: bytes) -> None:
        for frame in self._simulation.receive(agent_id, data, self._now_s):
            self._to_daemon(agent_id, frame)

    def _on_ranges(self, measured: RangeSet, taken_s: float) -> None:
        member = self._members[measured.observer]
        if isinstance(member, ByteMember):
            payload = self._drivers.payload(taken_s, measured)
            member.on_uwb(payload, self._fleet_s, self._now_s, self._now_s + self._unix_offset_s)
        else:
            member.on_uwb(self._drivers.frame(taken_s, measured), self._now_s - taken_s, self._fleet_s)

    def _keep_house(self, progress: Callable[[float], None] | None) -> None:
        for member in self._members.values():
            if isinstance(member, ByteMember):
                member.expire(self._now_s)
        if progress is not None:
            progress(self._now_s - HOST_START_S)
        self._at(self._now_s + HOUSEKEEPING_S, lambda: self._keep_house(progress))

    # --- the agents -----------------------------------------------------------------------------------------

    @property
    def _fleet_s(self) -> float:
        return self._now_s + self._fleet_offset_s

    def _advance(self, member: Member) -> None:
        """Let a core do what is due; come back when it wants to."""
        self._put_out(member, member.core.advance(self._fleet_s))
        due_s = member.core.next_due_s()
        if due_s is not None:
            # a time that went through the offset may come out a hair early: the core then asks again
            host_s = max(due_s - self._fleet_offset_s, math.nextafter(self._now_s, math.inf))
            self._at(host_s, lambda: self._wake(member))

    def _wake(self, member: Member) -> None:
        """A timer that an earlier packet has overtaken finds nothing to do."""
        due_s = member.core.next_due_s()
        if due_s is not None and due_s - self._fleet_offset_s <= math.nextafter(self._now_s, math.inf):
            self._advance(member)

    def _put_out(self, member: Member, outputs: list[Output]) -> None:
        for output in outputs:
            if isinstance(output, EstimateReady):
                self._on_estimate(member.agent_id, output)
            elif isinstance(output, Send) and not isinstance(output.message, FleetEstimate):
                # estimates are for people: no agent listens to them
                unix_ns = round((self._now_s + self._unix_offset_s) * 1e9)
                for parcel in member.pack(output.message, unix_ns):
                    self._transmit(member.agent_id, parcel)

    def _transmit(self, sender: int, parcel: Parcel) -> None:
        arrival_s = self._now_s + AIR_S
        for hearer in self._hearers[sender]:
            self._at(arrival_s, functools.partial(self._arrive, self._members[hearer], sender, parcel))

    def _arrive(self, receiver: Member, sender: int, parcel: Parcel) -> None:
        receiver.channel.offer(sender, parcel, self._now_s)
        self._deliver(receiver)

    def _deliver(self, receiver: Member) -> None:
        """Hand on what the channel lets through by now, and come back for what it delays."""
        for _, parcel in receiver.channel.due(self._now_s):
            unix_ns = round((self._now_s + self._unix_offset_s) * 1e9)
            received = receiver.unpack(parcel, self._now_s, unix_ns)
            if received is not None:
                receiver.core.on_packet(received, self._fleet_s)
                self._advance(receiver)
        due_s = receiver.channel.next_due()
        if due_s is not None:
            self._at(due_s, lambda: self._deliver(receiver))
