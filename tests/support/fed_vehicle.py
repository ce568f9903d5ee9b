"""One simulated vehicle whose autopilot is fed by a stand-in for the estimator: the truth, late and noisy.

Session, feeder and fake autopilot are the real ones, with bytes between them. What integrity says and what goes wrong
on the way, the test decides.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from agent.config.reading import config_from
from agent.feedback.feeder import FedAutopilot, Ready
from agent.feedback.gatekeeper import FeedPhase
from agent.mavlink.codec import Message
from agent.mavlink.session import LinkState
from agent.onboard import OnboardAgent
from agent.sensing.frames import FleetFrame
from agent.sensing.samples import AttitudeSample, GpsSample
from estimators.estimator import Status
from estimators.factory import make_estimator
from estimators.integrity.protection.levels import ProtectionLevel
from estimators.integrity.protection.statement import IntegrityState
from estimators.model.measurements import Vector
from sim_bridge.autopilot.fake_autopilot import FakeAutopilot
from sim_bridge.autopilot.flavours import FlightMode
from sim_bridge.world.guidance import Waypoints
from sim_bridge.world.noise import FlavourName
from sim_bridge.world.scenario import Interval, Scenario, Vehicle
from sim_bridge.world.simulation import Simulation
from tests.support.statements import statement
from transport.security.auth import Identity

START_S, EPOCH_UNIX_S = 1000.0, 1_767_225_600.0
AGE_S, PERIOD_S, SERVICE_S = 0.15, 0.1, 0.05
SQUARE = ((0.0, 0.0, -10.0), (20.0, 0.0, -10.0), (20.0, 20.0, -10.0), (0.0, 20.0, -10.0))
LOST_AFTER_S = 0.8


@dataclass
class Noted:
    """What was true at one estimate."""

    at_s: float
    error_m: Vector
    """Of the autopilot's position, NED."""
    phase: FeedPhase
    mode: FlightMode
    findings: tuple[str, ...]


@dataclass
class FedVehicle:
    """In a square at 2.5 m/s, its GPS away during ``outage_s``; times since the start.

    ``judged`` says what integrity makes of the estimate at a time, ``off_m`` how far it is off, ``spoil`` changes
    messages for the autopilot, ``alive`` whether the daemon lives.
    """

    flavour: FlavourName = "px4"
    outage_s: tuple[float, float] = (12.0, 30.0)
    feedback: dict[str, Any] = field(default_factory=dict)
    parameters: dict[str, float] = field(default_factory=dict)
    faults: tuple[Any, ...] = ()
    seed: int = 1
    system_id: int = 1
    judged: Callable[[float], IntegrityState] = lambda _at_s: IntegrityState.NOMINAL
    off_m: Callable[[float], Sequence[float]] = lambda _at_s: (0.0, 0.0, 0.0)
    fixes_off_m: Callable[[float], float | None] = lambda _at_s: None
    """By how much integrity finds its own fixes to be off at a time."""
    spoil: Callable[[Message, float], Message | None] = lambda message, _at_s: message
    alive: Callable[[float], bool] = lambda _at_s: True
    heard: Callable[[Message], Message] = lambda message: message
    """Changes what the feeder hears of the autopilot."""
    period_s: float = PERIOD_S
    age_s: float = AGE_S
    sigma_m: float = 0.2
    noted: list[Noted] = field(default_factory=list)
    sent: list[tuple[float, Message]] = field(default_factory=list)
    flown: list[tuple[float, bool, FlightMode]] = field(default_factory=list)
    """At every step of the world: whether the autopilot has a position, and its mode."""

    def __post_init__(self) -> None:
        document = {
            "fleet": {
                "name": "fed",
                "origin": {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 400.0},
                "epoch_unix_s": EPOCH_UNIX_S,
            },
            "agents": [{"id": 1, "mavlink": "udpin:127.0.0.1:14561", "system_id": self.system_id}],
            "sensors": {"gps_latency_s": 0.0, "imu_latency_s": 0.0},
            "feedback": {"kind": "odometry", "switch_source": True, **self.feedback},
        }
        self.config = config_from(document, "test")
        scenario = Scenario(
            vehicles=(Vehicle(1, self.flavour, 1, Waypoints(SQUARE, 8.0, True), start_m=SQUARE[0]),),
            frame=FleetFrame.of(self.config),
            seed=self.seed,
            profile="realistic",
            epoch_unix_s=EPOCH_UNIX_S,
            gps_hz=5.0,
            fusing=True,
            start_speed_half_width_mps=0.0,
            gps_outages=(Interval(1, *self.outage_s),),
            faults=self.faults,
        )
        offset_s = EPOCH_UNIX_S - START_S
        self.simulation = Simulation(scenario, START_S, offset_s)
        for name, value in self.parameters.items():
            as_bytes = struct.unpack("<f", struct.pack("<i", int(value)))[0]
            _, integer = self.autopilot.state.parameters.encoded(name)
            encoded = as_bytes if integer and self.flavour == "px4" else value
            assert self.autopilot.state.parameters.store(name, encoded)
        if self.parameters:
            self.autopilot.reboot(START_S, 0.0)
        agent = OnboardAgent(self.config, 1, make_estimator, Identity(), unix_s=EPOCH_UNIX_S, host_s=START_S)
        assert agent.feeder is not None
        self.session, self.feeder = agent.autopilot, agent.feeder  # its core is what the stand-in stands in for
        self.session.follower = lambda message, t_s, host_s: self.feeder.on_message(self.heard(message), t_s, host_s)
        self._rng = np.random.default_rng(self.seed)
        self._truth: list[tuple[float, Vector, Vector]] = []
        self._fix_s = -np.inf
        self._quaternion = (1.0, 0.0, 0.0, 0.0)
        self._next_s = {"serve": 0.0, "estimate": self.age_s}

    @property
    def autopilot(self) -> FakeAutopilot:
        """The fake one."""
        return self.simulation.autopilots[1]

    def fly(self, until_s: float) -> FedVehicle:
        """Go on until a time since the start."""
        while (now_s := self.simulation.next_step_s() - START_S) <= until_s:
            frames = [frame for _, frame in self.simulation.advance(START_S + now_s).frames]
            world = self.simulation.world
            self._truth.append((now_s, world.position_m[0].copy(), world.velocity_mps[0].copy()))
            state = self.autopilot.state
            self.flown.append((now_s, state.navigation.aided(START_S + now_s), state.mode))
            if not self.alive(now_s):
                continue
            self._hear(b"".join(frames), now_s)
            if now_s >= self._next_s["serve"]:
                self._next_s["serve"] += SERVICE_S
                asked = self.feeder.to_send(self._link(), START_S + now_s)
                self._give(self.session.to_send(START_S + now_s, 4), now_s)
                self._give([self.session.encode(each) for each in asked], now_s)
            if now_s >= self._next_s["estimate"]:
                self._next_s["estimate"] += self.period_s
                self._estimate(now_s)
        return self

    def errors_m(self, from_s: float, to_s: float) -> Vector:
        """Horizontal errors of the autopilot in an interval."""
        return np.array([np.hypot(*n.error_m[:2]) for n in self.noted if from_s <= n.at_s < to_s])

    def step_m(self, from_s: float, to_s: float) -> float:
        """Largest horizontal change of the autopilot's error between two estimates of an interval: a step of its own
        position, since in a tenth of a second it drifts by centimetres."""
        errors_m = np.array([n.error_m[:2] for n in self.noted if from_s <= n.at_s < to_s])
        return float(np.hypot(*np.diff(errors_m, axis=0).T).max())

    def phases(self, from_s: float, to_s: float) -> set[FeedPhase]:
        """Those of an interval."""
        return {n.phase for n in self.noted if from_s <= n.at_s < to_s}

    def first_said(self, text: str, from_s: float = 0.0) -> float:
        """When something was found first; infinite if never."""
        said = (n.at_s for n in self.noted if n.at_s >= from_s and any(text in f for f in n.findings))
        return min(said, default=np.inf)

    def _link(self) -> FedAutopilot:
        autopilot = self.session.autopilot
        if autopilot is None:
            return FedAutopilot(False, "", 0, 0)
        connected = self.session.state is LinkState.CONNECTED
        return FedAutopilot(connected, autopilot.flavour, autopilot.system_id, autopilot.component_id)

    def _hear(self, data: bytes, now_s: float) -> None:
        for sample in self.session.receive(data, START_S + now_s) if data else []:
            self.feeder.on_sample(sample)
            if isinstance(sample, GpsSample):
                self._fix_s = now_s
            elif isinstance(sample, AttitudeSample):
                self._quaternion = sample.quaternion

    def _give(self, frames: list[bytes], now_s: float) -> None:
        for frame in frames:
            self._hear(b"".join(self.simulation.receive(1, frame, START_S + now_s)), now_s)

    def _estimate(self, now_s: float) -> None:
        t_s = now_s - self.age_s
        _, position, velocity = min(self._truth[-60:], key=lambda each: abs(each[0] - t_s))
        noise = self._rng.normal(0.0, 0.1, 6)
        mean = np.concatenate((position + noise[:3] + self.off_m(now_s), velocity + noise[3:]))
        state, off_m = self.judged(now_s), self.fixes_off_m(now_s)
        level = ProtectionLevel(3.7 * self.sigma_m, 3.3 * self.sigma_m)
        host_s = START_S + t_s
        ahead_s = 0.0 if self.session.reads_stamps else self.age_s
        stamp_s = host_s + ahead_s if self.flavour == "px4" else self.session.clock.boot_s(host_s)
        ready = Ready(
            t_s,
            now_s,
            EPOCH_UNIX_S + t_s,
            mean,
            np.eye(6) * self.sigma_m**2,
            Status.OK,
            replace(statement(state, level, 0.6), off={} if off_m is None else {1: off_m}),
            self._quaternion,
            None if stamp_s is None or stamp_s < 0 else round(stamp_s * 1e6),
            self.session.samples.without_fix or now_s - self._fix_s > LOST_AFTER_S,
            ahead_s,
        )
        self.feeder.on_life(self._link(), (self.session.reboots, self.session.handovers))
        for message in self.feeder.on_estimate(ready, self._link(), START_S + now_s):
            spoiled = self.spoil(message, now_s)
            if spoiled is not None:
                self.sent.append((now_s, spoiled))
                self._give([self.session.encode(spoiled)], now_s)
        findings = tuple(f"{each.what.name} {each.detail}" for each in self.feeder.findings())
        navigation, world = self.autopilot.state.navigation, self.simulation.world
        error_m = navigation.position_m - world.position_m[0]
        self.noted.append(Noted(now_s, error_m, self.feeder.verdict.phase, self.autopilot.state.mode, findings))


def with_fields(message: Message, **fields: Any) -> Message:
    """A message with other fields."""
    for name, value in fields.items():
        setattr(message, name, value)
    return message


