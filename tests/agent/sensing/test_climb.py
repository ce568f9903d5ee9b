"""Speeds that may be the norm of all three axes: what a climb leaves of them."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.sensing.climb import without_climb
from agent.sensing.samples import GpsSample


def fix(speed_mps: float, *, may_be_norm: bool = True, sigma_mps: float = 0.1) -> GpsSample:
    return GpsSample(
        t_s=1.0,
        position_m=(0.0, 0.0, 0.0),
        horizontal_sigma_m=1.0,
        vertical_sigma_m=1.0,
        ground_velocity_mps=(0.6 * speed_mps, 0.8 * speed_mps),
        speed_mps=None,
        speed_sigma_mps=sigma_mps,
        fix_type=3,
        speed_may_be_norm=may_be_norm,
    )


@given(st.floats(0.0, 30.0), st.floats(0.0, 5.0))
def test_a_velocity_that_stays_covers_both_meanings(ground_mps: float, climb_mps: float) -> None:
    """GIVEN a receiver that gives the norm THEN the error is within the sigma left, or there is no velocity."""
    found = without_climb(fix(math.hypot(ground_mps, climb_mps)), climb_mps)
    if found.ground_velocity_mps is not None:
        assert math.hypot(*found.ground_velocity_mps) - ground_mps <= found.speed_sigma_mps + 1e-9
        assert 0.1 <= found.speed_sigma_mps <= math.hypot(0.1, 0.1) + 1e-9


def test_a_level_flight_keeps_its_velocity() -> None:
    level = without_climb(fix(5.0), 0.0)
    assert level == fix(5.0)
    assert without_climb(fix(5.0), 0.5).speed_sigma_mps == pytest.approx(math.hypot(0.1, 5.0 - math.sqrt(24.75)))


def test_in_a_climb_the_velocity_goes_and_the_place_stays() -> None:
    climbing = without_climb(fix(1.52), 1.5)
    assert climbing.ground_velocity_mps is None
    assert climbing.position_m == fix(1.52).position_m


def test_before_the_first_estimate_only_a_drone_at_rest_has_a_velocity() -> None:
    assert without_climb(fix(5.0), None).ground_velocity_mps is None
    assert without_climb(fix(0.05), None).ground_velocity_mps is not None


def test_a_speed_over_ground_is_left_alone() -> None:
    assert without_climb(fix(1.52, may_be_norm=False), 1.5) == fix(1.52, may_be_norm=False)
