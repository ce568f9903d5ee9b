"""The sensors of a simulated fleet without its autopilots: samples as values, no bytes, no handshakes.

For studies in virtual time that ask about the estimate and not about the wires. The world, the sensors and
their noise are those of the simulation; what is left out is encoding with its rounding, clock
synchronisation and everything an autopilot says besides its sensors. Sans-I/O.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from agent.mavlink.session import PRESSURE_HZ
from agent.sensing.barometer import pressure_altitude_m
from agent.sensing.samples import AttitudeSample, BaroSample, ImuSample, VelocitySample
from sim_bridge.autopilot.mavlink_wire import gps_raw_int
from sim_bridge.companions.camera import SIGMA_MPS
from sim_bridge.companions.target_camera import SensedDetections
from sim_bridge.world.sensors import SensedImu, SensedRanges, quaternion_of, vector_of
from sim_bridge.world.simulation import Simulation
from sim_bridge.world.truth import Truth, TruthRecorder
from sim_bridge.world.unaided import AIDED_S, UnaidedTilt

GRID_TOLERANCE = 1e-6


@dataclass(slots=True)
class Sensed:
    """What left the sensors in one step: samples and GPS_RAW_INT messages by agent, range sets, detections.

    A fix stays a message since the agent makes its variances of what the receiver says.
    """

    samples: list[tuple[int, ImuSample | AttitudeSample | BaroSample | VelocitySample]] = field(default_factory=list)
    fixes: list[tuple[int, Any]] = field(default_factory=list)
    ranges: list[SensedRanges] = field(default_factory=list)
    detections: list[SensedDetections] = field(default_factory=list)


class _StepGrid:
    """Which steps a sensor of a rate falls on."""

    def __init__(self, rate_hz: float, step_s: float) -> None:
        self._per_step = rate_hz * step_s
        self._taken = 0

    def due(self, step: int) -> bool:
        count = int(step * self._per_step + GRID_TOLERANCE)
        due, self._taken = count > self._taken, count
        return due


class SensorFeed:
    """Steps the world of a simulation in its place.

    ``imu_hz`` and ``attitude_hz`` are the rates asked for; a sensor gives at most its own. Samples are in fleet
    time, which is ``start_fleet_s`` at the start; stamps of messages count from the start.
    """

    def __init__(self, simulation: Simulation, imu_hz: float, attitude_hz: float, start_fleet_s: float) -> None:
        self._simulation = simulation
        self._start_fleet_s = start_fleet_s
        scenario, step_s = simulation.scenario, simulation.world.step_s
        self._imu = _StepGrid(min(imu_hz, scenario.imu_hz), step_s)
        self._attitude = _StepGrid(min(attitude_hz, scenario.attitude_hz), step_s)
        self._pressure = _StepGrid(PRESSURE_HZ, step_s)
        self._attitude_period_s = 1.0 / min(attitude_hz, scenario.attitude_hz)
        self._tilts = [UnaidedTilt() for _ in scenario.ids]
        self._aided_until_s: list[float | None] = [None for _ in scenario.ids]
        """World time; nothing before the first fix."""
        self._truth_every = max(round(1.0 / (scenario.truth_hz * step_s)), 1)
        bodies = (*scenario.ids, *(target for target, _ in scenario.targets))
        self._recorder = TruthRecorder(bodies, simulation.sensors.pair_bias_m)
        self._record()

    def step(self) -> Sensed:
        """Move the world by one step."""
        world, sensors, scenario = self._simulation.world, self._simulation.sensors, self._simulation.scenario
        world.step()
        if world.step_index % self._truth_every == 0:
            self._record()
        sensed = Sensed(ranges=sensors.ranges(), detections=self._simulation.detections())
        t_s = self._start_fleet_s + world.time_s
        imu_due, attitude_due = self._imu.due(world.step_index), self._attitude.due(world.step_index)
        pressure_due = imu_due and self._pressure.due(world.step_index)
        for slot, agent_id in enumerate(scenario.ids):
            if attitude_due:
                sensed.samples.append((agent_id, self._attitude_sample(slot, t_s)))
            if imu_due:
                imu = sensors.imu(slot)
                sample = ImuSample(t_s, vector_of(imu.accel_mps2), vector_of(imu.gyro_rps))
                sensed.samples.append((agent_id, sample))
                # PX4 has the pressure in each HIGHRES_IMU, ArduPilot in messages of its own
                if pressure_due or scenario.vehicles[slot].flavour == "px4":
                    sensed.samples += [(agent_id, baro) for baro in _height(imu, t_s)]
        for slot, companion in enumerate(self._simulation.companions):
            velocity = companion.camera.velocity(world.time_s, world.velocity_mps[slot], world.attitude()[slot])
            if velocity is not None:
                spread = (SIGMA_MPS, SIGMA_MPS, SIGMA_MPS)
                told = VelocitySample(t_s, vector_of(velocity), spread, in_body=True)
                sensed.samples.append((scenario.ids[slot], told))
        for slot, fix in sensors.fixes():
            if fix.valid:
                self._aided_until_s[slot] = world.time_s + AIDED_S
                sensed.fixes.append((scenario.ids[slot], gps_raw_int(round(1e6 * fix.time_s), fix)))
        return sensed

    def _attitude_sample(self, slot: int, t_s: float) -> AttitudeSample:
        """As the autopilot of a vehicle has it, and its word whether it is aided."""
        world, until_s = self._simulation.world, self._aided_until_s[slot]
        sensed = self._simulation.sensors.attitude(slot)
        if until_s is None:
            return AttitudeSample(t_s, quaternion_of(sensed))
        aided = world.time_s <= until_s
        self._tilts[slot].step(self._attitude_period_s, aided, world.velocity_mps[slot])
        return AttitudeSample(t_s, quaternion_of(self._tilts[slot].attitude(sensed)), aided)

    def truth(self) -> Truth:
        """What happened so far."""
        return self._recorder.truth()

    def _record(self) -> None:
        simulation, world = self._simulation, self._simulation.world
        time_unix_s = simulation.start_s + world.time_s + simulation.unix_offset_s
        self._recorder.record(time_unix_s, *simulation.bodies())


def _height(imu: SensedImu, t_s: float) -> list[BaroSample]:
    """What the barometer beside an IMU says, if the vehicle has one and there is air."""
    altitude_m = None if imu.pressure_hpa is None else pressure_altitude_m(imu.pressure_hpa)
    return [] if altitude_m is None else [BaroSample(t_s, altitude_m)]
