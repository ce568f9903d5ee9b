"""A scenario of situational awareness (`sim_bridge.studies.awareness`) flown by the drones' own agents, virtually."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from agent.config.reading import config_from
from agent.config.tables import FleetConfig
from agent.onboard import OnboardAgent
from agent.outputs import EstimateReady
from agent.sensing.samples import AttitudeSample, GpsSample, ImuSample, Sample
from estimators.estimator import Status
from estimators.factory import make_estimator
from estimators.integrity.consistency import nees
from estimators.settings import EstimatorSettings
from sim_bridge.studies.awareness import (
    ACCEL_SIGMA_MPS2,
    DRONES,
    EDGES,
    FAILING,
    GPS_SIGMA_M,
    PERIOD_S,
    RANGE_SIGMA_M,
    SPEED_SIGMA_MPS,
    TARGET_ID,
    TARGET_SIGMA_M,
    AwarenessInput,
)
from sim_bridge.virtual.event_queue import EventQueue
from sim_bridge.virtual.virtual_fleet import Parcel, VirtualDrone, VirtualFleet
from transport.link.channel import Channel, ChannelSettings, LinkFaults, Outage
from transport.messages.uwb_body import UwbFrame, UwbRange
from transport.security.auth import Identity

Floats = NDArray[np.float64]

FIRST_TICK = 1000
WIRE_S = 0.001
"""From a sensor to its agent."""
IMU_SPACING_S = 0.04
EDGE_S = 1e-6
GRAVITY_MPS2 = 9.80665
LINGER_TICKS = 2.0
KEPT_S = 60.0
"""Drones beyond a link that fails are kept in mind for longer than any outage."""


@dataclass(frozen=True, slots=True)
class AwarenessFlight:
    """What agents said: arrays over ticks, agents that say it, and bodies it is about.

    ``error_m`` ``(T+1, n, B)`` of the position, infinite where a body was no part of the estimate; ``nees``
    ``(T+1, n, B)`` of the position over its dimension; ``ok`` ``(T+1, n)``: a tick had an estimate in time, with the
    status OK. ``bias_m`` ``(T+1, n)``: by how much the target's sensor is off; NaN where nothing is known.
    """

    error_m: Floats
    nees: Floats
    ok: NDArray[np.bool_]
    bias_m: Floats


def config_of(measured: AwarenessInput, settings: EstimatorSettings) -> FleetConfig:
    """The configuration of the fleet that flies a scenario."""
    document: dict[str, Any] = {
        "fleet": {
            "name": "study",
            "period_s": PERIOD_S,
            "origin": {"lat_deg": 0.0, "lon_deg": 0.0, "alt_m": 0.0},
            "edges": [list(edge) for edge in EDGES[measured.scenario.graph]],
            "absent_after_s": KEPT_S,
        },
        "agents": [{"id": each, "mavlink": f"udpin:127.0.0.1:{14550 + each}"} for each in range(1, DRONES + 1)],
        "estimator": {k: v for k, v in msgspec.to_builtins(settings).items() if v is not None},
        "sensors": {
            "gps_speed": "horizontal",
            "uwb_sigma_m": RANGE_SIGMA_M,
            "accel_sigma_mps2": ACCEL_SIGMA_MPS2,
            "gravity_mps2": GRAVITY_MPS2,
            "imu_latency_s": 0.0,
            "gps_latency_s": 0.0,
        },
        "security": {"mode": "unsigned"},
    }
    if measured.scenario.target is not None:
        moves = any(measured.scenario.target[3:])
        document["targets"] = [{"id": TARGET_ID, "motion": "moving" if moves else "fixed"}]
    return config_from(document, "study")


def fly_awareness(
    measured: AwarenessInput, settings: EstimatorSettings, *, loss: float = 0.0, seed: int = 0
) -> AwarenessFlight:
    """Fly a scenario; ``loss`` of every packet, ``seed`` of the channels. Results repeat bit by bit."""
    return _Flight(measured, config_of(measured, settings), loss, seed).fly()


class _Flight:
    """One flight."""

    def __init__(self, measured: AwarenessInput, config: FleetConfig, loss: float, seed: int) -> None:
        self._measured = measured
        self._start_s = FIRST_TICK * PERIOD_S
        self._queue = EventQueue(self._start_s)
        epoch_s = config.fleet.epoch_unix_s
        self._fleet = VirtualFleet(config, self._queue, self._on_estimate, unix_offset_s=epoch_s)
        self._drones = []
        for each in config.ids:
            agent = OnboardAgent(config, each, make_estimator, Identity(), unix_s=epoch_s, host_s=0.0, linked=False)
            channel = self._channel(each, config.neighbours(each), loss, seed)
            self._drones.append(VirtualDrone(agent, channel))
        shape = *measured.ranges.shape[:2], measured.truth.shape[1]
        self._error_m, self._nees = np.full(shape, np.inf), np.full(shape, np.nan)
        self._ok = np.zeros(shape[:2], np.bool_)
        self._bias_m = np.full(shape[:2], np.nan)

    def _channel(self, receiver: int, neighbours: tuple[int, ...], loss: float, seed: int) -> Channel[Parcel]:
        # a packet of tick k goes out when the tick has ended
        spans = self._measured.scenario.outages
        outages = tuple(Outage(self._start_s + a + PERIOD_S, self._start_s + b + PERIOD_S) for a, b in spans)
        faults = {
            each: LinkFaults(loss=loss, outages=outages if _fails(receiver, each) else ()) for each in neighbours
        }
        settings = ChannelSettings(per_neighbour={str(each): fault for each, fault in faults.items()})
        return Channel.seeded(settings, seed=seed, receiver=receiver, neighbours=faults)

    def fly(self) -> AwarenessFlight:
        """All of it."""
        for drone in self._drones:
            self._fleet.join(drone)
        ticks = self._measured.scenario.ticks
        for tick in range(ticks + 1):
            t_s = self._start_s + tick * PERIOD_S
            self._queue.at(t_s + WIRE_S, functools.partial(self._sense, tick, t_s))
        self._queue.run_until(self._start_s + (ticks + 1 + LINGER_TICKS) * PERIOD_S)
        return AwarenessFlight(self._error_m, self._nees, self._ok, self._bias_m)

    def _sense(self, tick: int, t_s: float) -> None:
        now_s = self._queue.now_s
        for slot, drone in enumerate(self._drones):
            for sample in self._samples(tick, t_s, slot):
                drone.agent.on_sample(sample, now_s)
            frame = UwbFrame(tick + 1, "unix", 0, self._ranges(tick, slot), drone.agent.agent_id)
            if frame.ranges:
                drone.agent.on_uwb_frame(frame, now_s - t_s, now_s)

    def _samples(self, tick: int, t_s: float, slot: int) -> list[Sample]:
        """Attitude and IMU of a level drone, and the fix of the tick that begins at ``t_s``."""
        accel = self._measured.accel[min(tick, len(self._measured.accel) - 1), slot]
        force = (float(accel[0]), float(accel[1]), float(accel[2]) - GRAVITY_MPS2)
        found: list[Sample] = []
        for at_s in np.arange(t_s + EDGE_S, t_s + PERIOD_S, IMU_SPACING_S).tolist():
            found.append(AttitudeSample(at_s, (1.0, 0.0, 0.0, 0.0)))
            found.append(ImuSample(at_s, force, (0.0, 0.0, 0.0)))
        north, east, down, v_north, v_east, _ = self._measured.gps[tick, slot].tolist()
        found.append(
            GpsSample(t_s, (north, east, down), GPS_SIGMA_M, GPS_SIGMA_M, (v_north, v_east), None, SPEED_SIGMA_MPS, 3)
        )
        return found

    def _ranges(self, tick: int, slot: int) -> tuple[UwbRange, ...]:
        row = self._measured.ranges[tick, slot]
        return tuple(
            UwbRange(
                body + 1 if body < DRONES else TARGET_ID,
                float(row[body]),
                sigma_m=RANGE_SIGMA_M if body < DRONES else TARGET_SIGMA_M,
            )
            for body in np.flatnonzero(np.isfinite(row)).tolist()
        )

    def _on_estimate(self, agent: OnboardAgent, ready: EstimateReady) -> None:
        estimate = ready.estimate
        tick, slot = estimate.tick - FIRST_TICK, agent.agent_id - 1
        if not 0 <= tick <= self._measured.scenario.ticks or not agent.core.fleet.started:
            return
        present, biases = agent.core.fleet.present, agent.core.fleet.range_biases
        if biases is not None and TARGET_ID in present:
            self._bias_m[tick, slot] = biases.target_m[present.index(TARGET_ID)]
        self._ok[tick, slot] = ready.on_time and estimate.status is Status.OK
        for body, at in enumerate(agent.core.layout.agents):
            if at in present:
                place = slice(6 * body, 6 * body + 3)
                error = estimate.mean[place] - self._measured.truth[tick, body, :3]
                self._error_m[tick, slot, body] = np.linalg.norm(error)
                self._nees[tick, slot, body] = nees(error, estimate.covariance[place, place]) / 3.0


def _fails(one: int, other: int) -> bool:
    return (one, other) in FAILING or (other, one) in FAILING
