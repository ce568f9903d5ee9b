"""What is encoded says what was meant, read as the autopilots read it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.feedback.encoding import (
    LEAST_SIGMA_M,
    FedState,
    GlobalPlace,
    ardupilot_odometry,
    ardupilot_variance,
    global_position_sensor,
    gps_input,
    gps_week,
    horizontal_sigma_m,
    px4_odometry,
)
from agent.mavlink.codec import Decoder, Encoder, Message, mavlink
from agent.sensing.frames import FleetFrame, from_euler, rotated
from estimators.model.measurements import Matrix

metres = st.floats(-5000.0, 5000.0)
speeds = st.floats(-30.0, 30.0)
angles = st.floats(-math.pi, math.pi)
triples = st.tuples(metres, metres, metres)
FRAME = FleetFrame(47.0, 8.0, 400.0, msl=True, geoid_separation_m=48.0)


@st.composite
def covariances(draw: st.DrawFn) -> Matrix:
    """Positive definite ``(6, 6)``."""
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6)) * draw(st.floats(0.01, 3.0))
    return np.asarray(root @ root.T)


@st.composite
def states(draw: st.DrawFn) -> FedState:
    """With an attitude."""
    return FedState(
        draw(st.integers(0, 2**50)),
        draw(triples),
        draw(st.tuples(speeds, speeds, speeds)),
        draw(covariances()),
        draw(st.integers(0, 1000)),
        from_euler(draw(angles), draw(st.floats(-1.5, 1.5)), draw(angles)),
    )


def over_the_wire(message: Message) -> Message:
    """The message as it arrives."""
    [received] = Decoder(datagrams=True).feed(Encoder(1, 197).encode(message))
    return received


def upper(message_covariance: list[float]) -> Matrix:
    """``(6, 6)`` of MAVLink's 21 numbers."""
    whole = np.zeros((6, 6))
    whole[np.triu_indices(6)] = message_covariance
    return whole


@given(states())
def test_px4_reads_position_velocity_and_covariance_back(state: FedState) -> None:
    message = over_the_wire(px4_odometry(state))

    assert (message.frame_id, message.child_frame_id) == (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD)
    assert message.time_usec == state.time_usec
    assert message.reset_counter == state.reset_counter % 256
    assert all(math.isnan(each) for each in message.q)  # the attitude is PX4's own
    assert message.estimator_type == mavlink.MAV_ESTIMATOR_TYPE_VISION
    assert (message.x, message.y, message.z) == pytest.approx(state.position_m, rel=1e-6, abs=1e-3)
    assert state.quaternion is not None
    velocity = rotated(state.quaternion, (message.vx, message.vy, message.vz))
    assert velocity == pytest.approx(state.velocity_mps, abs=1e-4)
    block = upper(message.pose_covariance)[:3, :3]
    assert np.triu(block, 1) == pytest.approx(np.triu(state.covariance[:3, :3], 1), rel=1e-5, abs=1e-5)
    expected = np.maximum(np.diagonal(state.covariance)[:3], LEAST_SIGMA_M**2)
    assert np.diagonal(block) == pytest.approx(expected, rel=1e-5)
    total = np.trace(state.covariance[3:, 3:])  # a turn keeps it
    assert np.trace(upper(message.velocity_covariance)[:3, :3]) >= total - 1e-3 * total - 1e-6


@given(states())
def test_ardupilot_sees_the_horizontal_sigma(state: FedState) -> None:
    message = over_the_wire(ardupilot_odometry(state))

    frames = message.frame_id, message.child_frame_id
    assert frames == (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD)
    c = message.pose_covariance
    seen_m = np.cbrt(c[0] ** 2 + c[6] ** 2 + c[11] ** 2)  # as AP_VisualOdom_MAV does
    assert seen_m == pytest.approx(horizontal_sigma_m(state.covariance), rel=1e-4)
    assert np.isfinite(message.q).all()
    velocity = rotated(tuple(message.q), (message.vx, message.vy, message.vz))
    assert velocity == pytest.approx(state.velocity_mps, abs=1e-3)


@given(states())
def test_without_attitude_px4_gets_no_velocity_and_ardupilot_nothing(state: FedState) -> None:
    bare = FedState(state.time_usec, state.position_m, state.velocity_mps, state.covariance, 1)

    message = over_the_wire(px4_odometry(bare))

    assert all(math.isnan(each) for each in (message.vx, message.vy, message.vz))
    assert math.isfinite(message.x)
    assert ardupilot_odometry(bare) is None


@given(states())
def test_places_come_back_from_latitude_and_longitude(state: FedState) -> None:
    place = GlobalPlace.of(state.position_m, FRAME)
    assert place is not None

    sensor = over_the_wire(global_position_sensor(state, place, system_id=1, component_id=1, age_s=0.15))
    given_gps = over_the_wire(gps_input(state, place, gps_id=1, unix_s=1_800_000_000.25))

    for message, height_m in ((sensor, sensor.alt), (given_gps, given_gps.alt)):
        back = FRAME.ned(message.lat * 1e-7, message.lon * 1e-7, height_m)
        assert back[:2] == pytest.approx(state.position_m[:2], abs=0.02)  # the last digit is 11 mm
        assert back[2] == pytest.approx(state.position_m[2], abs=0.01)
    assert sensor.eph == pytest.approx(horizontal_sigma_m(state.covariance), rel=1e-5)
    assert sensor.processing_time == 150_000
    assert sensor.alt_ellipsoid - sensor.alt == pytest.approx(48.0, abs=1e-2)
    assert (given_gps.vn, given_gps.ve, given_gps.vd) == pytest.approx(state.velocity_mps, abs=1e-4)
    assert (given_gps.gps_id, given_gps.fix_type, given_gps.ignore_flags) == (1, 3, 0)


def test_a_height_above_sea_level_that_cannot_be_had_gives_no_place() -> None:
    assert GlobalPlace.of((1.0, 2.0, 3.0), FleetFrame(47.0, 8.0, 400.0, msl=False)) is None
    place = GlobalPlace.of((0.0, 0.0, 0.0), FleetFrame(47.0, 8.0, 400.0, msl=False, geoid_separation_m=48.0))
    assert place is not None
    assert place.msl_m == pytest.approx(352.0)


def test_gps_weeks_begin_on_a_sunday_and_lead_utc_by_the_leap_seconds() -> None:
    week, ms = gps_week(1_735_430_400.0 - 18.0)  # 2024-12-29, a Sunday, is the begin of week 2347

    assert (week, ms) == (2347, 0)


@pytest.mark.parametrize("sigma_m", [0.1, 0.5, 1.0, 3.0])
def test_the_variance_for_ardupilot_as_it_was_measured(sigma_m: float) -> None:
    measured = {0.1: 0.0183, 0.5: 0.204, 1.0: 0.577, 3.0: 3.0}

    assert ardupilot_variance(sigma_m) == pytest.approx(measured[sigma_m], rel=0.01)
