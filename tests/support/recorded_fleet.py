"""A fleet of agents as daemons hold them, in virtual time: simulated autopilots, sealed packets, flight logs.

Instants are as crooked as real ones, so that nothing hides in round numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from agent.config.tables import FleetConfig
from agent.log.disk import DiskLimit
from agent.log.estimate_mcap import agent_key
from agent.log.flight_log import FlightLog
from agent.log.run_logs import flight_start
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from estimators.factory import make_estimator
from sim_bridge.virtual.fleet_lockstep import START_FLEET_S, FleetLockstep, Surroundings
from sim_bridge.virtual.virtual_fleet import VirtualDrone
from sim_bridge.world.scenario import Scenario
from transport.security.auth import UNSIGNED, Identity, Signing, Trust

HOST_START_S = 54_321.123456
ROOM = 10**9


class RecordedFleet:
    """The configuration's ``[sim]`` flown by agents that record into ``out``.

    ``spoil`` may change the bytes that an agent reads from its autopilot: (agent, data) -> reads.
    """

    def __init__(
        self,
        config: FleetConfig,
        out: Path,
        *,
        limit: DiskLimit | None = None,
        spoil: Callable[[int, bytes], Sequence[bytes]] = lambda _agent_id, data: (data,),
        change: Callable[[Scenario], Scenario] = lambda scenario: scenario,
        signing: dict[int, Signing] | None = None,
        trust: Trust = UNSIGNED,
        seed: int = 1,
    ) -> None:
        self.config, self.out = config, out
        limit = limit or DiskLimit(out, ROOM, 0, lambda _: ROOM)
        unix_s = START_FLEET_S + config.fleet.epoch_unix_s
        starts = {i: flight_start(config, i, trust, unix_s, HOST_START_S) for i in config.ids}
        self.records = {
            i: FlightLog(out / agent_key(i), config, start, limit, threaded=False) for i, start in starts.items()
        }
        self.estimates: dict[int, list[EstimateReady]] = {i: [] for i in config.ids}
        rng = np.random.default_rng(seed)
        self.lockstep = FleetLockstep(
            config,
            make_estimator,
            self._on_estimate,
            "bytes",
            Surroundings(
                identities={i: Identity((signing or {}).get(i, UNSIGNED), trust) for i in config.ids},
                journals=self.records,
                change=change,
                spoil=spoil,
                lateness_s=lambda: float(rng.uniform(1e-4, 2e-3)),
                host_start_s=HOST_START_S,
            ),
        )
        self.queue, self.fleet = self.lockstep.queue, self.lockstep.fleet

    @property
    def drones(self) -> dict[int, VirtualDrone]:
        """By agent, once the flight has begun."""
        return self.fleet.drones

    def agent(self, agent_id: int) -> OnboardAgent:
        """The agent of a drone, once the flight has begun."""
        return self.drones[agent_id].agent

    def fly(self, duration_s: float, *, close: bool = True) -> None:
        """Fly from the start for a time, then close the records."""
        self.lockstep.run(duration_s)
        if close:
            for record in self.records.values():
                record.close()

    def _on_estimate(self, agent: OnboardAgent, ready: EstimateReady) -> None:
        self.estimates[agent.agent_id].append(ready)
        published_s = agent.fleet_s(self.queue.now_s)
        unix_s = published_s + self.config.fleet.epoch_unix_s
        self.records[agent.agent_id].on_estimate(ready, published_s, unix_s)
