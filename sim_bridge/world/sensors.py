"""What the sensors of the fleet say about the world, noise included. Sans-I/O; one generator per sensor.

Every agent and sensor draws from a stream of its own, so that another sensor's rate changes nothing.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, replace

import numpy as np

from sim_bridge.faults.sensor_faults import NO_ERROR, RangeError, SensorFaults
from sim_bridge.world import geodesy, quaternions
from sim_bridge.world.guidance import moved_along
from sim_bridge.world.noise import (
    PROFILES,
    AttitudeNoise,
    BarometerNoise,
    GaussMarkov,
    GpsNoise,
    ImuNoise,
    UwbNoise,
    uncalibrated,
)
from sim_bridge.world.quaternions import Array
from sim_bridge.world.scenario import Scenario
from sim_bridge.world.world import FleetWorld

EARTH_FIELD_GAUSS = (0.21, 0.0, 0.43)
"""NED, a mid-latitude field without declination."""
GRID_TOLERANCE_S = 1e-6


@dataclass(frozen=True, slots=True)
class SensedImu:
    """Mean over the last inner step, body FRD: ``accel_mps2`` (specific force) and ``gyro_rps`` ``(3,)``."""

    time_s: float
    accel_mps2: Array
    gyro_rps: Array
    mag_gauss: Array
    pressure_hpa: float | None
    """``None`` without a barometer; the altitude beside it is that of the standard atmosphere."""
    pressure_alt_m: float


@dataclass(frozen=True, slots=True)
class SensedAttitude:
    """``quaternion`` ``(4,)`` w x y z, body FRD into NED; ``rates_rps`` ``(3,)`` body."""

    time_s: float
    quaternion: Array
    rates_rps: Array


def vector_of(array: Array) -> tuple[float, float, float]:
    """Three plain numbers."""
    x, y, z = array.tolist()
    return x, y, z


def quaternion_of(attitude: SensedAttitude) -> tuple[float, float, float, float]:
    """Four plain numbers, w x y z."""
    w, x, y, z = attitude.quaternion.tolist()
    return w, x, y, z


@dataclass(frozen=True, slots=True)
class GpsFix:
    """One solution of a receiver, or its word that it has none (``valid`` false, the rest meaningless)."""

    time_s: float
    """What the stamp says."""
    valid: bool
    lat_deg: float = 0.0
    lon_deg: float = 0.0
    alt_msl_m: float = 0.0
    alt_ellipsoid_m: float = 0.0
    speed_mps: float = 0.0
    course_rad: float = 0.0
    """Over ground, clockwise from north, 0..2 pi."""
    position_ned_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The same position in the fleet frame, for the autopilot's own navigation."""
    velocity_ned_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    h_acc_m: float = 0.0
    v_acc_m: float = 0.0
    speed_acc_mps: float = 0.0
    hdop: float = 0.0
    vdop: float = 0.0


@dataclass(frozen=True, slots=True)
class SensedRange:
    """A range to one agent; received powers in dBm, probability of no line of sight; between which antennas."""

    target: int
    range_m: float
    sigma_m: float
    rx_dbm: float
    first_path_dbm: float
    nlos: float
    tag: int = 0
    other_tag: int = 0


@dataclass(frozen=True, slots=True)
class SensedRanges:
    """All ranges that one observer took at ``time_s``."""

    observer: int
    time_s: float
    ranges: tuple[SensedRange, ...]


def pressure_hpa(alt_msl_m: float) -> float:
    """Pressure of the standard atmosphere's troposphere."""
    return float(1013.25 * (1.0 - 2.25577e-5 * alt_msl_m) ** 5.25588)


class _Imu:
    """Errors of one vehicle's inertial sensors."""

    def __init__(self, noise: ImuNoise, rng: np.random.Generator) -> None:
        self._noise, self._rng = noise, rng
        self._accel_bias = noise.accel_bias_sigma_mps2 * rng.standard_normal(3)
        self._gyro_bias = noise.gyro_bias_sigma_rps * rng.standard_normal(3)
        self._walked_s = 0.0

    def accel(self, true: Array, time_s: float) -> Array:
        white, walk = self._noise.accel_sigma_mps2, self._noise.accel_walk_mps2
        if walk > 0.0 and time_s > self._walked_s:
            step = walk * math.sqrt(time_s - self._walked_s)
            self._accel_bias = self._accel_bias + step * self._rng.standard_normal(3)
            self._walked_s = time_s
        if white == 0.0:
            return true + self._accel_bias
        return np.asarray(true + self._accel_bias + white * self._rng.standard_normal(3))

    def gyro(self, true: Array) -> Array:
        white = self._noise.gyro_sigma_rps
        if white == 0.0:
            return true + self._gyro_bias
        return np.asarray(true + self._gyro_bias + white * self._rng.standard_normal(3))


class _Barometer:
    """Errors of one vehicle's barometer."""

    def __init__(self, noise: BarometerNoise, start_m: float, rng: np.random.Generator) -> None:
        """``start_m``: altitude that it is switched on at; its scale is about that."""
        self._noise, self._start_m, self._rng = noise, start_m, rng
        self._offset_m = noise.offset_sigma_m * float(rng.standard_normal())
        self._scale = noise.scale_sigma * float(rng.standard_normal())
        self._drift = GaussMarkov(np.array([noise.drift_sigma_m]), noise.drift_correlation_s, rng)

    def altitude_m(self, true_m: float, time_s: float) -> float:
        """Pressure altitude of a true one above mean sea level."""
        white_m = self._noise.sigma_m * float(self._rng.standard_normal())
        scaled_m = self._scale * (true_m - self._start_m)
        return true_m + scaled_m + self._offset_m + float(self._drift.at(time_s)[0]) + white_m


class _AttitudeError:
    """How wrong one autopilot's attitude is."""

    def __init__(self, noise: AttitudeNoise, slow: np.random.Generator, fixed: np.random.Generator) -> None:
        tilt, heading = noise.tilt_sigma_rad, noise.heading_sigma_rad
        self._slow = GaussMarkov(np.array((tilt, tilt, heading)), noise.correlation_s, slow)
        self._fixed = np.array((0.0, 0.0, noise.heading_offset_rad * (1.0 if fixed.random() < 0.5 else -1.0)))

    def at(self, time_s: float) -> Array:
        """Rotation vector ``(3,)`` in the body frame."""
        return np.asarray(self._slow.at(time_s) + self._fixed)


class _HeldNoise:
    """The paper's input noise: one draw per fleet tick and vehicle, NED, uniform."""

    def __init__(self, half_width: Array, rngs: list[np.random.Generator]) -> None:
        self._half_width, self._rngs = half_width, rngs
        self._tick: int | None = None
        self.value: Array = np.zeros((len(rngs), 3))

    def at_tick(self, tick: int) -> Array:
        if tick != self._tick and self._half_width.any():
            draws = [rng.uniform(-1.0, 1.0, 3) for rng in self._rngs]
            self.value = self._half_width[:, None] * np.array(draws)
        self._tick = tick
        return self.value


class _Receiver:
    """One GPS receiver: fixes on its own grid, late and wandering by its noise."""

    def __init__(self, noise: GpsNoise, speed: str, rng: np.random.Generator, common: GaussMarkov) -> None:
        self._noise, self._speed, self._rng = noise, speed, rng
        self._wander, self._common = _wander(noise, 1.0 - noise.wander_common, rng), common

    def solve(self, time_s: float, position: Array, velocity: Array, accel: Array) -> tuple[Array, Array]:
        """Position and velocity ``(3,)`` NED as the receiver has them."""
        noise, rng = self._noise, self._rng
        lag_s = noise.stamp_lag_s
        seen = position - lag_s * velocity + 0.5 * lag_s**2 * accel
        uniform = noise.position_uniform_m * rng.uniform(-1.0, 1.0, 3)
        sigma = np.array((noise.horizontal_sigma_m, noise.horizontal_sigma_m, noise.vertical_sigma_m))
        white = sigma * rng.standard_normal(3)
        speed_noise = noise.velocity_sigma_mps * rng.standard_normal(3)
        wander = self._wander.at(time_s) + self._common.at(time_s)
        return seen + uniform + white + wander, velocity - lag_s * accel + speed_noise

    def speed_and_course(self, velocity: Array) -> tuple[float, float]:
        """The two numbers that GPS_RAW_INT has; the speed's uniform noise is along the course."""
        north, east, down = (float(axis) for axis in velocity)
        ground = math.hypot(north, east)
        speed = math.hypot(ground, down) if self._speed == "norm" else ground
        speed += self._noise.speed_uniform_mps * float(self._rng.uniform(-1.0, 1.0))
        course = math.atan2(east, north) + (math.pi if speed < 0.0 else 0.0)
        return abs(speed), course % (2.0 * math.pi)


def _wander(noise: GpsNoise, share: float, rng: np.random.Generator) -> GaussMarkov:
    """A part of the wander of receivers, by its share of the variance."""
    axes = np.array((noise.horizontal_wander_m, noise.horizontal_wander_m, noise.vertical_wander_m))
    return GaussMarkov(math.sqrt(share) * axes, noise.wander_correlation_s, rng)


class _Channel:
    """Errors of the ranges between the agents."""

    def __init__(
        self, noise: UwbNoise, ids: tuple[int, ...], seeds: np.random.SeedSequence, others: tuple[int, ...]
    ) -> None:
        """``others`` are the ids of anchors and targets."""
        self._noise = noise
        own, *per_agent = seeds.spawn(1 + len(ids))
        fixed = np.random.default_rng(seeds.spawn(1)[0])
        self._bias_to_others_m = {(agent, other): self._drawn_bias_m(fixed) for agent in ids for other in others}
        rng = np.random.default_rng(own)
        self._rngs = {agent: np.random.default_rng(seed) for agent, seed in zip(ids, per_agent, strict=True)}
        self.bias_m = {
            frozenset((a, b)): self._drawn_bias_m(rng)
            for i, a in enumerate(ids)
            for b in ids[i + 1 :]
        }
        self._phase_rad = {agent: float(rng.uniform(0.0, 2.0 * math.pi)) for agent in ids}

    def _drawn_bias_m(self, rng: np.random.Generator) -> float:
        noise = self._noise
        white, even = noise.bias_sigma_m * float(rng.standard_normal()), float(rng.uniform(-1.0, 1.0))
        return noise.bias_mean_m + white + noise.bias_uniform_m * even

    def measure(
        self, observer: int, target: int, true_m: float, bearing_rad: float, fault: RangeError = NO_ERROR
    ) -> SensedRange:
        """A range over the true distance; ``bearing_rad`` of the target in the observer's body frame."""
        noise, rng = self._noise, self._rngs[observer]
        uniform = noise.uniform_m * float(rng.uniform(-1.0, 1.0))
        white = noise.sigma_m * float(rng.standard_normal())
        blocked = float(rng.random()) < noise.nlos_probability
        detour = min(float(rng.exponential(noise.nlos_mean_m)), noise.nlos_max_m)
        lobe = noise.orientation_m * math.sin(bearing_rad + self._phase_rad[observer])
        to_other = self._bias_to_others_m.get((observer, target))
        bias = self.bias_m[frozenset((observer, target))] if to_other is None else to_other
        error = uniform + white + bias + lobe + (detour if blocked else 0.0) + fault.extra_m
        blocked = blocked or fault.blocked
        rx_dbm = -60.0 - 20.0 * math.log10(max(true_m, 1.0)) - (6.0 if blocked else 0.0)
        first_path_dbm = rx_dbm - float(rng.uniform(7.0, 14.0) if blocked else rng.uniform(1.0, 4.0))
        nlos = float(rng.uniform(0.5, 1.0) if blocked else rng.uniform(0.0, 0.3))
        range_m = max(true_m + error, 0.01)
        return SensedRange(target, range_m, noise.reported_sigma_m, rx_dbm, first_path_dbm, nlos)


class _Grid:
    """Times ``phase + j / rate``; says when the next has come."""

    def __init__(self, rate_hz: float, phase_s: float = 0.0) -> None:
        self._rate_hz, self._phase_s = rate_hz, phase_s
        # nobody asks at time zero: a point there would be noticed a step late, off the grid
        self._next = 0 if phase_s > 0.0 else 1

    def due(self, time_s: float) -> bool:
        """Whether a new point of the grid was reached; points passed over are skipped."""
        point = math.floor((time_s - self._phase_s + GRID_TOLERANCE_S) * self._rate_hz)
        if point < self._next:
            return False
        self._next = point + 1
        return True


class FleetSensors:
    """All sensors of the fleet over one world; ask after each step of it.

    ``start_fleet_s``: fleet time (seconds since the configured epoch) at the start of the run; it aligns the
    paper's input noise with the ticks.
    """

    def __init__(self, scenario: Scenario, world: FleetWorld, start_fleet_s: float = 0.0) -> None:
        self._scenario, self._world, self._start_fleet_s = scenario, world, start_fleet_s
        profile = PROFILES[scenario.profile]
        count = len(scenario.ids)
        kinds = np.random.SeedSequence((scenario.seed, 1)).spawn(8)
        imu, held, attitude, gps, _, heading = (
            [np.random.default_rng(seed) for seed in kind.spawn(count)] for kind in kinds[:6]
        )
        imu_noise = [profile.imu[vehicle.flavour] for vehicle in scenario.vehicles]
        self._imu = [_Imu(noise, rng) for noise, rng in zip(imu_noise, imu, strict=True)]
        self._barometers = [
            _Barometer(profile.barometer, self._altitude_msl_m(slot), np.random.default_rng(seed))
            for slot, seed in enumerate(kinds[7].spawn(count))
            if profile.barometer is not None
        ]
        self._held = _HeldNoise(np.array([noise.held_uniform_mps2 for noise in imu_noise]), held)
        self._attitude_error = [
            _AttitudeError(profile.attitude, *rngs) for rngs in zip(attitude, heading, strict=True)
        ]
        self._gps_noise = profile.gps
        common = _wander(profile.gps, profile.gps.wander_common, np.random.default_rng(kinds[6]))
        self._receivers = [_Receiver(profile.gps, scenario.gps_speed, rng, common) for rng in gps]
        self._gps_grid = _Grid(scenario.gps_hz)
        self._undelivered: deque[tuple[float, int, GpsFix]] = deque()
        uwb = profile.uwb if scenario.uwb_calibrated else uncalibrated(profile.uwb)
        others = tuple(body for body, _ in (*scenario.anchors, *scenario.targets))
        self._channel = _Channel(uwb, scenario.ids, kinds[4], others)
        cycle_s = 1.0 / scenario.uwb_hz
        self._uwb_grids = [
            _Grid(scenario.uwb_hz, cycle_s * slot / count if scenario.uwb_staggered else 0.0) for slot in range(count)
        ]
        self._gps_antennas = np.array([vehicle.gps_antenna_m for vehicle in scenario.vehicles])
        self._tags = [np.array(vehicle.uwb_tags_m) for vehicle in scenario.vehicles]
        self._exchanges: Counter[tuple[int, int]] = Counter()
        """Ranges taken so far, by the slots of observer and target: antennas take turns."""
        self._faults = SensorFaults(scenario.faults, scenario.seed)
        self._body_step = -1
        self._body_force: Array = np.zeros((count, 3))
        self._body_rates: Array = np.zeros((count, 3))
        self._body_field: Array = np.zeros((count, 3))

    @property
    def pair_bias_m(self) -> dict[frozenset[int], float]:
        """Truth of the ranges' bias per pair of agents."""
        return self._channel.bias_m

    def _to_body(self) -> None:
        """Turn what acts in NED into the body frames, once per step for the whole fleet."""
        if self._body_step == self._world.step_index:
            return
        world = self._world
        middle_s = self._start_fleet_s + world.time_s - 0.5 * world.step_s
        held = self._held.at_tick(math.floor(middle_s / self._scenario.period_s))
        # v R is R^T v: the row vector on the left turns NED into body
        matrices = quaternions.matrices(world.attitude())
        self._body_force = ((world.specific_force_ned() + held)[:, None, :] @ matrices)[:, 0]
        self._body_field = np.array(EARTH_FIELD_GAUSS) @ matrices
        self._body_rates = world.body_rates()
        self._body_step = world.step_index

    def imu(self, slot: int) -> SensedImu:
        """A new sample of one vehicle's inertial sensors, magnetometer and barometer."""
        self._to_body()
        alt_msl_m, time_s = self._altitude_msl_m(slot), self._world.time_s
        if self._barometers:
            alt_msl_m = self._barometers[slot].altitude_m(alt_msl_m, time_s)
        force = self._imu[slot].accel(self._body_force[slot], time_s)
        return SensedImu(
            time_s,
            self._faults.force(self._scenario.ids[slot], time_s, force),
            self._imu[slot].gyro(self._body_rates[slot]),
            self._body_field[slot],
            pressure_hpa(alt_msl_m) if self._barometers else None,
            alt_msl_m,
        )

    def _altitude_msl_m(self, slot: int) -> float:
        frame = self._scenario.frame
        return float(geodesy.msl_m(frame, frame.alt_m - float(self._world.position_m[slot, 2])))

    def attitude(self, slot: int) -> SensedAttitude:
        """What the autopilot of one vehicle takes for its attitude."""
        self._to_body()
        time_s = self._world.time_s
        quaternion = self._world.attitude()[slot]
        error = self._attitude_error[slot].at(time_s)
        if error.any():
            turn = quaternions.from_rotation_vector(error[None])
            quaternion = quaternions.multiply(quaternion[None], turn)[0]
        return SensedAttitude(time_s, quaternion, self._imu[slot].gyro(self._body_rates[slot]))

    def fixes(self) -> list[tuple[int, GpsFix]]:
        """Slots and fixes whose messages leave the receivers at this step."""
        time_s = self._world.time_s
        if self._gps_grid.due(time_s):
            leaves_s = time_s + self._gps_noise.delivery_s
            self._undelivered += [(leaves_s, slot, fix) for slot, fix in enumerate(self._solve_all())]
        delivered = []
        while self._undelivered and self._undelivered[0][0] <= time_s + GRID_TOLERANCE_S:
            _, slot, fix = self._undelivered.popleft()
            delivered.append((slot, fix))
        return delivered

    def _solve_all(self) -> list[GpsFix]:
        scenario, world = self._scenario, self._world
        states = zip(*self._antenna_states(), strict=True)
        solved = [
            receiver.solve(world.time_s, *state) for receiver, state in zip(self._receivers, states, strict=True)
        ]
        errors = [self._faults.gps_error(agent, world.time_s) for agent in scenario.ids]
        both = list(zip(solved, errors, strict=True))
        positions = np.array([position + off_m for (position, _), (off_m, _) in both])
        velocities = [velocity + off_mps for (_, velocity), (_, off_mps) in both]
        places = geodesy.geodetic(scenario.frame, positions)
        return [self._fix(slot, *entry) for slot, entry in enumerate(zip(positions, velocities, places, strict=True))]

    def _antenna_states(self) -> tuple[Array, Array, Array]:
        """Position, velocity and acceleration ``(n, 3)`` NED of the GPS antennas; turn rates change slowly."""
        world, arms = self._world, self._gps_antennas
        if not arms.any():
            return world.position_m, world.velocity_mps, world.accel_mps2
        rates = world.body_rates()
        moves = np.asarray(np.cross(rates, arms), np.float64)
        bends = np.asarray(np.cross(rates, moves), np.float64)
        turned = [quaternions.rotate(world.attitude(), each) for each in (arms, moves, bends)]
        return world.position_m + turned[0], world.velocity_mps + turned[1], world.accel_mps2 + turned[2]

    def _fix(self, slot: int, position: Array, velocity: Array, place: Array) -> GpsFix:
        scenario, noise, time_s = self._scenario, self._gps_noise, self._world.time_s
        # drawn in an outage too, so that one does not change the noise after it
        speed_mps, course_rad = self._receivers[slot].speed_and_course(velocity)
        agent = scenario.ids[slot]
        out = any(outage.agent == agent and outage.holds(time_s) for outage in scenario.gps_outages)
        if out or self._faults.gps_off(agent, time_s):
            return GpsFix(time_s, valid=False)
        lat_deg, lon_deg, height_m = place.tolist()
        fix = GpsFix(
            time_s,
            valid=True,
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            alt_msl_m=geodesy.msl_m(scenario.frame, height_m),
            alt_ellipsoid_m=geodesy.ellipsoid_m(scenario.frame, height_m),
            speed_mps=speed_mps,
            course_rad=course_rad,
            position_ned_m=vector_of(position),
            velocity_ned_mps=vector_of(velocity),
            h_acc_m=noise.h_acc_m,
            v_acc_m=noise.v_acc_m,
            speed_acc_mps=noise.speed_acc_mps,
            hdop=noise.hdop,
            vdop=noise.vdop,
        )
        return replace(self._faults.repeated(agent, time_s, fix), time_s=time_s)

    def ranges(self) -> list[SensedRanges]:
        """The ranges taken at this step, a set per observer whose turn it is."""
        time_s = self._world.time_s
        sets = []
        for slot, observer in enumerate(self._scenario.ids):
            if self._uwb_grids[slot].due(time_s):
                measured = tuple(self._range_all(slot, observer))
                if measured:
                    sets.append(SensedRanges(observer, time_s, measured))
        return sets

    def _range_all(self, slot: int, observer: int) -> list[SensedRange]:
        measured = []
        for target in self._scenario.ranged_by(observer):
            there = self._scenario.slot(target)
            tag, other_tag = self._turn(slot, there)
            between = self._tag_position(there, other_tag) - self._tag_position(slot, tag)
            taken = self._range(slot, target, between)
            if taken is not None:
                measured.append(replace(taken, tag=tag, other_tag=other_tag))
        for other, place_m in self._places_of_others():
            tag, _ = self._turn(slot, -other)
            taken = self._range(slot, other, place_m - self._tag_position(slot, tag))
            if taken is not None:
                measured.append(replace(taken, tag=tag))
        return measured

    def _places_of_others(self) -> list[tuple[int, Array]]:
        """Ids and places ``(3,)`` NED of what carries a module: the anchors and, now, targets."""
        still = [(anchor, np.array(place_m)) for anchor, place_m in self._scenario.anchors]
        return still + (targets_at(self._scenario, self._world.time_s) if self._scenario.ranged_targets else [])

    def _range(self, slot: int, target: int, between: Array) -> SensedRange | None:
        """What a vehicle's module measures of a body that is ``between`` ``(3,)`` NED away, if it is in reach."""
        observer = self._scenario.ids[slot]
        north, east, down = (float(axis) for axis in between)
        distance_m = math.sqrt(north * north + east * east + down * down)
        if not distance_m <= self._scenario.uwb_reach_m:  # so that of nowhere, in SITL, nothing is measured
            return None
        bearing_rad = math.atan2(east, north) - float(self._world.yaw_rad[slot])
        time_s = self._world.time_s
        fault = self._faults.range_error(observer, target, time_s)
        taken = self._channel.measure(observer, target, distance_m, bearing_rad, fault)
        said_m = self._faults.said_m(observer, target, time_s, taken.range_m)
        return replace(taken, target=self._faults.said_of(observer, target, time_s), range_m=said_m)

    def _turn(self, slot: int, there: int) -> tuple[int, int]:
        """Between which antennas the next range is; other bodies, in place of a slot their negative id, have one."""
        turn, own = self._exchanges[slot, there], len(self._tags[slot])
        self._exchanges[slot, there] += 1
        return turn % own, turn // own % (len(self._tags[there]) if there >= 0 else 1)

    def _tag_position(self, slot: int, tag: int) -> Array:
        """Where an antenna of a UWB module is, ``(3,)`` NED."""
        arm, position = self._tags[slot][tag], self._world.position_m[slot]
        if not arm.any():
            return np.asarray(position)
        return np.asarray(position + quaternions.rotate(self._world.attitude()[slot][None], arm[None])[0])


def targets_at(scenario: Scenario, time_s: float) -> list[tuple[int, Array]]:
    """Ids and places ``(3,)`` NED of the targets at a time since the start."""
    places_m, _ = moved_along([path for _, path in scenario.targets], time_s)
    return list(zip((target for target, _ in scenario.targets), places_m, strict=True))
