"""Frames, rotations, gravity."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.config.tables import FleetConfig
from agent.sensing.frames import (
    FleetFrame,
    from_euler,
    gravity_mps2,
    interpolated,
    normal_gravity_mps2,
    normalised,
    rotated,
)

ANGLE = st.floats(-3.0, 3.0)
PLACE = st.tuples(st.floats(-3000, 3000), st.floats(-3000, 3000), st.floats(-500, 500))


@given(PLACE, st.sampled_from([None, 47.5, -30.0]), st.booleans())
def test_ned_to_geodetic_and_back(ned_m: tuple[float, float, float], geoid: float | None, msl: bool) -> None:
    frame = FleetFrame(47.4, 8.5, 488.0, msl, geoid)
    assert frame.ned(*frame.geodetic(ned_m)) == pytest.approx(ned_m, abs=1e-5)


def test_a_receiver_that_sends_the_other_height_only_needs_the_geoid_separation(
    make_config: Callable[..., FleetConfig],
) -> None:
    """GIVEN heights above sea level WHEN only the ellipsoidal one comes THEN the configured separation is between."""
    without, given = FleetFrame.of(make_config(1)), FleetFrame.of(make_config(1, "sensors.geoid_separation_m=47.5"))
    assert without.height(None, 535.5) is None
    assert given.height(None, 535.5) == pytest.approx(488.0)
    assert given.height(490.0, 535.5) == 490.0


def test_a_hundred_metres_north_east_and_up() -> None:
    frame = FleetFrame(0.0, 0.0, 0.0, msl=False)
    # One second of arc of the equator and of the meridian there (WGS84: 30.922 m and 30.715 m).
    assert frame.ned(1 / 3600, 0.0, 0.0)[0] == pytest.approx(30.715, abs=1e-3)
    assert frame.ned(0.0, 1 / 3600, 0.0)[1] == pytest.approx(30.922, abs=1e-3)
    assert frame.ned(0.0, 0.0, 100.0) == pytest.approx((0, 0, -100))


def test_the_height_is_of_the_fleets_sort_or_none() -> None:
    msl = FleetFrame(47.0, 8.0, 400.0, msl=True)
    assert msl.height(410.0, 458.0) == 410.0
    assert msl.height(None, 458.0) is None
    ellipsoid = FleetFrame(47.0, 8.0, 448.0, msl=False)
    assert ellipsoid.height(410.0, 458.0) == 458.0
    assert ellipsoid.height(410.0, None) is None
    assert FleetFrame(47.0, 8.0, 448.0, False, 48.0).height(410.0, None) == 458.0
    assert FleetFrame(47.0, 8.0, 400.0, True, 48.0).height(None, 458.0) == 410.0


@given(ANGLE, ANGLE, ANGLE, PLACE)
def test_rotation_is_that_of_the_aerospace_angles(
    roll: float, pitch: float, yaw: float, vector: tuple[float, float, float]
) -> None:
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    expected = about_z @ about_y @ about_x @ vector
    assert rotated(from_euler(roll, pitch, yaw), vector) == pytest.approx(tuple(expected), abs=1e-9)


@given(ANGLE, st.floats(0, 1))
def test_interpolation_turns_at_a_constant_rate_and_the_short_way(angle: float, share: float) -> None:
    first, second = from_euler(0, 0, 0), from_euler(0, 0, angle)
    expected = rotated(from_euler(0, 0, share * angle), (1.0, 0.0, 0.0))
    negated = tuple(-component for component in second)
    for end in (second, negated):
        assert rotated(interpolated(first, end, share), (1.0, 0.0, 0.0)) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("bad", [(0, 0, 0, 0), (math.nan, 0, 0, 1), (2, 0, 0, 0), (math.inf, 0, 0, 0)])
def test_what_is_no_unit_quaternion_is_refused(bad: tuple[float, float, float, float]) -> None:
    assert normalised(bad) is None


def test_normal_gravity_has_the_published_values() -> None:
    assert normal_gravity_mps2(0.0, 0.0) == pytest.approx(9.7803253359, abs=1e-9)
    assert normal_gravity_mps2(90.0, 0.0) == pytest.approx(9.8321849379, abs=1e-8)
    assert normal_gravity_mps2(45.0, 0.0) - normal_gravity_mps2(45.0, 1000.0) == pytest.approx(3.084e-3, abs=1e-5)


def test_configured_gravity_is_used(make_config: Callable[..., FleetConfig]) -> None:
    assert gravity_mps2(make_config()) == 9.80665
