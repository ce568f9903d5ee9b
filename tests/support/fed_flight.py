"""Four drones in squares whose autopilots are given the estimate, in virtual time with fake autopilots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from agent.feedback.gatekeeper import FeedPhase
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from estimators.factory import make_estimator
from estimators.model.layout import block
from estimators.model.measurements import Vector
from sim_bridge.autopilot.fake_autopilot import FakeAutopilot
from sim_bridge.virtual.fleet_lockstep import FleetLockstep, Surroundings

BLIND = 2
CORNERS = ((0.0, 0.0), (20.0, 0.0), (20.0, 20.0), (0.0, 20.0))
STARTS = ((0.0, 0.0, -8.0), (7.0, 6.0, -20.0), (16.0, 0.0, -9.0), (4.0, 17.0, -10.0))
"""The second drone is well above the plane of the others, which is what holds it without GPS."""


def fed_fleet(
    autopilot: str = "px4",
    *,
    seed: int = 1,
    outage_s: tuple[float, float] = (30.0, 60.0),
    feedback: dict[str, Any] | None = None,
    **tables: Any,
) -> FleetConfig:
    """A fleet of four in squares at 2.5 m/s, all of one autopilot; drone 2 is without GPS during ``outage_s``."""
    paths = [
        {
            "agent": i,
            "kind": "waypoints",
            "points_m": [[n + dn, e + de, d] for dn, de in CORNERS],
            "hold_s": 8.0,
        }
        for i, (n, e, d) in enumerate(STARTS, start=1)
    ]
    sim = {
        "seed": seed,
        "profile": "realistic",
        "autopilots": "fusing",
        "paths": paths,
        "gps_hz": 5.0,
        "gps_outages": [{"agent": BLIND, "from_s": outage_s[0], "to_s": outage_s[1]}],
    }
    document: dict[str, Any] = {
        "fleet": {"name": "fed", "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 400.0}},
        "agents": [
            {"id": i, "autopilot": autopilot, "mavlink": f"udpin:127.0.0.1:{14560 + i}"} for i in range(1, 5)
        ],
        "sensors": {"gps_latency_s": 0.0, "imu_latency_s": 0.0},
        "security": {"mode": "unsigned"},
        "feedback": {"kind": "odometry", "agents": [BLIND], **(feedback or {})},
        "sim": sim | tables.pop("sim", {}),
        **tables,
    }
    return config_from(document, "test")


@dataclass
class FedFlight:
    """One flight, looked at 10 times a second: what drone 2's autopilot and daemon believed, and what was fed."""

    config: FleetConfig
    duration_s: float
    surroundings: Surroundings = field(default_factory=Surroundings)
    at_s: list[float] = field(default_factory=list)
    phases: list[FeedPhase] = field(default_factory=list)
    autopilot_m: list[Vector] = field(default_factory=list)
    """Its error, NED."""
    daemon_m: list[Vector] = field(default_factory=list)
    truth_m: list[Vector] = field(default_factory=list)
    said: dict[str, float] = field(default_factory=dict)
    """What the health said, and when first."""

    def fly(self) -> FedFlight:
        """Fly it."""
        self.lockstep = FleetLockstep(
            self.config, make_estimator, self._on_estimate, "bytes", self.surroundings
        )
        self.report = self.lockstep.run(self.duration_s)
        return self

    @property
    def autopilot(self) -> FakeAutopilot:
        """Of drone 2."""
        return self.lockstep._simulation.autopilots[BLIND]

    def _on_estimate(self, agent: OnboardAgent, ready: EstimateReady) -> None:
        if agent.agent_id != BLIND or agent.feeder is None:
            return
        simulation = self.lockstep._simulation
        truth = simulation.world.position_m[BLIND - 1].copy()
        unix_s = ready.t_s + self.config.fleet.epoch_unix_s
        then = simulation.truth().at(min(unix_s, simulation.truth().time_unix_s[-1]))[BLIND - 1, :3]
        self.at_s.append(simulation.world.time_s)
        self.truth_m.append(truth)
        self.autopilot_m.append(self.autopilot.state.navigation.position_m - truth)
        self.daemon_m.append(ready.estimate.mean[block(BLIND - 1)][:3] - then)
        self.phases.append(agent.feeder.verdict.phase)
        for reason in agent.core.health.health.reasons:
            self.said.setdefault(reason, simulation.world.time_s)

    def between(self, from_s: float, to_s: float, values: Sequence[Vector]) -> Vector:
        """Horizontal lengths of what was noted in an interval."""
        chosen = [v for t, v in zip(self.at_s, values, strict=True) if from_s <= t < to_s]
        return np.array([np.hypot(v[0], v[1]) for v in chosen])

    def share(self, phase: FeedPhase, from_s: float, to_s: float) -> float:
        """Of the estimates of an interval, how many found the feed in a phase."""
        chosen = [p is phase for t, p in zip(self.at_s, self.phases, strict=True) if from_s <= t < to_s]
        return float(np.mean(chosen))
