"""A fleet in virtual time: drones on known circles, perfect or noisy sensors, and a radio that can be cut."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from agent.config.tables import FleetConfig
from agent.core import AgentCore
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady, HealthChanged
from agent.sensing.samples import AttitudeSample, GpsSample, ImuSample
from estimators.factory import make_estimator
from sim_bridge.virtual.event_queue import EventQueue
from sim_bridge.virtual.virtual_fleet import AIR_S, Parcel, VirtualDrone, VirtualFleet
from transport.link.channel import Channel, LinkFaults
from transport.messages.uwb_body import UwbFrame, UwbRange
from transport.security.auth import Identity

GRAVITY_MPS2 = 9.80665
STEP_S = 0.005


def position_of(agent_id: int, t_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True position, velocity and acceleration: circles of 4 m, each agent its own centre and phase."""
    rate, radius, phase = 2 * math.pi / 20, 4.0, 1.3 * agent_id
    angle = rate * t_s + phase
    centre = np.array([6.0 * math.cos(2.1 * agent_id), 6.0 * math.sin(2.1 * agent_id), -5.0 - agent_id])
    unit, across = (
        np.array([math.cos(angle), math.sin(angle), 0.0]),
        np.array([-math.sin(angle), math.cos(angle), 0]),
    )
    return centre + radius * unit, radius * rate * across, -radius * rate**2 * unit


class CutChannel(Channel[Parcel]):
    """Loses what ``cut`` (sender, receiver, time) says, and delays the rest."""

    def __init__(self, fleet: CirclingFleet, receiver: int) -> None:
        others = fleet.config.neighbours(receiver)
        faults = LinkFaults(delay_s=fleet.delay_s - AIR_S)
        super().__init__(dict.fromkeys(others, faults), {i: np.random.default_rng(i) for i in others})
        self._fleet, self._receiver = fleet, receiver

    def offer(self, neighbour: int, item: Parcel, now: float) -> None:
        if not self._fleet.cut(neighbour, self._receiver, now):
            super().offer(neighbour, item, now)


@dataclass
class CirclingFleet:
    """Agents on known circles; their monotonic clock is fleet time, which starts at ``start_s``."""

    config: FleetConfig
    start_s: float = 1000.0
    delay_s: float = 0.004
    noise: bool = True
    blind: Callable[[int, float], bool] = lambda agent_id, t_s: False
    cut: Callable[[int, int, float], bool] = lambda sender, receiver, t_s: False
    factory: Any = make_estimator
    seed: int = 1
    estimates: dict[int, list[EstimateReady]] = field(default_factory=dict)
    health: dict[int, list[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        ids, epoch_s = self.config.ids, self.config.fleet.epoch_unix_s
        self.estimates = {i: [] for i in ids}
        self.health = {i: [] for i in ids}
        self.rng = np.random.default_rng(self.seed)
        self.queue = EventQueue(self.start_s)
        self.fleet = VirtualFleet(
            self.config, self.queue, self._on_estimate, unix_offset_s=epoch_s, on_health=self._on_health
        )
        self.boots: Counter[int] = Counter()
        self.frames: Counter[int] = Counter()
        self.steps = 0
        for agent_id in ids:
            self.start(agent_id)

    @property
    def cores(self) -> dict[int, AgentCore]:
        """Of those who are there, by agent."""
        return {i: drone.agent.core for i, drone in self.fleet.drones.items()}

    def start(self, agent_id: int) -> None:
        """An agent begins, or begins anew."""
        self.boots[agent_id] += 1
        agent = OnboardAgent(
            self.config,
            agent_id,
            self.factory,
            Identity(boot=self.boots[agent_id]),
            unix_s=self.config.fleet.epoch_unix_s,
            host_s=0.0,
            linked=False,
        )
        self.fleet.join(VirtualDrone(agent, CutChannel(self, agent_id)))

    def kill(self, agent_id: int) -> None:
        """An agent ends without a word."""
        self.fleet.leave(agent_id, told=False)

    def run(self, duration_s: float) -> None:
        """Fly on for a time."""
        for _ in range(round(duration_s / STEP_S)):
            self.steps += 1
            self.queue.run_until(self.start_s + STEP_S * (self.steps - 1))
            t_s = self.start_s + STEP_S * self.steps
            self.queue.at(t_s, lambda t_s=t_s, step=self.steps: self._sense(t_s, step))  # type: ignore[misc]
        self.queue.run_until(self.start_s + STEP_S * self.steps)

    def _sense(self, t_s: float, step: int) -> None:
        for agent_id, drone in self.fleet.drones.items():
            self._sense_one(agent_id, drone.agent, t_s, step)

    def _sense_one(self, agent_id: int, agent: OnboardAgent, t_s: float, step: int) -> None:
        p, v, a = position_of(agent_id, t_s)
        if step % 2 == 0:
            force = a - np.array([0.0, 0.0, GRAVITY_MPS2]) + self._uniform(0.05, 3)
            agent.on_sample(ImuSample(t_s, tuple(force), (0.0, 0.0, 0.0)), t_s)
        if step % 4 == 0:
            agent.on_sample(AttitudeSample(t_s, (1.0, 0.0, 0.0, 0.0)), t_s)
        if step % 20 == 3 and not self.blind(agent_id, t_s):
            fix = tuple(p + self._uniform(0.15, 3))
            speed = float(np.linalg.norm(v) + self._uniform(0.08, 1)[0])
            agent.on_sample(GpsSample(t_s, fix, 0.3, 0.5, None, speed, 0.1, 3), t_s)
        if step % 20 == 5 + agent_id:
            self.frames[agent_id] += 1
            ranges = tuple(self._range(p, other, t_s) for other in self.config.neighbours(agent_id))
            agent.on_uwb_frame(UwbFrame(self.frames[agent_id], "unix", 0, ranges, agent_id), 0.0, t_s)

    def _range(self, p: np.ndarray, other: int, t_s: float) -> UwbRange:
        distance = np.linalg.norm(p - position_of(other, t_s)[0]) + self._uniform(0.1, 1)[0]
        return UwbRange(other, float(distance), 0.1)

    def _uniform(self, half_width: float, count: int) -> np.ndarray:
        drawn = self.rng.uniform(-half_width, half_width, count)
        return drawn if self.noise else np.zeros(count)

    def _on_estimate(self, agent: OnboardAgent, ready: EstimateReady) -> None:
        self.estimates[agent.agent_id].append(ready)

    def _on_health(self, agent_id: int, changed: HealthChanged) -> None:
        self.health[agent_id].append(str(changed.health))

    def own_error_m(self, agent_id: int, skip: int = 0) -> np.ndarray:
        """Norm of the own position's error, estimate by estimate."""
        slot = self.config.ids.index(agent_id)
        own = slice(6 * slot, 6 * slot + 3)
        ready = self.estimates[agent_id][skip:]
        return np.array([np.linalg.norm(r.estimate.mean[own] - position_of(agent_id, r.t_s)[0]) for r in ready])
