"""The profile ``nom``: each error has the size, the memory and the common part that it says."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sim_bridge.world import quaternions
from sim_bridge.world.guidance import Waypoints
from sim_bridge.world.scenario import Vehicle
from sim_bridge.world.simulation import Simulation

COUNT = 60


def hovering(count: int) -> tuple[Vehicle, ...]:
    """Vehicles at rest, 10 m apart."""
    places = [(10.0 * k, 0.0, -10.0) for k in range(count)]
    return tuple(
        Vehicle(k + 1, system_id=k + 1, path=Waypoints((place,)), start_m=place, start_velocity_mps=(0.0, 0.0, 0.0))
        for k, place in enumerate(places)
    )


@pytest.fixture
def make_nom(make_scenario):
    def make(count: int = COUNT, **settings) -> Simulation:
        return Simulation(make_scenario(*hovering(count), profile="nom", **{"edges": (), **settings}), 0.0)

    return make


def at(simulation: Simulation, time_s: float) -> None:
    """Move the world's clock without flying: the vehicles hover."""
    simulation.world.step_index = round(time_s / simulation.world.step_s)


def position_errors(simulation: Simulation, times_s) -> np.ndarray:
    """Errors of the fixes ``(K, n, 3)`` at times, NED m."""
    errors = []
    for time_s in times_s:
        at(simulation, time_s)
        simulation.sensors.fixes()
        at(simulation, time_s + 0.06)  # they are delivered later than they are taken
        fixes = {slot: np.array(fix.position_ned_m) for slot, fix in simulation.sensors.fixes()}
        errors.append([fixes[slot] - simulation.world.position_m[slot] for slot in range(len(fixes))])
    return np.array(errors)


def test_accelerometers_have_a_bias_that_walks(make_nom):
    # GIVEN many vehicles at rest WHEN their accelerometers are averaged at the start and much later
    simulation = make_nom()

    def bias(from_s: float) -> np.ndarray:
        samples = []
        for k in range(400):
            at(simulation, from_s + 0.01 * k)
            samples.append([simulation.sensors.imu(slot).accel_mps2 for slot in range(COUNT)])
        return np.mean(samples, axis=0) - (0.0, 0.0, -simulation.scenario.gravity)

    first, later = bias(1.0), bias(101.0)
    # THEN the bias is 0.1 m/s2 per axis, and has walked by 0.01 m/s2 times the root of 100 s
    assert first.std() == pytest.approx(math.hypot(0.1, 0.01 * math.sqrt(3.0)), rel=0.15)
    assert (later - first).std() == pytest.approx(0.01 * math.sqrt(100.0), rel=0.15)
    # and the steps do not lean to where the bias is
    assert abs(np.corrcoef(first.ravel(), (later - first).ravel())[0, 1]) < 0.25


def test_attitude_tilts_by_a_degree_for_40_s_and_the_heading_is_off_for_good(make_nom):
    simulation = make_nom()

    def error(time_s: float) -> np.ndarray:
        at(simulation, time_s)
        said = np.array([simulation.sensors.attitude(slot).quaternion for slot in range(COUNT)])
        true = quaternions.conjugate(simulation.world.attitude())
        return np.degrees(quaternions.to_rotation_vector(quaternions.multiply(true, said)))

    series = np.array([error(1.0 + 40.0 * k) for k in range(12)])
    tilt = series[..., :2]
    assert tilt.std() == pytest.approx(1.0, rel=0.1)
    correlation = np.corrcoef(tilt[:-1].ravel(), tilt[1:].ravel())[0, 1]
    assert correlation == pytest.approx(math.exp(-1.0), abs=0.1)
    np.testing.assert_allclose(np.abs(series[..., 2]), 2.0, atol=0.05)
    assert 0.3 < (series[0, :, 2] > 0.0).mean() < 0.7
    assert (np.sign(series[..., 2]) == np.sign(series[0, :, 2])).all()


def test_fixes_wander_by_a_metre_in_a_minute_half_of_it_together(make_nom):
    # GIVEN many flights, WHEN fixes are taken a correlation time apart
    flights = np.array([position_errors(make_nom(6, seed=seed), (0.1, 60.1)) for seed in range(250)])
    white, claimed = np.array((0.15, 0.15, 0.225)), np.array((1.0, 1.0, 1.5))
    wander = np.sqrt(flights.var(axis=(0, 1, 2)) - white**2)
    # THEN the spread is 1 m, upwards 1.5 m
    np.testing.assert_allclose(wander, claimed, rtol=0.1)
    # half of the variance is common to the receivers
    scaled = flights / claimed
    ours, theirs = scaled[:, :, :3], scaled[:, :, 3:]
    assert np.mean(ours * theirs) == pytest.approx(0.5, abs=0.06)
    # and it is forgotten in 60 s
    assert np.mean(scaled[:, 0] * scaled[:, 1]) == pytest.approx(math.exp(-1.0), abs=0.08)


def test_receivers_claim_more_than_they_keep(make_nom):
    simulation = make_nom(1)
    at(simulation, 0.1)
    simulation.sensors.fixes()
    at(simulation, 0.2)
    ((_, fix),) = simulation.sensors.fixes()
    assert (fix.h_acc_m, fix.v_acc_m) == (0.4, 0.6)


def test_pairs_are_biased_by_20_to_50_cm_and_some_ranges_miss_their_line_of_sight(make_nom):
    simulation = make_nom(12, edges=None, uwb_hz=10.0)
    bias = np.array(list(simulation.sensors.pair_bias_m.values()))
    assert bias.size == 66
    assert bias.min() >= 0.2
    assert bias.max() <= 0.5
    assert bias.mean() == pytest.approx(0.35, abs=0.03)
    errors, hidden = [], []
    for turn in range(1, 240):  # each observer's turn comes in its own twelfth of 0.1 s
        at(simulation, turn * 0.1 / 12 + 1e-4)
        for ranges in simulation.sensors.ranges():
            for measured in ranges.ranges:
                pair = frozenset((ranges.observer, measured.target))
                true_m = 10.0 * abs(ranges.observer - measured.target)
                errors.append(measured.range_m - true_m - simulation.sensors.pair_bias_m[pair])
                hidden.append(measured.nlos >= 0.5)
    assert len(errors) > 2000
    told, error = np.array(hidden), np.array(errors)
    assert told.mean() == pytest.approx(0.03, abs=0.012)
    assert error[told].mean() == pytest.approx(1.0, abs=0.35)
    assert error[~told].std() == pytest.approx(0.1, rel=0.1)
    assert abs(error[~told].mean()) < 0.02
