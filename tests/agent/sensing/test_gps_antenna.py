"""A fix of an antenna beside the IMU."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.sensing.frames import from_euler, rotated
from agent.sensing.gps_antenna import at_body
from agent.sensing.samples import AttitudeSample, GpsSample, ImuSample
from agent.sensing.timeline import Orientation, _turned
from tests.agent.conftest import fleet_config
from tests.support.onboard import onboard_of

ANGLE = st.floats(-3.0, 3.0)
ARM = st.tuples(*[st.floats(-1.0, 1.0)] * 3)


def fix(position: tuple[float, float, float], velocity: tuple[float, float] | None) -> GpsSample:
    return GpsSample(10.0, position, 0.3, 0.5, velocity, None if velocity else 2.0, 0.1, 3)


@given(ANGLE, st.floats(-1.5, 1.5), ANGLE, ARM, st.tuples(*[st.floats(-2.0, 2.0)] * 3))
def test_what_is_left_is_the_body(
    roll: float, pitch: float, yaw: float, arm: tuple[float, float, float], rate: tuple[float, float, float]
) -> None:
    # GIVEN a body at the origin that turns, and where its antenna is just before and after
    lies = from_euler(roll, pitch, yaw)
    before, after = (np.array(rotated(_turned(lies, rate, dt), arm)) for dt in (-1e-4, 1e-4))
    at, moves = rotated(lies, arm), (after - before) / 2e-4
    # THEN a fix of the antenna is one of the body at rest
    found = at_body(fix(at, (float(moves[0]), float(moves[1]))), arm, Orientation(lies, rate))
    assert found.position_m == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
    assert found.ground_velocity_mps == pytest.approx((0.0, 0.0), abs=1e-6)
    # AND where there is a speed alone it says how the antenna moves
    shift = at_body(fix(at, None), arm, Orientation(lies, rate)).shift_mps
    assert shift == pytest.approx(tuple(moves), abs=1e-6)


def test_an_unknown_attitude_makes_a_fix_less_sure_and_no_arm_changes_nothing() -> None:
    sample = fix((1.0, 2.0, 3.0), (1.0, 0.0))
    found = at_body(sample, (0.3, 0.0, 0.0), None)
    assert found.position_m == sample.position_m
    assert found.horizontal_sigma_m == pytest.approx(math.hypot(0.3, 0.3 / math.sqrt(3.0)))
    assert found.vertical_sigma_m > sample.vertical_sigma_m
    assert found.speed_sigma_mps > sample.speed_sigma_mps
    assert at_body(sample, (0.0, 0.0, 0.0), None) is sample


def test_a_timeline_knows_how_the_body_lay_and_turned() -> None:
    # GIVEN a body that turns about the vertical at 0.5 rad/s
    timeline = onboard_of(fleet_config(1)).core.timeline
    for step in range(20):
        t_s = 10.0 + 0.02 * step
        timeline.add_attitude(AttitudeSample(t_s, from_euler(0.0, 0.0, 0.5 * (t_s - 10.0))))
        timeline.add_imu(ImuSample(t_s, (0.01 * step, 0.0, -9.81), (0.0, 0.0, 0.5)))
    # THEN it says so between the samples and a little beyond them, and of long ago it knows nothing
    for t_s in (10.11, 10.4):
        found = timeline.orientation_at(t_s)
        assert found is not None
        assert found.rate_radps == (0.0, 0.0, 0.5)
        assert found.quaternion == pytest.approx(from_euler(0.0, 0.0, 0.5 * (t_s - 10.0)), abs=1e-6)
    assert timeline.orientation_at(5.0) is None
