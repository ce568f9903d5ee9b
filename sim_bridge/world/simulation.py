"""The simulated fleet as one sans-I/O machine: time and datagrams in, datagrams and ranges out.

In real time a shell calls `Simulation.advance` with the clock; in virtual time a driver calls it with any rising
times. The result depends only on the scenario, the start and what comes in.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from agent.mavlink.dialect import mavlink
from sim_bridge.autopilot.fake_autopilot import AutopilotSetup, FakeAutopilot
from sim_bridge.autopilot.link_faults import FaultyLink
from sim_bridge.autopilot.truth_messages import TrueState
from sim_bridge.companions.camera import Camera, Companion
from sim_bridge.companions.target_camera import SensedDetections, TargetCamera
from sim_bridge.world import quaternions
from sim_bridge.world.guidance import Waypoints, default_path, moved_along
from sim_bridge.world.quaternions import Array
from sim_bridge.world.scenario import Reboot, Scenario
from sim_bridge.world.sensors import FleetSensors, SensedAttitude, SensedImu, SensedRanges, targets_at
from sim_bridge.world.truth import Truth, TruthRecorder
from sim_bridge.world.world import Dynamics, FleetWorld

STEP_TOLERANCE_S = 1e-9
IMU_MESSAGES = (
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU,
    mavlink.MAVLINK_MSG_ID_RAW_IMU,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU2,
)
ATTITUDE_MESSAGES = (mavlink.MAVLINK_MSG_ID_ATTITUDE, mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION)


@dataclass(slots=True)
class Outputs:
    """What left the simulated fleet: frames by agent, ranges and detections and when they were taken.

    Times are on the clock of ``now``.
    """

    frames: list[tuple[int, bytes]] = field(default_factory=list)
    ranges: list[tuple[float, SensedRanges]] = field(default_factory=list)
    detections: list[tuple[float, SensedDetections]] = field(default_factory=list)


class SimulatedVehicle:
    """One vehicle of the world as its autopilot sees it; at most one IMU sample per step."""

    def __init__(self, scenario: Scenario, world: FleetWorld, sensors: FleetSensors, slot: int) -> None:
        self._scenario, self._world, self._sensors, self._slot = scenario, world, sensors, slot
        self._path = scenario.vehicles[slot].path or default_path(slot, len(scenario.ids))
        self._imu: SensedImu | None = None
        self._attitude: SensedAttitude | None = None

    @property
    def landed(self) -> bool:
        """On the ground and at rest."""
        return bool(self._world.landed[self._slot])

    def imu(self) -> SensedImu:
        """The sample of this step."""
        if self._imu is None or self._imu.time_s != self._world.time_s:
            self._imu = self._sensors.imu(self._slot)
        return self._imu

    def attitude(self) -> SensedAttitude:
        """The attitude of this step."""
        if self._attitude is None or self._attitude.time_s != self._world.time_s:
            self._attitude = self._sensors.attitude(self._slot)
        return self._attitude

    def true_state(self) -> TrueState:
        """The truth of this step."""
        world, slot = self._world, self._slot
        quaternion = world.attitude()[slot]
        force_ned = world.specific_force_ned()[slot]
        return TrueState(
            world.position_m[slot].copy(),
            world.velocity_mps[slot].copy(),
            quaternion,
            quaternions.rotate(quaternions.conjugate(quaternion[None]), force_ned[None])[0],
            world.body_rates()[slot],
        )

    def _position(self) -> tuple[float, float, float]:
        north, east, down = (float(axis) for axis in self._world.position_m[self._slot])
        return north, east, down

    def follow_path(self) -> None:
        """Fly the scenario's path from its begin."""
        self._world.fly(self._slot, self._path)

    def hold(self) -> None:
        """Stay where it is."""
        self.go_to(self._position())

    def go_to(self, position_m: tuple[float, float, float]) -> None:
        """Fly to a point in the fleet frame and stay."""
        self._world.fly(self._slot, Waypoints((position_m,)))

    def climb(self, height_m: float) -> None:
        """Take off, this high above the ground."""
        north, east, down = self._position()
        self.go_to((north, east, down - height_m))

    def land(self) -> None:
        """Descend to the ground of the scenario, or stay down if it is below that."""
        self._world.land(self._slot, max(self._scenario.ground_d_m, self._position()[2]))


class Simulation:
    """World, sensors and autopilots of one run.

    ``start_s`` on the clock of ``now``, ``unix_offset_s`` Unix time minus that clock. Before ``start_s`` nothing
    happens; see `aligned_start` for a start on a tick.
    """

    def __init__(
        self,
        scenario: Scenario,
        start_s: float = 0.0,
        unix_offset_s: float = 0.0,
        signing_keys: Mapping[int, bytes] | None = None,
    ) -> None:
        """``signing_keys`` by agent are those of autopilots that sign."""
        self._signing_keys = signing_keys or {}
        self.scenario, self.start_s, self.unix_offset_s = scenario, start_s, unix_offset_s
        self.world = _world(scenario)
        self.sensors = FleetSensors(scenario, self.world, start_s + unix_offset_s - scenario.epoch_unix_s)
        self.autopilots = {
            vehicle.agent: FakeAutopilot(self._setup(slot), self._vehicle(slot), start_s)
            for slot, vehicle in enumerate(scenario.vehicles)
        }
        self.companions = companions(scenario)
        self._cameras = _cameras(scenario)
        self.dropped: Counter[int] = Counter()
        """Frames lost on a silenced link, by agent."""
        links = np.random.SeedSequence((scenario.seed, 2)).spawn(2 * len(scenario.ids))
        self._down_links = self._links(links[::2])
        self._up_links = self._links(links[1::2])
        bodies = (*scenario.ids, *(target for target, _ in scenario.targets))
        self._recorder = TruthRecorder(bodies, self.sensors.pair_bias_m)
        self._truth_every = max(round(1.0 / (scenario.truth_hz * self.world.step_s)), 1)
        self._reboots: deque[Reboot] = deque(sorted(scenario.reboots, key=lambda reboot: reboot.at_s))
        self._record()

    def _setup(self, slot: int) -> AutopilotSetup:
        scenario, vehicle = self.scenario, self.scenario.vehicles[slot]
        rates = dict.fromkeys(IMU_MESSAGES, scenario.imu_hz)
        rates |= dict.fromkeys(ATTITUDE_MESSAGES, scenario.attitude_hz)
        rates[mavlink.MAVLINK_MSG_ID_GPS_RAW_INT] = scenario.gps_hz
        return AutopilotSetup(
            flavour=vehicle.flavour,
            system_id=vehicle.system_id,
            frame=scenario.frame,
            gravity_mps2=scenario.gravity,
            unix_offset_s=self.unix_offset_s,
            clock_skew_ppm=vehicle.clock_skew_ppm,
            stamp_quantum_us=vehicle.stamp_quantum_us,
            gps_time_unknown=vehicle.gps_time_unknown,
            fusing=scenario.fusing,
            signing_key=self._signing_keys.get(vehicle.agent),
            sensor_rates_hz=rates,
        )

    def _links(self, seeds: list[np.random.SeedSequence]) -> dict[int, FaultyLink]:
        return {
            vehicle.agent: FaultyLink(vehicle.link, np.random.default_rng(seed))
            for vehicle, seed in zip(self.scenario.vehicles, seeds, strict=True)
        }

    def _vehicle(self, slot: int) -> SimulatedVehicle:
        return SimulatedVehicle(self.scenario, self.world, self.sensors, slot)

    @property
    def now(self) -> float:
        """Time of the world on the clock of ``now``."""
        return self.start_s + self.world.time_s

    def next_step_s(self) -> float:
        """When the world moves next."""
        return self.start_s + (self.world.step_index + 1) * self.world.step_s

    def advance(self, now: float) -> Outputs:
        """Step the world up to ``now`` and collect what the fleet sends on the way."""
        outputs = Outputs()
        while self.next_step_s() <= now + STEP_TOLERANCE_S:
            self.world.step()
            self._after_step(outputs)
        return outputs

    def _after_step(self, outputs: Outputs) -> None:
        now, ids = self.now, self.scenario.ids
        if self.world.step_index % self._truth_every == 0:
            self._record()
        while self._reboots and self.world.time_s >= self._reboots[0].at_s:
            reboot = self._reboots.popleft()
            self.autopilots[reboot.agent].reboot(now, reboot.down_s)
        for slot, fix in self.sensors.fixes():
            self.autopilots[ids[slot]].on_fix(fix, self.start_s + fix.time_s, now)
        for agent, autopilot in self.autopilots.items():
            self._send(agent, autopilot.advance(now), outputs.frames)
        for slot, companion in enumerate(self.companions):
            frame = companion.frame(self.world.time_s, self.world.velocity_mps[slot], self.world.attitude()[slot])
            if frame is not None:
                self._send(ids[slot], [frame], outputs.frames)
        if self.scenario.fusing:
            self._fly_by_belief()
        outputs.ranges += [(now, ranges) for ranges in self.sensors.ranges()]
        outputs.detections += [(now, seen) for seen in self.detections()]

    def detections(self) -> list[SensedDetections]:
        """What the cameras see of the targets at this step; ask once after each."""
        if not self._cameras:
            return []
        scenario, world = self.scenario, self.world
        targets, attitudes = targets_at(scenario, world.time_s), world.attitude()
        seen = []
        for camera in self._cameras:
            slot = scenario.slot(camera.agent)
            seen.append(camera.look(world.time_s, world.position_m[slot], attitudes[slot], targets))
        return [each for each in seen if each is not None]

    def _fly_by_belief(self) -> None:
        """Vehicles are guided by where their autopilots believe to be, once they believe anything."""
        for slot, autopilot in enumerate(self.autopilots.values()):
            navigation = autopilot.state.navigation
            if navigation.origin_m is not None:
                self.world.off_m[slot] = navigation.position_m - self.world.position_m[slot]
                self.world.off_mps[slot] = navigation.velocity_mps - self.world.velocity_mps[slot]

    def _send(self, agent: int, frames: list[bytes], sent: list[tuple[int, bytes]]) -> None:
        if frames and self._silent(agent):
            self.dropped[agent] += len(frames)
        else:
            sent += [(agent, frame) for frame in self._down_links[agent].passed(frames)]

    def _silent(self, agent: int) -> bool:
        time_s = self.world.time_s
        return any(silence.agent == agent and silence.holds(time_s) for silence in self.scenario.silences)

    def receive(self, agent: int, data: bytes, now: float) -> list[bytes]:
        """A datagram for one agent's autopilot; the frames it answers with."""
        if self._silent(agent):
            return []
        sent: list[tuple[int, bytes]] = []
        for arrived in self._up_links[agent].passed([data]):
            self._send(agent, self.autopilots[agent].receive(arrived, now), sent)
        return [frame for _, frame in sent]

    def _record(self) -> None:
        self._recorder.record(self.now + self.unix_offset_s, *self.bodies())

    def bodies(self) -> tuple[Array, Array]:
        """Positions and velocities ``(n + m, 3)`` NED of vehicles, then targets."""
        world, targets = self.world, moved_along([path for _, path in self.scenario.targets], self.world.time_s)
        return np.vstack((world.position_m, targets[0])), np.vstack((world.velocity_mps, targets[1]))

    def truth(self) -> Truth:
        """What happened so far, for the report only."""
        return self._recorder.truth()


def aligned_start(not_before_s: float, unix_offset_s: float, scenario: Scenario) -> float:
    """The first beginning of a fleet tick at or after a time on the clock of ``now``."""
    since_epoch_s = not_before_s + unix_offset_s - scenario.epoch_unix_s
    tick = math.ceil(since_epoch_s / scenario.period_s)
    return not_before_s + max(tick * scenario.period_s - since_epoch_s, 0.0)


def _world(scenario: Scenario) -> FleetWorld:
    """The vehicles at their starts; those that are not given are drawn about the begin of the path."""
    count = len(scenario.ids)
    paths = [vehicle.path or default_path(slot, count) for slot, vehicle in enumerate(scenario.vehicles)]
    position_m, velocity_mps = np.zeros((count, 3)), np.zeros((count, 3))
    seeds = np.random.SeedSequence((scenario.seed, 0)).spawn(count)
    for slot, (vehicle, path, seed) in enumerate(zip(scenario.vehicles, paths, seeds, strict=True)):
        rng = np.random.default_rng(seed)
        drawn: Array = rng.uniform(-1.0, 1.0, 6)
        begin = np.array(path.reference(0.0).position_m)
        offset = scenario.start_position_half_width_m * drawn[:3]
        position_m[slot] = begin + offset if vehicle.start_m is None else vehicle.start_m
        speed = scenario.start_speed_half_width_mps * drawn[3:]
        velocity_mps[slot] = speed if vehicle.start_velocity_mps is None else vehicle.start_velocity_mps
    return FleetWorld(
        position_m,
        velocity_mps,
        paths,
        dynamics=Dynamics(gravity_mps2=scenario.gravity, max_accel_mps2=scenario.max_accel_mps2),
        yaw_rad=np.array([vehicle.yaw_rad for vehicle in scenario.vehicles]),
        yaw_rate_radps=scenario.yaw_rate_radps,
        on_ground=np.array([vehicle.on_ground for vehicle in scenario.vehicles]),
    )


def companions(scenario: Scenario) -> list[Companion]:
    """A companion with a camera per vehicle, where there are any."""
    if not scenario.odometry_hz:
        return []
    seeds = np.random.SeedSequence((scenario.seed, 3)).spawn(len(scenario.ids))
    return [
        Companion(vehicle.system_id, Camera(scenario.odometry_hz, np.random.default_rng(seed)))
        for vehicle, seed in zip(scenario.vehicles, seeds, strict=True)
    ]


def _cameras(scenario: Scenario) -> list[TargetCamera]:
    """The cameras that detect targets, each with noise of its own."""
    seeds = np.random.SeedSequence((scenario.seed, 4)).spawn(len(scenario.ids))
    return [
        TargetCamera(camera, np.random.default_rng(seeds[scenario.slot(camera.agent)])) for camera in scenario.cameras
    ]
