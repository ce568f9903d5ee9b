"""A study input flown by the drones' own agents: real packets, rounds, deadlines and sizes in virtual time.

The sensors say what the input holds for each tick, at the tick's start: fixes and ranges; accelerations as the IMU of
a level drone. Every agent begins at the first tick with its own first estimate of the input. Between the agents is
`agent.onboard.OnboardAgent`'s own exchange over a modelled radio (`sim_bridge.studies.air`).
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from agent.sensing.samples import AttitudeSample, GpsSample, ImuSample, Sample
from estimators.estimator import Estimate, Estimator, Status
from estimators.factory import make_estimator
from estimators.model.layout import Layout
from estimators.model.measurements import Matrix, Vector
from estimators.settings import EstimatorSettings
from sim_bridge.studies.air import Air
from sim_bridge.studies.lockstep import LockstepResult, StudyEstimates
from sim_bridge.studies.study_input import StudyInput
from sim_bridge.virtual.event_queue import EventQueue
from sim_bridge.virtual.virtual_fleet import VirtualDrone, VirtualFleet
from transport.messages.measurement_body import Measurements
from transport.messages.uwb_body import UwbFrame, UwbRange
from transport.security.auth import Identity
from transport.security.sealing import Message

Bools = NDArray[np.bool_]

FIRST_TICK = 1000
"""Fleet tick of the input's first one."""
WIRE_S = 0.001
"""From a sensor to its agent."""
EDGE_S = 1e-6
"""How close to a tick's ends the IMU is sampled: an acceleration that jumps there is averaged as one that does."""
IMU_SPACING_S = 0.04
GRAVITY_MPS2 = 9.80665
LINGER_TICKS = 2.0
"""The agents get so much more than the input, for the estimate of its last tick."""


@dataclass(frozen=True, slots=True)
class FlownResult:
    """What the agents of a run published.

    ``estimates`` as from a run in lockstep; a tick without an estimate holds the agent's last one before it (its
    first estimate of the input before there was any) and counts as not ``available`` ``(T+1, n)``. ``bytes_per_s`` of
    all packets that an agent put on the air, mean over agents, by kind and in all; ``heard`` ``(T+1, n, T+1, n)``: by
    the estimate of a tick, which agent could know the records of which tick and owner, had every packet of records
    carried all that its sender knew (`KnowledgeTap`).
    """

    estimates: LockstepResult
    available: Bools
    bytes_per_s: dict[str, float]
    heard: Bools


class KnowledgeTap:
    """Follows who could know whose records of which tick, had packets of records carried all that was known."""

    def __init__(self, recording: StudyInput) -> None:
        self._agents = tuple(int(a) for a in recording.agents)
        ticks, n = recording.ticks + 1, len(self._agents)
        self._known = np.zeros((n, ticks, n), np.bool_)
        self.heard = np.zeros((ticks, n, ticks, n), np.bool_)
        self.bytes: Counter[str] = Counter()

    def on_sent(self, sender: int, message: Message, size_bytes: int) -> Any:
        """Records go with all that is known; other packets carry none."""
        self.bytes[type(message).__name__] += size_bytes
        if not isinstance(message, Measurements):
            return None
        slot = self._agents.index(sender)
        tick = message.tick - FIRST_TICK
        if 0 <= tick < self._known.shape[1]:
            self._known[slot, tick, slot] = True
        return self._known[slot].copy()

    def on_heard(self, receiver: int, sent: Any) -> None:
        """A packet arrived."""
        if sent is not None:
            self._known[self._agents.index(receiver)] |= sent

    def on_estimate(self, agent_id: int, tick: int) -> None:
        """An agent's estimate of a tick is out: what it could know by then."""
        slot = self._agents.index(agent_id)
        self.heard[tick, slot] = self._known[slot]


@dataclass(slots=True)
class _Sensors:
    """What one drone's sensors say, tick by tick."""

    recording: StudyInput
    slot: int

    def samples(self, tick: int, t_s: float) -> list[Sample]:
        """Attitude, IMU and fix of the tick that begins at ``t_s``."""
        recording, slot = self.recording, self.slot
        accel = recording.accel[min(tick, recording.ticks - 1), slot]
        force = (float(accel[0]), float(accel[1]), float(accel[2]) - GRAVITY_MPS2)
        count = max(2, math.ceil(recording.period_s / IMU_SPACING_S) + 1)
        found: list[Sample] = []
        for at_s in np.linspace(t_s + EDGE_S, t_s + recording.period_s - EDGE_S, count).tolist():
            found.append(AttitudeSample(at_s, (1.0, 0.0, 0.0, 0.0)))
            found.append(ImuSample(at_s, force, (0.0, 0.0, 0.0)))
        fix = recording.gps[tick, slot]
        if np.isfinite(fix[:3]).all():
            place = (float(fix[0]), float(fix[1]), float(fix[2]))
            speed = float(fix[3]) if np.isfinite(fix[3]) else None
            found.append(GpsSample(t_s, place, 1.0, 1.0, None, speed, 1.0, 3))
        return found

    def ranges(self, tick: int) -> tuple[UwbRange, ...]:
        """Those of a tick."""
        row = self.recording.ranges[tick, self.slot]
        agents = self.recording.agents
        return tuple(UwbRange(int(agents[other]), float(row[other])) for other in np.flatnonzero(np.isfinite(row)))


@dataclass(slots=True)
class _FirstEstimate:
    """Makes an agent's estimator; the first one begins with the input's first estimate."""

    mean: Vector
    covariance: Matrix
    used: bool = field(default=False)

    def __call__(
        self,
        settings: EstimatorSettings,
        layout: Layout,
        slot: int,
        mean: Vector,
        covariance: Matrix,
        period_s: float,
    ) -> Estimator:
        if not self.used and len(mean) == len(self.mean):
            mean, covariance, self.used = self.mean, self.covariance, True
        return make_estimator(settings, layout, slot, mean, covariance, period_s)


def fly_recording(
    recording: StudyInput,
    settings: EstimatorSettings,
    air: Air | None = None,
    *,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> FlownResult:
    """Fly a study input; ``seed`` is of the channels. Results repeat bit by bit."""
    return _FlownRun(recording, settings, air or Air(), seed, progress).fly()


def config_of(recording: StudyInput, settings: EstimatorSettings) -> FleetConfig:
    """The configuration of a fleet that flies an input: its sensors' bounds, its edges, nobody to sign."""
    ids = [int(agent) for agent in recording.agents]
    if recording.rows is not None:
        raise ValueError("rows: expected a study input of version 1, whose measurements agents can fly with")
    half = recording.gps_half_width
    if not half[0] == half[1] == half[2]:
        raise ValueError(f"gps_half_width: expected one bound for all axes, found {half[:3].tolist()}")
    document: dict[str, Any] = {
        "fleet": {
            "name": "study",
            "period_s": recording.period_s,
            "origin": {"lat_deg": 0.0, "lon_deg": 0.0, "alt_m": 0.0},
            "edges": [[ids[a], ids[b]] for a, b in recording.edges.tolist()],
        },
        "agents": [{"id": agent, "mavlink": f"udpin:127.0.0.1:{14550 + agent}"} for agent in ids],
        "estimator": msgspec.to_builtins(settings),
        "sensors": {
            "gps_position_half_width_m": float(half[0]),
            "gps_speed": "norm",
            "gps_speed_half_width_mps": float(half[3]),
            "uwb_bound_m": recording.range_half_width,
            "accel_sigma_mps2": recording.accel_half_width / math.sqrt(3.0),
            "gravity_mps2": GRAVITY_MPS2,
            "imu_latency_s": 0.0,
            "gps_latency_s": 0.0,
        },
        "initial": {"position_m": [0.0, 0.0, 0.0]},
        "security": {"mode": "unsigned"},
    }
    document["estimator"] = {key: value for key, value in document["estimator"].items() if value is not None}
    return config_from(document, "study")


class _FlownRun:
    """One flight."""

    def __init__(
        self,
        recording: StudyInput,
        settings: EstimatorSettings,
        air: Air,
        seed: int,
        progress: Callable[[int], None] | None,
    ) -> None:
        self._recording, self._progress = recording, progress
        self._period_s = recording.period_s
        self._start_s = FIRST_TICK * self._period_s
        config = config_of(recording, settings)
        self._queue = EventQueue(self._start_s)
        self._tap = KnowledgeTap(recording)
        epoch_s = config.fleet.epoch_unix_s
        self._fleet = VirtualFleet(config, self._queue, self._on_estimate, unix_offset_s=epoch_s, tap=self._tap)
        ids = config.ids
        self._drones = []
        for slot, agent_id in enumerate(ids):
            first = _FirstEstimate(recording.x0[slot], recording.P0)
            agent = OnboardAgent(config, agent_id, first, Identity(), unix_s=epoch_s, host_s=0.0, linked=False)
            channel = air.channel(slot, ids, self._period_s, self._start_s, seed)
            self._drones.append(VirtualDrone(agent, channel))
        self._slots = {agent_id: slot for slot, agent_id in enumerate(ids)}
        shape = recording.ticks + 1, len(ids)
        self._last = [self._before(slot) for slot in range(len(ids))]
        self._available = np.zeros(shape, np.bool_)
        self._record = StudyEstimates(recording, centralised=False)
        self._written = np.zeros(len(ids), int)

    def _before(self, slot: int) -> Estimate:
        """What an agent has before its first estimate."""
        recording = self._recording
        ages = np.zeros(len(recording.agents), np.int64)
        return Estimate(0, recording.x0[slot], recording.P0, Status.NO_DATA, ages)

    def fly(self) -> FlownResult:
        """All of it."""
        for drone in self._drones:
            self._fleet.join(drone)
        for tick in range(self._recording.ticks + 1):
            t_s = self._start_s + tick * self._period_s
            self._queue.at(t_s + WIRE_S, functools.partial(self._sense, tick, t_s))
        end_s = self._start_s + (self._recording.ticks + 1 + LINGER_TICKS) * self._period_s
        self._queue.run_until(end_s)
        for slot in range(len(self._drones)):
            self._fill(slot, self._recording.ticks + 1)
        duration_s = (self._recording.ticks + 1) * self._period_s
        share = 1.0 / (duration_s * len(self._drones))
        rates = {name: count * share for name, count in sorted(self._tap.bytes.items())}
        return FlownResult(
            self._record.result([_dropped(drone) for drone in self._drones]),
            self._available,
            {**rates, "all": sum(rates.values())},
            self._tap.heard,
        )

    def _sense(self, tick: int, t_s: float) -> None:
        now_s = self._queue.now_s
        for slot, drone in enumerate(self._drones):
            sensors, agent = _Sensors(self._recording, slot), drone.agent
            for sample in sensors.samples(tick, t_s):
                agent.on_sample(sample, now_s)
            ranges = sensors.ranges(tick)
            if ranges:
                agent.on_uwb_frame(UwbFrame(tick + 1, "unix", 0, ranges, agent.agent_id), now_s - t_s, now_s)
        if self._progress is not None:
            self._progress(tick)

    def _on_estimate(self, agent: OnboardAgent, ready: EstimateReady) -> None:
        tick, slot = ready.estimate.tick - FIRST_TICK, self._slots[agent.agent_id]
        if not 0 <= tick <= self._recording.ticks:
            return
        self._tap.on_estimate(agent.agent_id, tick)
        if agent.core.fleet.started:
            self._fill(slot, tick)
            self._last[slot] = ready.estimate
            self._available[tick, slot] = ready.on_time
            self._fill(slot, tick + 1)

    def _fill(self, slot: int, until: int) -> None:
        """Put down the last estimate for every tick up to ``until`` that has none yet."""
        for tick in range(int(self._written[slot]), until):
            self._record.add(tick, slot, self._last[slot])
        self._written[slot] = max(self._written[slot], until)


def _dropped(drone: VirtualDrone) -> int:
    """Rows and inputs that came too late for the window."""
    return drone.agent.core.fleet.dropped
