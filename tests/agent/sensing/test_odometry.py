"""Velocities of cameras, flow and wheels: turned, looked after, and believed as long as they agree."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.sensing.frames import from_euler, rotated
from agent.sensing.odometry import (
    INTERVAL_S,
    SIGMA_FLOOR_MPS,
    TURNED,
    UNSEEN_MPS,
    MeasuredVelocity,
    Motion,
    Odometer,
    in_ned,
    over_ground,
)
from agent.sensing.samples import FlowSample, Quaternion, Triple, VelocitySample
from agent.sensing.timeline import Orientation

LEVEL = Orientation((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
STILL = Motion(0.0, (0.0, 0.0, 0.0), (0.01, 0.01, 0.01))
speeds = st.floats(-20.0, 20.0)
sigmas = st.one_of(st.floats(0.0, 3.0), st.just(math.inf))
angles = st.floats(-math.pi, math.pi)


def body(velocity: Triple, sigma: float | Triple = 0.1, t_s: float = 0.0) -> VelocitySample:
    return VelocitySample(t_s, velocity, sigma if isinstance(sigma, tuple) else (sigma, sigma, sigma), in_body=True)


def turned(quaternion: Quaternion) -> Orientation:
    return Orientation(quaternion, (0.0, 0.0, 0.0))


@given(st.tuples(speeds, speeds, speeds), st.tuples(sigmas, sigmas, sigmas), angles, angles, angles)
def test_a_turned_velocity_claims_no_more_than_is_known(
    velocity: Triple, sigma: Triple, roll: float, pitch: float, yaw: float
) -> None:
    attitude = from_euler(roll, pitch, yaw)
    found = in_ned(body(velocity, sigma), turned(attitude))
    if isinstance(found, str):
        assert found == "nothing measured"
        return
    # GIVEN the whole covariance in NED, by each body axis
    seen = [v if s < math.inf else 0.0 for v, s in zip(velocity, sigma, strict=True)]
    speed_mps = math.hypot(*seen)
    axes = [np.array(rotated(attitude, tuple(np.eye(3)[i]))) for i in range(3)]
    share = (TURNED * speed_mps) ** 2
    known = [max(s, SIGMA_FLOOR_MPS) ** 2 + share if s < math.inf else UNSEEN_MPS**2 for s in sigma]
    covariance = sum(variance * np.outer(axis, axis) for variance, axis in zip(known, axes, strict=True))
    measured = np.isfinite(found.variance_m2ps2)
    assert measured.any()
    # THEN what is claimed, as if the axes were independent, is no less in any direction
    spare = np.diag(np.array(found.variance_m2ps2)[measured]) - covariance[np.ix_(measured, measured)]
    assert np.linalg.eigvalsh(spare).min() > -1e-9
    np.testing.assert_allclose(found.velocity_mps, rotated(attitude, tuple(seen)), atol=1e-9)


def test_velocities_in_ned_are_taken_as_they_are() -> None:
    sample = VelocitySample(0.0, (3.0, -1.0, 0.5), (0.3, 0.4, math.inf), in_body=False)
    found = in_ned(sample, None)
    assert isinstance(found, MeasuredVelocity)
    assert found.velocity_mps == pytest.approx((3.0, -1.0, 0.0))
    share = (TURNED * math.hypot(3.0, 1.0)) ** 2
    assert found.variance_m2ps2 == pytest.approx((0.09 + share, 0.16 + share, math.inf))


def test_what_cannot_be_turned_is_not_used() -> None:
    assert in_ned(body((1.0, 0.0, 0.0)), None) == "attitude unknown"
    assert in_ned(body((0.0, 0.0, 0.0), math.inf), LEVEL) == "nothing measured"


def test_flow_tells_the_horizontal_velocity_where_the_ground_is_known_to_be() -> None:
    # GIVEN ground that passes at 0.5 rad/s forward, 4 m below, WHEN the drone heads east
    east = turned(from_euler(0.0, 0.0, math.pi / 2))
    found = in_ned(over_ground(FlowSample(0.0, (0.5, 0.0), 0.1, None), 4.0), east)
    assert isinstance(found, MeasuredVelocity)
    assert found.velocity_mps[:2] == pytest.approx((0.0, 2.0), abs=1e-9)
    # THEN it is as good as flow and distance are, and says nothing of the climb
    spread = 0.4**2 + 0.2**2 + (TURNED * 2.0) ** 2
    assert found.variance_m2ps2 == pytest.approx((spread, spread, math.inf))


def test_few_of_the_samples_are_used() -> None:
    odometer = Odometer()
    taken = [odometer.take(body((0.1 * k, 0.0, 0.0), t_s=k / 30), LEVEL, None) for k in range(91)]
    used = [each for each in taken if isinstance(each, MeasuredVelocity)]
    assert len(used) == pytest.approx(3.0 / INTERVAL_S, abs=2)
    assert {each for each in taken if isinstance(each, str)} == {"more than are needed"}


def test_what_never_changes_is_no_velocity_of_a_moving_body() -> None:
    for velocity, expected in (((1.0, 0.5, 0.0), "always the same"), ((0.0, 0.0, 0.0), None)):
        odometer = Odometer()
        taken = [odometer.take(body(velocity, t_s=0.25 * k), LEVEL, None) for k in range(24)]
        last = taken[-1]
        assert (last if isinstance(last, str) else None) == expected
    assert isinstance(taken[0], MeasuredVelocity)


def test_a_sensor_that_contradicts_is_left_out_until_it_agrees_again() -> None:
    # GIVEN a drone that is known to stand, and a camera that says so with noise
    odometer, rng = Odometer(), np.random.default_rng(3)

    def says(from_s: float, to_s: float, off_mps: float) -> list[MeasuredVelocity | str]:
        taken = []
        for t_s in np.arange(from_s, to_s, 0.25):
            x, y, z = rng.normal((off_mps, 0.0, 0.0), 0.1).tolist()
            motion = Motion(float(t_s) - 0.1, STILL.velocity_mps, STILL.variance_m2ps2)
            taken.append(odometer.take(body((x, y, z), t_s=float(t_s)), LEVEL, motion))
        return taken

    assert all(isinstance(each, MeasuredVelocity) for each in says(0.0, 20.0, 0.0))
    # WHEN it goes wrong THEN it is soon left out, and used again once it is well
    wrong = says(20.0, 30.0, 4.0)
    assert "contradicts the estimate" in wrong[:12]
    assert set(wrong[12:]) == {"contradicts the estimate"}
    well = says(30.0, 45.0, 0.0)
    assert all(isinstance(each, MeasuredVelocity) for each in well[-20:])


def test_without_an_estimate_of_late_nothing_is_contradicted() -> None:
    odometer = Odometer()
    taken = [odometer.take(body((9.0 + 0.1 * k, 0.0, 0.0), t_s=10.0 + k), LEVEL, STILL) for k in range(20)]
    assert all(isinstance(each, MeasuredVelocity) for each in taken)
