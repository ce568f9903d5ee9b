"""A fleet of agents as daemons hold them, in virtual time: simulated autopilots, sealed packets, flight records.

Instants are as crooked as real ones, so that nothing hides in round numbers.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from agent.config.tables import FleetConfig
from agent.log.disk import DiskLimit
from agent.log.flight_record import FlightRecord
from agent.log.mcap_record import agent_key
from agent.log.run_record import flight_start
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady, Send
from estimators.factory import make_estimator
from sim_bridge.virtual.virtual_fleet import EventQueue
from sim_bridge.world.scenario import Scenario
from sim_bridge.world.scenario_config import scenario_from_config
from sim_bridge.world.simulation import Simulation
from sim_bridge.world.uwb_frames import UwbDrivers
from transport.link.streams import Stream, key_expression
from transport.messages.estimate_body import FleetEstimate
from transport.security.auth import UNSIGNED, Signing, Trust
from transport.security.sealing import Sealer

HOST_START_S = 54_321.123456
FLEET_START_S = 10_000.0
ROOM = 10**9


class RecordedAgent:
    """One agent with its flight record; its UTC clock can be set wrong."""

    def __init__(self, fleet: OnboardFleet, agent_id: int, limit: DiskLimit) -> None:
        self.agent_id = agent_id
        config, unix_s = fleet.config, HOST_START_S + fleet.unix_offset_s
        self.onboard = OnboardAgent(
            config, agent_id, make_estimator, fleet.trust, unix_s=unix_s, host_s=HOST_START_S
        )
        start = flight_start(config, agent_id, fleet.trust, unix_s, HOST_START_S)
        self.record = FlightRecord(fleet.out / agent_key(agent_id), config, start, limit, threaded=False)
        self.onboard.journal = self.record
        self.sealer = Sealer(config.fleet.name, agent_id, boot=1, signing=fleet.signing.get(agent_id, UNSIGNED))
        self.utc_error_s = 0.0
        self.estimates: list[EstimateReady] = []


class OnboardFleet:
    """The configuration's ``[sim]`` flown by agents that record into ``out``.

    ``spoil`` may change the bytes that an agent reads from its autopilot: (agent, data) -> reads.
    """

    def __init__(
        self,
        config: FleetConfig,
        out: Path,
        *,
        limit: DiskLimit | None = None,
        spoil: Callable[[int, bytes], list[bytes]] | None = None,
        change: Callable[[Scenario], Scenario] = lambda scenario: scenario,
        signing: dict[int, Signing] | None = None,
        trust: Trust = UNSIGNED,
        seed: int = 1,
    ) -> None:
        self.config, self.out = config, out
        self.signing, self.trust = signing or {}, trust
        self.unix_offset_s = FLEET_START_S - HOST_START_S + config.fleet.epoch_unix_s
        self._spoil = spoil
        self._rng = np.random.default_rng(seed)
        self._simulation = Simulation(change(scenario_from_config(config)), HOST_START_S, self.unix_offset_s)
        self._drivers = UwbDrivers()
        self.queue = EventQueue(HOST_START_S)
        limit = limit or DiskLimit(out, ROOM, 0, lambda _: ROOM)
        self.agents = {i: RecordedAgent(self, i, limit) for i in config.ids}

    def fly(self, duration_s: float, *, close: bool = True) -> None:
        """Fly from the start for a time, then close the records."""
        for agent in self.agents.values():
            self._advance(agent)
            self._serve(agent)
            self._later(1.0, functools.partial(self._keep_house, agent))
        self._step()
        self.queue.run_until(HOST_START_S + duration_s)
        if close:
            for agent in self.agents.values():
                agent.record.close()

    def _later(self, after_s: float, act: Callable[[], None]) -> None:
        self.queue.at(self.queue.now_s + after_s + float(self._rng.uniform(1e-4, 2e-3)), act)

    def _unix_s(self, agent: RecordedAgent) -> float:
        return self.queue.now_s + self.unix_offset_s + agent.utc_error_s

    # --- the world ------------------------------------------------------------------------------------------

    def _step(self) -> None:
        outputs = self._simulation.advance(self.queue.now_s)
        waiting: dict[int, bytes] = {}
        for agent_id, frame in outputs.frames:
            waiting[agent_id] = waiting.get(agent_id, b"") + frame
        for agent_id, data in waiting.items():
            self._to_agent(agent_id, data)
        for taken_s, measured in outputs.ranges:
            agent = self.agents[measured.observer]
            payload = self._drivers.payload(taken_s, measured)
            self._later(0.0, functools.partial(self._on_uwb, agent, payload))
        self.queue.at(self._simulation.next_step_s(), self._step)

    def _to_agent(self, agent_id: int, data: bytes) -> None:
        agent = self.agents[agent_id]
        for read in [data] if self._spoil is None else self._spoil(agent_id, data):
            self.queue.at(self.queue.now_s + 0.001, functools.partial(self._on_mavlink, agent, read))

    def _on_mavlink(self, agent: RecordedAgent, data: bytes) -> None:
        agent.onboard.on_mavlink(data, self.queue.now_s)

    def _on_uwb(self, agent: RecordedAgent, payload: bytes) -> None:
        agent.onboard.on_uwb(payload, self.queue.now_s)

    def _serve(self, agent: RecordedAgent) -> None:
        for frame in agent.onboard.serve_autopilot(self.queue.now_s):
            for answer in self._simulation.receive(agent.agent_id, frame, self.queue.now_s):
                self._to_agent(agent.agent_id, answer)
        self._later(0.05, functools.partial(self._serve, agent))

    # --- the agents -----------------------------------------------------------------------------------------

    def _keep_house(self, agent: RecordedAgent) -> None:
        if agent.onboard.keep_house(unix_s=self._unix_s(agent), host_s=self.queue.now_s):
            self._advance(agent)
        agent.record.hand_over()
        self._later(1.0, functools.partial(self._keep_house, agent))

    def _advance(self, agent: RecordedAgent) -> None:
        for output in agent.onboard.advance(self.queue.now_s):
            if isinstance(output, EstimateReady):
                agent.estimates.append(output)
                published_s = agent.onboard.fleet_s(self.queue.now_s)
                agent.record.on_estimate(output, published_s, published_s + self.config.fleet.epoch_unix_s)
            elif isinstance(output, Send) and not isinstance(output.message, FleetEstimate):
                for packet in agent.sealer.seal(output.message, t_ns=round(self._unix_s(agent) * 1e9)):
                    self.transmit(agent.agent_id, packet.stream, packet.data)
        due_s = agent.onboard.next_due_host_s()
        assert due_s is not None
        self.queue.at(max(due_s, math.nextafter(self.queue.now_s, math.inf)), lambda: self._wake(agent))

    def _wake(self, agent: RecordedAgent) -> None:
        due_s = agent.onboard.next_due_host_s()
        if due_s is not None and due_s <= math.nextafter(self.queue.now_s, math.inf):
            self._advance(agent)

    def transmit(self, sender: int, stream: Stream, data: bytes) -> None:
        """A packet goes out to all neighbours."""
        key = key_expression(self.config.fleet.name, sender, stream)
        for hearer in self.config.neighbours(sender):
            self._later(0.0, functools.partial(self._arrive, self.agents[hearer], key, data, self.queue.now_s))

    def _arrive(self, agent: RecordedAgent, key: str, data: bytes, arrived_s: float) -> None:
        unix_ns = round(self._unix_s(agent) * 1e9)
        agent.onboard.on_packet(key, data, arrived_s=arrived_s, host_s=self.queue.now_s, unix_ns=unix_ns)
        self._advance(agent)
