"""A fleet in virtual time: drones on known curves, perfect or noisy sensors, and the wire between cores."""

from __future__ import annotations

import math
import socket
import tomllib
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from agent.core import AgentCore
from agent.mavlink.codec import Decoder, Encoder, mavlink
from agent.outputs import EstimateReady, HealthChanged, Output, Send
from agent.sensing.samples import AttitudeSample, GpsSample, ImuSample, RangeSample
from estimators.factory import make_estimator
from tests.support.ports import HOST, free_ports
from transport.link.streams import key_expression
from transport.security.auth import UNSIGNED
from transport.security.opening import Opener
from transport.security.sealing import Sealer

GRAVITY_MPS2 = 9.80665
CONFIG = """
[fleet]
name = "test"
period_s = 0.1
origin = { lat_deg = 47.0, lon_deg = 8.0, alt_m = 400.0 }

[estimator]
kind = "dekf_ci"
share_inputs = "fleet"

[sensors]
gps_position_half_width_m = 0.15
gps_speed = "norm"
gps_speed_half_width_mps = 0.08
uwb_bound_m = 0.1
accel_sigma_mps2 = 0.0577
gravity_mps2 = 9.80665

[security]
mode = "unsigned"
"""


def fleet_config(count: int = 3, *overrides: str) -> FleetConfig:
    """A small fleet's configuration."""
    document: dict[str, Any] = tomllib.loads(CONFIG)
    document["agents"] = [{"id": i, "mavlink": f"udpin:127.0.0.1:{15000 + i}"} for i in range(1, count + 1)]
    return config_from(document, "test", overrides)


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


@dataclass
class VirtualFleet:
    """Cores joined by a wire with a delay, in steps of 5 ms; ``deaf`` are (sender, receiver) pairs cut off."""

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
        ids = self.config.ids
        self.cores = {i: self.new_core(i) for i in ids}
        self.sealers = {i: Sealer("test", i, boot=1, signing=UNSIGNED) for i in ids}
        self.openers = {i: Opener("test", ids, UNSIGNED, own_id=i) for i in ids}
        self.estimates = {i: [] for i in ids}
        self.health = {i: [] for i in ids}
        self.rng = np.random.default_rng(self.seed)
        self.wire: list[tuple[float, int, int, str, bytes]] = []
        self.now_s = self.start_s
        self.steps = 0

    def new_core(self, agent_id: int) -> AgentCore:
        core = AgentCore(self.config, agent_id, self.factory)
        core.autopilot_state = "connected"
        return core

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s / 0.005)):
            self.steps += 1
            self.now_s = self.start_s + 0.005 * self.steps
            for agent_id, core in list(self.cores.items()):
                self.sense(agent_id, core)
            self.deliver()
            for agent_id, core in list(self.cores.items()):
                self.handle(agent_id, core.advance(self.now_s))

    def sense(self, agent_id: int, core: AgentCore) -> None:
        t_s = self.now_s
        p, v, a = position_of(agent_id, t_s)
        if self.steps % 2 == 0:
            force = a - np.array([0.0, 0.0, GRAVITY_MPS2]) + self.uniform(0.05, 3)
            core.on_imu(ImuSample(t_s, tuple(force), (0.0, 0.0, 0.0)), t_s)
        if self.steps % 4 == 0:
            core.on_attitude(AttitudeSample(t_s, (1.0, 0.0, 0.0, 0.0)), t_s)
        if self.steps % 20 == 3 and not self.blind(agent_id, t_s):
            fix = tuple(p + self.uniform(0.15, 3))
            speed = float(np.linalg.norm(v) + self.uniform(0.08, 1)[0])
            core.on_gps(GpsSample(t_s, fix, 0.3, 0.5, None, speed, 0.1, 3), t_s)
        if self.steps % 20 == 5 + agent_id:
            for other in self.config.neighbours(agent_id):
                distance = np.linalg.norm(p - position_of(other, t_s)[0]) + self.uniform(0.1, 1)[0]
                core.on_range(RangeSample(t_s, agent_id, other, float(distance), 0.1), t_s)

    def uniform(self, half_width: float, count: int) -> np.ndarray:
        drawn = self.rng.uniform(-half_width, half_width, count)
        return drawn if self.noise else np.zeros(count)

    def deliver(self) -> None:
        due = [entry for entry in self.wire if entry[0] <= self.now_s]
        self.wire = [entry for entry in self.wire if entry[0] > self.now_s]
        for _, sender, receiver, key, data in due:
            if receiver not in self.cores or self.cut(sender, receiver, self.now_s):
                continue
            received = self.openers[receiver].open(key, data, now=self.now_s, unix_ns=0)
            if received is not None:
                self.cores[receiver].on_packet(received, self.now_s)

    def handle(self, agent_id: int, outputs: list[Output]) -> None:
        for output in outputs:
            if isinstance(output, EstimateReady):
                self.estimates[agent_id].append(output)
            elif isinstance(output, HealthChanged):
                self.health[agent_id].append(str(output.health))
            elif isinstance(output, Send):
                for packet in self.sealers[agent_id].seal(output.message, t_ns=0):
                    key = key_expression("test", agent_id, packet.stream)
                    for other in self.config.neighbours(agent_id):
                        self.wire.append((self.now_s + self.delay_s, agent_id, other, key, packet.data))

    def own_error_m(self, agent_id: int, skip: int = 0) -> np.ndarray:
        """Norm of the own position's error, estimate by estimate."""
        slot = self.config.ids.index(agent_id)
        own = slice(6 * slot, 6 * slot + 3)
        ready = self.estimates[agent_id][skip:]
        return np.array([np.linalg.norm(r.estimate.mean[own] - position_of(agent_id, r.t_s)[0]) for r in ready])


HIGHRES, RAW, QUATERNION = 105, 27, 31


@dataclass
class VirtualAutopilot:
    """Streams what it is asked for, answers commands and TIMESYNC; ``boot_s`` is host time of its start."""

    autopilot: int = mavlink.MAV_AUTOPILOT_PX4
    boot_s: float = 90.0
    system_id: int = 1
    refuses: tuple[int, ...] = ()
    deaf: bool = False
    answers_timesync: bool = True
    rates: dict[int, float] = field(default_factory=dict)
    commands: list[tuple[int, float]] = field(default_factory=list)
    received: dict[str, list[Any]] = field(default_factory=lambda: defaultdict(list))

    def __post_init__(self) -> None:
        self.encoder, self.decoder = Encoder(self.system_id, 1), Decoder(datagrams=True)
        self.next: dict[int, float] = defaultdict(float)
        self.out: list[bytes] = []

    def send(self, message: Any) -> None:
        self.out.append(self.encoder.encode(message))

    def receive(self, frame: bytes, now_s: float) -> None:
        for message in self.decoder.feed(frame):
            self.received[message.get_type()].append(message)
            if message.get_type() == "COMMAND_LONG" and not self.deaf:
                message_id = int(message.param1)
                self.commands.append((message_id, message.param2))
                result = 4 if message_id in self.refuses else 0
                if not result:
                    self.rates[message_id] = 1e6 / message.param2
                self.send(mavlink.MAVLink_command_ack_message(message.command, result, 0, 0, 1, 197))
            elif message.get_type() == "TIMESYNC" and not message.tc1 and self.answers_timesync:
                self.send(mavlink.MAVLink_timesync_message(round((now_s - self.boot_s) * 1e9), message.ts1))

    def step(self, now_s: float) -> list[bytes]:
        boot_s = now_s - self.boot_s
        for message_id, rate_hz in {0: 1.0, **self.rates}.items():
            if now_s >= self.next[message_id]:
                self.next[message_id] = (self.next[message_id] or now_s) + 1 / rate_hz
                self.stream(message_id, boot_s)
        out, self.out = self.out, []
        return out

    def stream(self, message_id: int, boot_s: float) -> None:
        ms, us = int(boot_s * 1e3), int(boot_s * 1e6)
        if message_id == 0:
            self.send(mavlink.MAVLink_heartbeat_message(2, self.autopilot, 0, 0, 4, 3))
        elif message_id == HIGHRES:
            self.send(mavlink.MAVLink_highres_imu_message(us, 0, 0, -9.8, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x1FFF))
        elif message_id == RAW:
            self.send(mavlink.MAVLink_raw_imu_message(us, 0, 0, -1000, 0, 0, 0, 0, 0, 0))
        elif message_id == QUATERNION:
            self.send(mavlink.MAVLink_attitude_quaternion_message(ms, 1, 0, 0, 0, 0, 0, 0))
        elif message_id == 24:
            place = (3, 470001000, 80002000, 410_000, 80, 120, 0, 0, 12, 450_000, 300, 500, 200)
            self.send(mavlink.MAVLink_gps_raw_int_message(us, *place))
        elif message_id == 2:
            self.send(mavlink.MAVLink_system_time_message(0, ms))


@pytest.fixture
def make_config() -> Callable[..., FleetConfig]:
    return fleet_config


@pytest.fixture
def virtual_fleet() -> type[VirtualFleet]:
    return VirtualFleet


@pytest.fixture
def virtual_autopilot() -> type[VirtualAutopilot]:
    return VirtualAutopilot


@pytest.fixture
def config_of(make_config: Callable[..., FleetConfig], tmp_path: Path) -> Callable[..., FleetConfig]:
    """A fleet on free ports, whose agents start at once."""

    def make(count: int, *overrides: str) -> FleetConfig:
        udp, tcp = free_ports(socket.SOCK_DGRAM, count), free_ports(socket.SOCK_STREAM, count)
        own: list[str] = ["initial.position_m=[0.0, 0.0, -5.0]", f"record.directory={tmp_path / 'rec'}"]
        for i in range(count):
            own.append(f"agents.{i + 1}.mavlink=udpin:{HOST}:{udp[i]}")
            own.append(f'agents.{i + 1}.listen=["tcp/{HOST}:{tcp[i]}"]')
        if count > 1:
            own.append(f'agents.2.connect=["tcp/{HOST}:{tcp[0]}"]')
        return make_config(count, *own, *overrides)

    return make
