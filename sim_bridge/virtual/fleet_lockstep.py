"""A whole fleet in virtual time: the simulated world and the drones' own agents in one process.

What the daemon does with sockets and timers happens here by a queue of events. Nothing reads a clock, so that
one configuration gives one result, bit by bit, as fast as the processor can. Packets are sealed and opened as on the
radio; the autopilots come in two fidelities:

- ``"values"``: samples of their sensors as values; twice as fast.
- ``"bytes"``: their MAVLink bytes go through the agent's session, with its handshakes and clock synchronisation.
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from agent.config.tables import FleetConfig
from agent.core import EstimatorFactory
from agent.inputs import Journal
from agent.mavlink.sample_adapter import SampleAdapter
from agent.onboard import OnboardAgent
from agent.sensing.frames import FleetFrame
from agent.sensing.samples import AttitudeSample
from sim_bridge.companions.target_camera import CameraDrivers, SensedDetections
from sim_bridge.faults.member_faults import corrupt
from sim_bridge.virtual.event_queue import EventQueue
from sim_bridge.virtual.fleet_events import FleetEvents
from sim_bridge.virtual.virtual_fleet import OnEstimate, Tap, VirtualDrone, VirtualFleet, channel_of
from sim_bridge.world.scenario import Scenario
from sim_bridge.world.scenario_config import scenario_from_config
from sim_bridge.world.sensor_feed import Sensed, SensorFeed
from sim_bridge.world.sensors import SensedRanges
from sim_bridge.world.simulation import STEP_TOLERANCE_S, Simulation
from sim_bridge.world.truth import Truth
from sim_bridge.world.uwb_frames import UwbDrivers
from transport.security.auth import Identity

HOST_START_S = 1000.0
"""The virtual monotonic clock at the start."""
START_FLEET_S = 10_000.0
"""Fleet time about the start; it begins on a tick."""
WIRE_S = 0.001
"""How long a datagram takes between an autopilot or UWB module and its daemon."""
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


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What a run has besides its configuration; the default is the plain run."""

    events: FleetEvents = field(default_factory=FleetEvents)
    identities: Mapping[int, Identity] = field(default_factory=dict)
    """Who signs; the others do not, whatever ``[security]`` says."""
    journals: Mapping[int, Journal] = field(default_factory=dict)
    """Who takes down what comes in (fidelity ``"bytes"``)."""
    change: Callable[[Scenario], Scenario] = lambda scenario: scenario
    """Makes another scenario of the configuration's."""
    spoil: Callable[[int, bytes], Sequence[bytes]] = lambda _agent_id, data: (data,)
    """Changes what an agent reads from its autopilot: (agent, bytes) -> reads."""
    lateness_s: Callable[[], float] = lambda: 0.0
    """How much later than asked for each thing happens."""
    make_agent: Callable[..., OnboardAgent] = OnboardAgent
    """What makes the agents; another one may listen to what comes in."""
    tap: Tap | None = None
    """Follows packets."""
    host_start_s: float = HOST_START_S
    """The virtual monotonic clock at the start."""


class FleetLockstep:
    """One run; ``on_estimate`` gets every estimate in the order in which they are made.

    The configuration's ``[sim]`` is flown, loss and delay are those of ``[transport]``. Raises `ScenarioError` for
    what the simulator cannot do.
    """

    def __init__(
        self,
        config: FleetConfig,
        make_estimator: EstimatorFactory,
        on_estimate: OnEstimate,
        fidelity: Fidelity = "values",
        surroundings: Surroundings | None = None,
    ) -> None:
        self._config = config
        self._make_estimator = make_estimator
        self._around = around = surroundings or Surroundings()
        period_s = config.fleet.period_s
        self._start_s = around.host_start_s
        self._fleet_start_s = math.ceil(START_FLEET_S / period_s) * period_s
        self._unix_offset_s = self._fleet_start_s - self._start_s + config.fleet.epoch_unix_s
        scenario = around.change(scenario_from_config(config))
        self._simulation = Simulation(scenario, self._start_s, self._unix_offset_s)
        self._feed: SensorFeed | None = None
        if fidelity == "values":
            rates_hz = config.mavlink.imu_hz, config.mavlink.attitude_hz
            self._feed = SensorFeed(self._simulation, *rates_hz, self._fleet_start_s)
        self._fixes = {i: self._fix_adapter() for i in config.ids}
        self._lives: Counter[int] = Counter()
        self._counters: dict[int, dict[str, int]] = {}
        self._drivers, self._cameras = UwbDrivers(), CameraDrivers()
        self.queue = EventQueue(self._start_s)
        self.fleet = VirtualFleet(
            config,
            self.queue,
            on_estimate,
            unix_offset_s=self._unix_offset_s,
            to_autopilot=self._on_frame,
            tap=around.tap,
            lateness_s=around.lateness_s,
        )
        self._end_s = self._start_s

    def run(self, duration_s: float, progress: Callable[[float], None] | None = None) -> LockstepReport:
        """Fly for a time; ``progress`` is told the simulated time about once a second of it."""
        self._end_s = self._start_s + duration_s
        self._come_and_go()
        self.queue.at(self._simulation.next_step_s(), self._step)
        if progress is not None:
            self._tell_progress(progress)
        for time_s in self._around.events.changes_s():
            self.queue.at(self._start_s + time_s, self._come_and_go)
        last_s = self._end_s + LAST_TICKS * self._config.fleet.period_s
        self.queue.run_until(last_s)
        for agent_id in sorted(self.fleet.drones):
            self._put_down_counters(agent_id)
        return LockstepReport(
            duration_s=self._simulation.world.time_s,
            start_unix_s=self._start_s + self._unix_offset_s,
            truth=self._simulation.truth() if self._feed is None else self._feed.truth(),
            counters=self._counters,
        )

    # --- drones ---------------------------------------------------------------------------------------------

    def _come_and_go(self) -> None:
        events = self._around.events
        time_s = self.queue.now_s - self._start_s + STEP_TOLERANCE_S  # which may come out a hair before the change
        for agent_id in self._config.ids:
            is_there = events.is_there(agent_id, time_s)
            if is_there and agent_id not in self.fleet.drones:
                self.fleet.join(self._drone(agent_id))
            elif not is_there and agent_id in self.fleet.drones:
                self._put_down_counters(agent_id)
                self.fleet.leave(agent_id)

    def _drone(self, agent_id: int) -> VirtualDrone:
        """An agent that begins; ``away`` ones begin anew when they come back."""
        self._lives[agent_id] += 1
        identity = self._around.identities.get(agent_id, Identity(boot=self._lives[agent_id]))
        agent = self._around.make_agent(
            self._config,
            agent_id,
            self._make_estimator,
            identity,
            unix_s=self.queue.now_s + self._unix_offset_s,
            host_s=self.queue.now_s,
            journal=self._around.journals.get(agent_id),
            linked=self._feed is None,
        )
        start_unix_s = self._start_s + self._unix_offset_s
        corrupt(agent, self._config, identity, self._simulation.scenario.faults, start_unix_s)
        outages = self._around.events.outages(agent_id, self._config.ids, self._start_s)
        channel = channel_of(self._config, agent_id, outages=outages, began_s=self._start_s)
        return VirtualDrone(agent, channel)

    def _fix_adapter(self) -> SampleAdapter:
        """Makes samples of the fixes of a receiver whose stamps count from the start."""
        config = self._config
        return SampleAdapter(
            FleetFrame.of(config),
            config.sensors,
            config.fleet.epoch_unix_s,
            lambda boot_s, _arrival_s: self._fleet_start_s + boot_s,
        )

    def _put_down_counters(self, agent_id: int) -> None:
        counters = self.fleet.drones[agent_id].counters()
        skipped = self._fixes[agent_id].skipped
        self._counters[agent_id] = counters | {f"skipped {reason}": count for reason, count in skipped.items()}

    # --- the world ------------------------------------------------------------------------------------------

    def _step(self) -> None:
        if self._feed is None:
            self._step_autopilots()
        else:
            self._step_feed(self._feed)
        if self._simulation.next_step_s() <= self._end_s + STEP_TOLERANCE_S:
            self.queue.at(self._simulation.next_step_s(), self._step)

    def _step_feed(self, feed: SensorFeed) -> None:
        sensed = feed.step()
        if sensed.samples or sensed.fixes or sensed.ranges or sensed.detections:
            self._over_the_wire(functools.partial(self._on_sensed, sensed, self.queue.now_s))

    def _on_sensed(self, sensed: Sensed, taken_s: float) -> None:
        host_s, drones = self.queue.now_s, self.fleet.drones
        for agent_id, sample in sensed.samples:
            if agent_id in drones:
                if isinstance(sample, AttitudeSample) and self._fixes[agent_id].frozen:
                    sample = replace(sample, receiver_frozen=True)  # as the session says of real bytes
                drones[agent_id].agent.on_sample(sample, host_s)
        for agent_id, message in sensed.fixes:
            if agent_id in drones:
                agent = drones[agent_id].agent
                fix = self._fixes[agent_id].convert(message, agent.fleet_s(host_s))
                if fix is not None:
                    agent.on_sample(fix, host_s)
        for measured in sensed.ranges:
            self._on_ranges(measured, taken_s)
        for seen in sensed.detections:
            self._on_detections(seen, taken_s)

    def _step_autopilots(self) -> None:
        """What an autopilot sends in one step travels as one datagram, as from the simulator's sockets."""
        outputs = self._simulation.advance(self.queue.now_s)
        waiting: dict[int, bytes] = {}
        for agent_id, frame in outputs.frames:
            waiting[agent_id] = waiting.get(agent_id, b"") + frame
        for agent_id, data in waiting.items():
            self._to_agent(agent_id, data)
        for taken_s, measured in outputs.ranges:
            self._over_the_wire(functools.partial(self._on_ranges, measured, taken_s))
        for taken_s, seen in outputs.detections:
            self._over_the_wire(functools.partial(self._on_detections, seen, taken_s))

    def _to_agent(self, agent_id: int, data: bytes) -> None:
        for read in self._around.spoil(agent_id, data):
            self.queue.at(self.queue.now_s + WIRE_S, functools.partial(self._on_bytes, agent_id, read))

    def _on_bytes(self, agent_id: int, data: bytes) -> None:
        if agent_id in self.fleet.drones:
            self.fleet.drones[agent_id].agent.on_mavlink(data, self.queue.now_s)

    def _on_frame(self, agent_id: int, frame: bytes) -> None:
        """A frame of an agent for its autopilot."""
        self.queue.at(self.queue.now_s + WIRE_S, functools.partial(self._on_autopilot, agent_id, frame))

    def _on_autopilot(self, agent_id: int, frame: bytes) -> None:
        for answer in self._simulation.receive(agent_id, frame, self.queue.now_s):
            self._to_agent(agent_id, answer)

    def _on_ranges(self, measured: SensedRanges, taken_s: float) -> None:
        drone = self.fleet.drones.get(measured.observer)
        there = self.fleet.drones.keys() | self._config.places_m.keys() | self._config.kinds.keys()
        heard = tuple(each for each in measured.ranges if each.target in there)
        if drone is None or (measured.ranges and not heard):
            return
        measured = replace(measured, ranges=heard)
        if self._feed is None:
            drone.agent.on_uwb(self._drivers.payload(taken_s, measured), self.queue.now_s)
        else:
            frame = self._drivers.frame(taken_s, measured)
            drone.agent.on_uwb_frame(frame, self.queue.now_s - taken_s, self.queue.now_s)

    def _on_detections(self, seen: SensedDetections, taken_s: float) -> None:
        drone = self.fleet.drones.get(seen.observer)
        if drone is not None:
            drone.agent.on_uwb(self._cameras.payload(taken_s, seen), self.queue.now_s)

    def _over_the_wire(self, act: Callable[[], None]) -> None:
        self.queue.at(self.queue.now_s + WIRE_S + self._around.lateness_s(), act)

    def _tell_progress(self, progress: Callable[[float], None]) -> None:
        if self.queue.now_s > self._start_s:
            progress(self.queue.now_s - self._start_s)
        self.queue.at(self.queue.now_s + 1.0, lambda: self._tell_progress(progress))
