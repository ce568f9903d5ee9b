"""The physics of the simulated fleet."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_bridge.world import quaternions
from sim_bridge.world.guidance import Circle, FigureEight, Line, Waypoints, lqr_gain, peak_accel_mps2
from sim_bridge.world.world import STEP_RATE_HZ, Dynamics, FleetWorld

GRAVITY = 9.80665
axis = st.floats(-6.0, 6.0)
vectors = st.tuples(axis, axis, axis)
paths = st.sampled_from(
    [
        Waypoints(((3.0, -2.0, -5.0), (-4.0, 1.0, -8.0)), 2.0),
        Circle((0.0, 0.0, -5.0), 4.0, 12.0),
        FigureEight((1.0, 1.0, -5.0), 10.0, 5.0, 15.0),
        Line((1.0, 1.0, -5.0), (0.5, 0.0, 0.0), (0.0, 3.0, 1.0), 20.0),
    ]
)


def world_at(position, velocity, path, **settings) -> FleetWorld:
    return FleetWorld(np.array([position], float), np.array([velocity], float), [path], **settings)


def test_at_hover_the_accelerometers_read_minus_g_on_body_z():
    # GIVEN a vehicle at rest at its reference, whatever its heading
    world = world_at((5, 0, -5), (0, 0, 0), Waypoints(((5.0, 0.0, -5.0),)), yaw_rad=np.array([1.2]))
    # WHEN it hovers
    for _ in range(100):
        world.step()
    # THEN it feels gravity only, upwards, and does not turn
    body = quaternions.rotate(quaternions.conjugate(world.attitude()), world.specific_force_ned())
    np.testing.assert_allclose(body, [[0.0, 0.0, -GRAVITY]], atol=1e-12)
    np.testing.assert_allclose(world.body_rates(), 0.0, atol=1e-12)
    assert quaternions.to_euler(world.attitude()[0]) == pytest.approx((0.0, 0.0, 1.2))


@settings(max_examples=25, deadline=None)
@given(position=vectors, velocity=vectors, path=paths, yaw=st.floats(-3.0, 3.0), steps=st.integers(1, 60))
def test_specific_force_rotated_by_the_attitude_plus_gravity_is_the_true_acceleration(
    position, velocity, path, yaw, steps
):
    world = world_at(position, velocity, path, yaw_rad=np.array([yaw]))
    for _ in range(steps):
        before = world.velocity_mps.copy()
        world.step()
    # the thrust is along body -z, so that is all an ideal accelerometer reads
    force = np.linalg.norm(world.specific_force_ned())
    ned = quaternions.rotate(world.attitude(), np.array([[0.0, 0.0, -force]]))
    true_accel = (world.velocity_mps - before) * STEP_RATE_HZ
    np.testing.assert_allclose(ned + np.array([0.0, 0.0, GRAVITY]), true_accel, atol=1e-8)
    assert np.abs(world.accel_mps2).max() <= 2.0


@settings(max_examples=25, deadline=None)
@given(position=vectors, velocity=vectors, path=paths)
def test_body_rates_turn_one_attitude_into_the_next(position, velocity, path):
    world = world_at(position, velocity, path, yaw_rad=np.array([0.4]))
    for _ in range(20):
        world.step()
    before = world.attitude().copy()
    world.step()
    turn = quaternions.from_rotation_vector(world.body_rates() * world.step_s)
    after = quaternions.multiply(before, turn)
    np.testing.assert_allclose(np.abs((after * world.attitude()).sum()), 1.0, atol=1e-12)
    assert np.linalg.norm(world.body_rates()) > 0.0


@settings(max_examples=20, deadline=None)
@given(position=vectors, velocity=vectors, path=paths)
def test_position_is_the_integral_of_velocity_and_velocity_that_of_acceleration(position, velocity, path):
    world = world_at(position, velocity, path)
    p, v = np.array([position]), np.array([velocity])
    for _ in range(80):
        world.step()
        p = p + v / STEP_RATE_HZ + 0.5 * world.accel_mps2 / STEP_RATE_HZ**2
        v = v + world.accel_mps2 / STEP_RATE_HZ
    np.testing.assert_allclose(world.position_m, p, atol=1e-9)
    np.testing.assert_allclose(world.velocity_mps, v, atol=1e-9)


def test_the_gain_is_the_textbook_one_of_fast_sampling():
    # continuous double integrator with unit weights: K = [1, sqrt(3)] per axis
    gain = lqr_gain(1e-3)
    np.testing.assert_allclose(gain, np.hstack((np.eye(3), np.sqrt(3.0) * np.eye(3))), rtol=2e-3, atol=1e-12)


@pytest.mark.parametrize("lag_s", [0.0, 0.1])
def test_vehicles_settle_at_their_point_from_the_studies_starts(lag_s):
    rng = np.random.default_rng(4)
    count = 12
    world = FleetWorld(
        rng.uniform(-15, 15, (count, 3)),
        rng.uniform(-2, 2, (count, 3)),
        [Waypoints(((5.0, 0.0, 5.0),))] * count,
        dynamics=Dynamics(accel_lag_s=lag_s),
    )
    for _ in range(20 * STEP_RATE_HZ):
        world.step()
    np.testing.assert_allclose(world.position_m, np.tile([5.0, 0.0, 5.0], (count, 1)), atol=1e-3)


@pytest.mark.parametrize(
    "path",
    [
        Circle((1.0, 2.0, -5.0), 4.0, 12.0, 0.7),
        FigureEight((1.0, 2.0, -5.0), 10.0, 5.0, 15.0, 0.3),
        Line((1.0, 2.0, -5.0), (2.0, -0.5, 0.1), (0.0, 6.0, 2.0), 30.0),
    ],
)
def test_references_are_consistent_and_followed(path):
    # GIVEN a path, its velocity and acceleration are the derivatives of its position
    step = 1e-4
    for time_s in (0.0, 3.3, 11.0):
        before, at, after = (np.array(path.reference(time_s + d).position_m) for d in (-step, 0.0, step))
        np.testing.assert_allclose((after - before) / (2 * step), path.reference(time_s).velocity_mps, atol=1e-5)
        second = (after - 2 * at + before) / step**2
        np.testing.assert_allclose(second, path.reference(time_s).accel_mps2, atol=1e-4)
        assert np.abs(second).max() <= peak_accel_mps2(path) * 1.01
    # WHEN it is flown THEN the vehicle stays close to it
    world = world_at(path.reference(0.0).position_m, path.reference(0.0).velocity_mps, path)
    for _ in range(15 * STEP_RATE_HZ):
        world.step()
    np.testing.assert_allclose(world.position_m[0], path.reference(world.time_s).position_m, atol=0.3)


def test_waypoints_take_turns_and_repeat_or_stay():
    points = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    assert Waypoints(points, 2.0).reference(4.1).position_m == points[0]
    assert Waypoints(points, 2.0, repeat=False).reference(40.0).position_m == points[1]


def test_landing_and_taking_off():
    # GIVEN a vehicle on the ground: at rest
    world = world_at((1, 2, 0), (3, 0, 0), Waypoints(((9.0, 9.0, -9.0),)), on_ground=np.array([True]))
    for _ in range(STEP_RATE_HZ):
        world.step()
    np.testing.assert_array_equal(world.position_m, [[1.0, 2.0, 0.0]])
    # WHEN it is told to climb THEN it does
    world.fly(0, Waypoints(((1.0, 2.0, -3.0),)))
    for _ in range(10 * STEP_RATE_HZ):
        world.step()
    np.testing.assert_allclose(world.position_m, [[1.0, 2.0, -3.0]], atol=0.02)
    # WHEN it lands THEN it comes to rest at the ground
    world.land(0, 0.0)
    for _ in range(15 * STEP_RATE_HZ):
        world.step()
    assert world.landed[0]
    assert world.position_m[0, 2] == pytest.approx(0.0, abs=0.06)
    np.testing.assert_array_equal(world.velocity_mps, 0.0)


def test_a_start_of_the_wrong_shape_is_refused():
    with pytest.raises(ValueError, match="need positions"):
        FleetWorld(np.zeros((2, 3)), np.zeros((1, 3)), [Waypoints(((0.0, 0.0, 0.0),))])
