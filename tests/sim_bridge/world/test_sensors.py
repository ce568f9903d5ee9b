"""What the simulated sensors say against what is true."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agent.sensing.barometer import pressure_altitude_m
from agent.sensing.frames import FleetFrame
from sim_bridge.faults.fault_tables import GpsWrong
from sim_bridge.world import geodesy, quaternions
from sim_bridge.world.guidance import Waypoints
from sim_bridge.world.noise import NOM, PAPER, REALISTIC, GaussMarkov, GpsNoise, UwbNoise
from sim_bridge.world.scenario import Interval, Vehicle
from sim_bridge.world.simulation import Simulation

THREE = tuple(Vehicle(agent, "px4", agent) for agent in (1, 2, 3))


def ned_of(frame: FleetFrame, fix) -> np.ndarray:
    return np.array(frame.ned(fix.lat_deg, fix.lon_deg, fix.alt_msl_m if frame.msl else fix.alt_ellipsoid_m))


def each_step(simulation: Simulation, seconds: float):
    for _ in range(round(seconds / simulation.world.step_s)):
        simulation.world.step()
        yield simulation.world


def test_paper_imu_noise_is_one_uniform_draw_per_tick_in_ned(make_scenario):
    # GIVEN the paper's profile, on a run that starts on a tick
    simulation = Simulation(make_scenario(*THREE, seed=5), 0.0)
    errors = []
    for world in each_step(simulation, 6.0):
        for slot in range(3):
            body = simulation.sensors.imu(slot).accel_mps2
            ned = quaternions.rotate(world.attitude()[slot : slot + 1], body[None])[0]
            errors.append(ned - world.specific_force_ned()[slot])
    # WHEN the samples are turned back to NED THEN the error is constant within each tick of 0.1 s
    by_tick = np.array(errors).reshape(60, 20, 3, 3)
    np.testing.assert_allclose(by_tick, by_tick[:, :1].repeat(20, axis=1), atol=1e-12)
    draws = by_tick[:, 0].reshape(-1)
    assert np.abs(draws).max() <= 0.1
    # and it fills the interval, with the variance of a uniform noise
    assert draws.std() == pytest.approx(0.1 / math.sqrt(3.0), rel=0.08)
    assert len(np.unique(draws)) == draws.size


@pytest.mark.parametrize("altitude_msl", [True, False])
def test_paper_gps_noise_stays_within_its_bounds(make_scenario, altitude_msl):
    frame = FleetFrame(47.4, 8.5, 480.0, altitude_msl, 47.5)
    simulation = Simulation(make_scenario(*THREE, frame=frame, gps_speed="norm"), 0.0)
    position_errors, speed_errors = [], []
    for world in each_step(simulation, 20.0):
        for slot, fix in simulation.sensors.fixes():
            assert fix.time_s == world.time_s
            position_errors.append(ned_of(frame, fix) - world.position_m[slot])
            speed_errors.append(fix.speed_mps - np.linalg.norm(world.velocity_mps[slot]))
    assert len(position_errors) == 3 * 200
    assert np.abs(position_errors).max() <= 0.15 + 1e-6
    assert np.std(position_errors) == pytest.approx(0.15 / math.sqrt(3.0), rel=0.05)
    assert np.abs(speed_errors).max() <= 0.08 + 1e-9


def test_ground_speed_and_course_are_those_of_the_horizontal_velocity(make_scenario):
    vehicle = Vehicle(1, start_m=(0.0, 0.0, 0.0), start_velocity_mps=(-3.0, -4.0, 1.5))
    simulation = Simulation(make_scenario(vehicle, max_accel_mps2=1e-6), 0.0)
    for _ in each_step(simulation, 0.1):
        fixes = simulation.sensors.fixes()
    fix = fixes[0][1]
    assert fix.speed_mps == pytest.approx(5.0, abs=0.081)
    assert fix.course_rad == pytest.approx(math.pi + math.atan2(4.0, 3.0), abs=1e-3)


def test_both_heights_are_sent_and_differ_by_the_geoid(make_scenario):
    frame = FleetFrame(47.4, 8.5, 480.0, False, 47.5)
    simulation = Simulation(make_scenario(frame=frame), 0.0)
    for _ in each_step(simulation, 0.1):
        fixes = simulation.sensors.fixes()
    fix = fixes[0][1]
    assert fix.alt_ellipsoid_m - fix.alt_msl_m == pytest.approx(47.5)
    assert fix.alt_ellipsoid_m == pytest.approx(475.0, abs=0.16)


def test_outages_and_jumps_hit_one_agent_only(make_scenario):
    jump = GpsWrong(agents=(3,), from_s=3.0, offset_m=(8.0, 0.0, 0.0))
    scenario = make_scenario(*THREE, gps_outages=(Interval(2, 1.0, 2.0),), faults=(jump,))
    simulation = Simulation(scenario, 0.0)
    invalid, jumped = [], []
    for world in each_step(simulation, 4.0):
        for slot, fix in simulation.sensors.fixes():
            if not fix.valid:
                invalid.append((slot, fix.time_s))
            elif abs(ned_of(scenario.frame, fix)[0] - world.position_m[slot, 0]) > 4.0:
                jumped.append((slot, fix.time_s))
    assert {slot for slot, _ in invalid} == {1}
    assert [time for _, time in invalid] == pytest.approx([1.0 + 0.1 * k for k in range(10)])
    assert {slot for slot, _ in jumped} == {2}
    assert min(time for _, time in jumped) == pytest.approx(3.0)


def test_realistic_fixes_are_late_and_older_than_their_stamp(make_scenario):
    vehicle = Vehicle(1, start_m=(0.0, 0.0, 0.0), start_velocity_mps=(6.0, 0.0, 0.0))
    offsets = []
    for seed in range(30):
        simulation = Simulation(make_scenario(vehicle, seed=seed, profile="realistic", max_accel_mps2=1e-6), 0.0)
        for world in each_step(simulation, 1.0):
            for _, fix in simulation.sensors.fixes():
                assert world.time_s - fix.time_s == pytest.approx(REALISTIC.gps.delivery_s, abs=0.0051)
                offsets.append(ned_of(simulation.scenario.frame, fix)[0] - 6.0 * fix.time_s)
    # the mean error along the track is the distance flown within the hidden lag; wander averages out over seeds
    assert np.mean(offsets) == pytest.approx(-6.0 * REALISTIC.gps.stamp_lag_s, abs=0.3)
    assert np.std(offsets) == pytest.approx(
        math.hypot(REALISTIC.gps.horizontal_sigma_m, REALISTIC.gps.horizontal_wander_m), rel=0.35
    )


def test_paper_ranges_are_taken_along_the_edges_within_their_bound(make_scenario):
    # GIVEN a line of three
    scenario = make_scenario(*THREE, edges=((1, 2), (3, 2)), uwb_hz=20.0)
    simulation = Simulation(scenario, 0.0)
    errors, pairs = [], set()
    for world in each_step(simulation, 10.0):
        for ranges in simulation.sensors.ranges():
            for measured in ranges.ranges:
                slots = scenario.slot(ranges.observer), scenario.slot(measured.target)
                distance = np.linalg.norm(world.position_m[slots[0]] - world.position_m[slots[1]])
                errors.append(measured.range_m - distance)
                pairs.add((ranges.observer, measured.target))
    # THEN both ends of each edge measure, at the rate, with their own noise
    assert pairs == {(1, 2), (2, 1), (2, 3), (3, 2)}
    assert len(errors) == 4 * 200
    assert np.abs(errors).max() <= 0.1
    assert np.std(errors) == pytest.approx(0.1 / math.sqrt(3.0), rel=0.08)
    assert len(set(errors)) == len(errors)


def test_realistic_ranges_have_a_bias_per_pair_and_a_long_tail(make_scenario):
    simulation = Simulation(make_scenario(*THREE, profile="realistic", uwb_hz=50.0), 0.0)
    errors: dict[frozenset[int], list[float]] = {}
    weak: list[float] = []
    for world in each_step(simulation, 40.0):
        for ranges in simulation.sensors.ranges():
            for measured in ranges.ranges:
                distance = np.linalg.norm(
                    world.position_m[ranges.observer - 1] - world.position_m[measured.target - 1]
                )
                error = measured.range_m - distance
                errors.setdefault(frozenset((ranges.observer, measured.target)), []).append(error)
                if measured.rx_dbm - measured.first_path_dbm > 6.0:
                    weak.append(error - simulation.sensors.pair_bias_m[frozenset((ranges.observer, measured.target))])
    everything = np.concatenate(list(errors.values()))
    for pair, pair_errors in errors.items():
        # the lobes of the two antennas stay in the median, up to their amplitude
        assert np.median(pair_errors) == pytest.approx(simulation.sensors.pair_bias_m[pair], abs=0.17)
    assert len(weak) / everything.size == pytest.approx(PAPER.uwb.nlos_probability + 0.03, abs=0.012)
    assert np.mean(weak) == pytest.approx(1.0, abs=0.25)
    assert everything.max() < 21.0


def test_observers_out_of_reach_measure_nothing(make_scenario):
    far = (
        Vehicle(1, path=Waypoints(((0.0, 0.0, 0.0),)), start_m=(0.0, 0.0, 0.0)),
        Vehicle(2, system_id=2, path=Waypoints(((50.0, 0.0, 0.0),)), start_m=(50.0, 0.0, 0.0)),
    )
    simulation = Simulation(make_scenario(*far, uwb_reach_m=30.0), 0.0)
    for _ in each_step(simulation, 0.5):
        assert simulation.sensors.ranges() == []


def test_staggered_observers_take_turns(make_scenario):
    simulation = Simulation(make_scenario(*THREE, uwb_staggered=True), 0.0)
    turns = []
    for world in each_step(simulation, 1.0):
        turns += [(ranges.observer, world.time_s) for ranges in simulation.sensors.ranges()]
    assert len({time for _, time in turns}) == len(turns) == 30


def test_realistic_attitude_error_has_its_size_and_keeps_the_quaternion_unit(make_scenario):
    many = tuple(Vehicle(agent, "ardupilot", agent) for agent in range(1, 101))
    simulation = Simulation(make_scenario(*many, profile="realistic", edges=()), 0.0)
    simulation.world.step()
    samples = np.array([simulation.sensors.attitude(slot).quaternion for slot in range(100)])
    error = quaternions.to_rotation_vector(
        quaternions.multiply(quaternions.conjugate(simulation.world.attitude()), samples)
    )
    np.testing.assert_allclose(np.linalg.norm(samples, axis=1), 1.0, atol=1e-12)
    assert error[:, :2].std() == pytest.approx(math.radians(0.4), rel=0.2)
    assert error[:, 2].std() == pytest.approx(math.radians(2.0), rel=0.25)


def test_gauss_markov_is_stationary_and_forgets_at_its_correlation_time():
    rng = np.random.default_rng(2)
    process = GaussMarkov(np.full(4000, 2.0), 10.0, rng)
    first = process.at(0.0).copy()
    later = process.at(10.0)
    assert later.std() == pytest.approx(2.0, rel=0.05)
    assert np.corrcoef(first, later)[0, 1] == pytest.approx(math.exp(-1.0), abs=0.05)
    assert process.at(10.0) is later


def test_pairs_are_biased_within_what_calibration_leaves_or_as_delivered(make_scenario):
    many = tuple(Vehicle(agent, system_id=agent) for agent in range(1, 31))
    for calibrated, mean, sigma in ((True, 0.0, 0.1 / math.sqrt(3.0)), (False, 0.3, 0.15)):
        scenario = make_scenario(*many, profile="realistic", uwb_calibrated=calibrated)
        bias = np.array(list(Simulation(scenario).sensors.pair_bias_m.values()))
        assert bias.size == 30 * 29 // 2
        assert bias.mean() == pytest.approx(mean, abs=0.03)
        assert bias.std() == pytest.approx(sigma, rel=0.15)


def test_antennas_are_where_the_attitude_turns_their_arms(make_scenario):
    # GIVEN a turning drone with antennas off its IMU, another with two tags, and sensors without noise
    arm, tags = (0.3, -0.1, 0.2), ((0.0, 0.3, 0.0), (0.2, 0.0, -0.1))
    vehicles = Vehicle(1, gps_antenna_m=arm, uwb_tags_m=(arm,)), Vehicle(2, system_id=2, uwb_tags_m=tags)
    simulation = Simulation(make_scenario(*vehicles, yaw_rate_radps=0.5, gps_speed="norm"), 0.0)
    simulation.sensors._gps_noise = GpsNoise()
    simulation.sensors._receivers[0]._noise = GpsNoise()
    simulation.sensors._channel._noise = UwbNoise()
    seen, before = [], None
    for world in each_step(simulation, 2.0):
        turned = quaternions.rotate(world.attitude(), np.array([arm, arm]))[0]
        antenna = world.position_m[0] + turned
        for slot, fix in simulation.sensors.fixes():
            if slot == 0:
                # THEN a fix is one of the antenna, and its speed the antenna's
                np.testing.assert_allclose(ned_of(simulation.scenario.frame, fix), antenna, atol=1e-6)
                if before is not None:
                    speed_mps = np.linalg.norm(antenna - before) / world.step_s
                    assert fix.speed_mps == pytest.approx(speed_mps, abs=0.02)
        for taken in simulation.sensors.ranges():
            for measured in taken.ranges:
                # AND a range is one between the antennas that it names, which take turns
                own, other = (measured.tag, measured.other_tag) if taken.observer == 1 else (
                    measured.other_tag, measured.tag
                )  # fmt: skip
                assert own == 0
                seen.append(other)
                there = world.position_m[1] + quaternions.rotate(world.attitude()[1:], np.array([tags[other]]))[0]
                assert measured.range_m == pytest.approx(np.linalg.norm(there - antenna), abs=1e-9)
        before = antenna
    assert set(seen) == {0, 1}
    yaw = [float(world_yaw) for world_yaw in simulation.world.yaw_rad]
    assert yaw == pytest.approx([1.0, 1.0])


def test_a_barometer_is_off_by_its_offset_and_its_noise(make_scenario):
    # GIVEN drones that stay about where they are, with and without barometers
    bare = Simulation(make_scenario(*THREE, profile="paper"), 0.0)
    bare.world.step()
    assert bare.sensors.imu(0).pressure_hpa is None
    simulation = Simulation(make_scenario(*THREE, profile="nom", seed=3), 0.0)
    frame = make_scenario().frame
    errors = [[], [], []]
    for world in each_step(simulation, 20.0):
        for slot in range(3):
            said = simulation.sensors.imu(slot)
            true_m = geodesy.msl_m(frame, frame.alt_m - world.position_m[slot, 2])
            errors[slot].append(said.pressure_alt_m - true_m)
            # and the pressure is that of the altitude, as the daemon reads it
            assert pressure_altitude_m(said.pressure_hpa) == pytest.approx(said.pressure_alt_m, abs=0.05)
    # THEN each is off by metres of its own, and scatters about that
    means = np.mean(errors, axis=1)
    assert np.ptp(means) > 0.5
    assert np.abs(means).max() < 15.0
    assert np.diff(errors, axis=1).std() / math.sqrt(2.0) == pytest.approx(NOM.barometer.sigma_m, rel=0.1)
