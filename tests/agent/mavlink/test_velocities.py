"""Velocities in messages of companions: frames, refusals, signs, and clocks of their own."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.mavlink.codec import mavlink
from agent.mavlink.velocities import SIGMA_MPS, VelocityAdapter
from agent.sensing.frames import from_euler, rotated
from agent.sensing.samples import FlowSample, VelocitySample

NAN = math.nan
EPOCH_S = 1_767_225_600.0
BODY, NED, FRD = mavlink.MAV_FRAME_BODY_FRD, mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_FRD
COMPANION = 191


def adapter(boot_at_s: float | None = 50.0) -> VelocityAdapter:
    """Of an autopilot that booted at this fleet time; ``None``: its clock is not known yet."""
    return VelocityAdapter(EPOCH_S, lambda boot_s, _: None if boot_at_s is None else boot_at_s + boot_s)


def odometry(**changes: Any) -> Any:
    covariance = [NAN] * 21
    covariance[0], covariance[6], covariance[11] = 0.04, 0.09, 0.16
    fields: dict[str, Any] = {
        "time_usec": 0, "frame_id": FRD, "child_frame_id": BODY, "x": NAN, "y": NAN, "z": NAN, "q": [1.0, 0, 0, 0],
        "vx": 1.0, "vy": 2.0, "vz": -0.5, "rollspeed": NAN, "pitchspeed": NAN, "yawspeed": NAN,
        "pose_covariance": [NAN] * 21, "velocity_covariance": covariance, "reset_counter": 0,
        "estimator_type": mavlink.MAV_ESTIMATOR_TYPE_VIO, "quality": 80,
    }  # fmt: skip
    return mavlink.MAVLink_odometry_message(**(fields | changes))


def flow(**changes: Any) -> Any:
    fields: dict[str, Any] = {
        "time_usec": 0, "sensor_id": 0, "integration_time_us": 100_000, "integrated_x": 0.0, "integrated_y": 0.0,
        "integrated_xgyro": 0.0, "integrated_ygyro": 0.0, "integrated_zgyro": 0.0, "temperature": 0, "quality": 255,
        "time_delta_distance_us": 0, "distance": 4.0,
    }  # fmt: skip
    return mavlink.MAVLink_optical_flow_rad_message(**(fields | changes))


def vision(**changes: Any) -> Any:
    fields: dict[str, Any] = {"usec": 0, "x": 3.0, "y": -1.0, "z": 0.2, "covariance": [NAN] * 9}
    return mavlink.MAVLink_vision_speed_estimate_message(**(fields | changes))


def taken(message: Any, *, of_autopilot: bool = False, arrival_s: float = 100.0) -> Any:
    """A sample, or the reason why there is none."""
    made = adapter()
    sample = made.convert(message, arrival_s, COMPANION, of_autopilot=of_autopilot)
    assert made.received.total() == 1 == (sample is not None) + made.skipped.total()
    return sample if sample is not None else next(iter(made.skipped))


def test_velocities_in_the_body_and_in_ned_have_their_own_accuracy() -> None:
    assert taken(odometry()) == VelocitySample(100.0, (1.0, 2.0, -0.5), pytest.approx((0.2, 0.3, 0.4)), in_body=True)
    assert taken(odometry(child_frame_id=NED)).in_body is False
    seen = taken(vision())
    assert (seen.velocity_mps, seen.in_body) == (pytest.approx((3.0, -1.0, 0.2)), False)
    assert seen.sigma_mps == (SIGMA_MPS,) * 3
    covariance = [0.01, 0.0, 0.0, 0.0, 0.04, 0.0, 0.0, 0.0, 0.09]
    assert taken(vision(covariance=covariance)).sigma_mps == pytest.approx((0.1, 0.2, 0.3))
    assert taken(odometry(velocity_covariance=[0.0] * 21)).sigma_mps == (SIGMA_MPS,) * 3


@given(st.floats(-3.0, 3.0), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_a_frame_of_any_heading_is_turned_back_into_the_body(yaw: float, pitch: float, roll: float) -> None:
    attitude = from_euler(roll, pitch, yaw)
    vx, vy, vz = rotated(attitude, (2.0, -1.0, 0.3))
    sample = taken(odometry(child_frame_id=FRD, q=list(attitude), vx=vx, vy=vy, vz=vz))
    assert sample.in_body
    assert sample.velocity_mps == pytest.approx((2.0, -1.0, 0.3), abs=1e-9)
    assert sample.sigma_mps == pytest.approx((0.4, 0.4, 0.4))


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (odometry(estimator_type=mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT), "odometry: an autopilot's estimate"),
        (odometry(estimator_type=mavlink.MAV_ESTIMATOR_TYPE_GPS_INS), "odometry: made of fixes"),
        (odometry(estimator_type=mavlink.MAV_ESTIMATOR_TYPE_GPS), "odometry: made of fixes"),
        (odometry(quality=-1), "odometry: says that it failed"),
        (odometry(child_frame_id=FRD, q=[NAN] * 4), "odometry: no attitude in its frame"),
        (odometry(child_frame_id=mavlink.MAV_FRAME_GLOBAL), "odometry: in no frame that is known"),
        (odometry(vx=NAN, vy=NAN, vz=NAN), "odometry: not finite"),
        (odometry(vx=math.inf, vy=NAN, vz=NAN), "odometry: not finite"),
        (odometry(vx=1e6), "odometry: out of range"),
        (flow(quality=0), "flow: no quality"),
        (flow(integration_time_us=0), "flow: integrated over no time"),
        (flow(integrated_xgyro=NAN), "flow: not finite"),
    ],
)
def test_what_is_no_measurement_is_left_out_and_counted(message: Any, reason: str) -> None:
    assert taken(message) == reason


def test_the_autopilots_own_velocity_is_none_but_flow_is_a_sensors_whoever_passes_it_on() -> None:
    assert taken(odometry(), of_autopilot=True) == "odometry: the autopilot's own"
    assert taken(vision(), of_autopilot=True) == "odometry: the autopilot's own"
    assert isinstance(taken(flow(), of_autopilot=True), FlowSample)


def test_an_axis_that_is_not_measured_says_so() -> None:
    sample = taken(odometry(vy=NAN, vz=NAN))
    assert sample.velocity_mps == (1.0, 0.0, 0.0)
    assert sample.sigma_mps == (pytest.approx(0.2), math.inf, math.inf)


@pytest.mark.parametrize(
    ("changes", "passing"),
    [
        ({"integrated_y": 0.1}, (1.0, 0.0)),  # forward
        ({"integrated_x": -0.1}, (0.0, 1.0)),  # to the right
        ({"integrated_x": 0.05, "integrated_xgyro": 0.05}, (0.0, 0.0)),
    ],
    ids=["forward", "right", "turning only"],
)
def test_flow_has_px4s_signs_and_turning_is_none(changes: dict[str, float], passing: tuple[float, float]) -> None:
    sample = taken(flow(**changes))
    assert sample.passing_radps == pytest.approx(passing, abs=1e-6)
    assert sample.distance_m == 4.0
    assert sample.t_s == pytest.approx(100.0 - 0.05)  # the middle of what was integrated
    assert taken(flow(distance=-1.0)).distance_m is None
    assert taken(flow(quality=1)).sigma_radps > 2.0 * sample.sigma_radps


@pytest.mark.parametrize(
    ("first_us", "late_s"),
    [(49_970_000, 0.03), (4_321_000_000, 0.0), (round((EPOCH_S + 99.97) * 1e6), 0.03), (round(1.5e9 * 1e6), 0.0)],
    ids=["autopilot's boot", "its own boot", "UTC", "a wrong UTC"],
)
def test_stamps_of_any_clock_keep_the_time_between_samples(first_us: int, late_s: float) -> None:
    # GIVEN samples that take 0.03 s at least, every third one 0.1 s more
    made = adapter(50.0)
    times = []
    for k in range(60):
        arrival_s = 100.0 + 0.1 * k + (0.1 if k % 3 == 1 else 0.0)
        sample = made.convert(odometry(time_usec=first_us + 100_000 * k), arrival_s, COMPANION, of_autopilot=False)
        assert sample is not None
        times.append(sample.t_s)
    # THEN their times are even, and those of the quickest where the clock tells no more
    assert times[10:] == pytest.approx([100.0 - late_s + 0.1 * k for k in range(10, 60)], abs=1e-3)


def test_of_several_the_best_is_listened_to_until_it_falls_silent() -> None:
    made = adapter()
    given_by = []
    for k in range(60):
        t_s = 100.0 + 0.1 * k
        messages = [vision()] if k >= 30 else [odometry(), vision()]
        given_by += [
            (k, each.get_type()) for each in messages
            if made.convert(each, t_s, COMPANION, of_autopilot=False) is not None
        ]  # fmt: skip
    assert {kind for k, kind in given_by if k < 30} == {"ODOMETRY"}
    assert [k for k, kind in given_by if kind != "ODOMETRY"] == list(range(40, 60))
    assert made.received["odometry"] == len(given_by) + made.skipped["odometry: a better one comes"]
