"""Ranges hold a drone if there are enough of them, in directions that are not all in one plane."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.range_geometry import GeometryMonitor, RangeGeometry, directions, spread
from estimators.integrity.thresholds import DIRECTIONS, HELD_SPREAD, RANGED_TICKS

HERE = np.array([1.0, 2.0, -6.0])
TRIANGLE = np.array([[8.0, 0.0, 0.0], [-6.0, 7.0, 0.0], [-5.0, -8.0, 0.0]])


def observe(here: np.ndarray, places: np.ndarray, age_ticks: float = 0.0) -> tuple[Finding, ...]:
    return GeometryMonitor().observe(RangeGeometry.of(here, places, np.full(len(places), age_ticks)))


def test_three_located_drones_below_hold_a_drone() -> None:
    assert observe(HERE, TRIANGLE) == ()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_do_not(count: int) -> None:
    assert observe(HERE, TRIANGLE[:count]) == (
        Finding(What.TOO_FEW_RANGED, Gravity.ALARM, value=count, limit=DIRECTIONS),
    )


def test_a_drone_in_the_plane_of_the_others_is_not_held_across_it_however_many_they_are() -> None:
    around = np.array([[9.0 * np.cos(a), 9.0 * np.sin(a), 0.0] for a in np.linspace(0.0, 6.0, 12)])
    assert observe(np.zeros(3), around) == (Finding(What.ONE_PLANE, Gravity.ALARM, value=2, limit=DIRECTIONS),)
    in_line = np.array([[d, 0.0, 0.0] for d in (5.0, -7.0, 9.0)])
    assert observe(np.zeros(3), in_line) == (Finding(What.ONE_PLANE, Gravity.ALARM, value=1, limit=DIRECTIONS),)


def test_about_ten_degrees_out_of_the_plane_of_three_begin_to_hold() -> None:
    def elevated(degrees: float) -> np.ndarray:
        above = 9.0 * np.tan(np.radians(degrees))
        return np.array([[9.0 * np.cos(a), 9.0 * np.sin(a), above] for a in (0.0, 2.1, 4.2)])

    assert [f.what for f in observe(np.zeros(3), elevated(4.0))] == [What.ONE_PLANE]
    assert observe(np.zeros(3), elevated(12.0)) == ()


def test_a_range_that_is_too_old_holds_nothing_and_one_at_the_limit_does() -> None:
    assert observe(HERE, TRIANGLE, RANGED_TICKS) == ()
    assert [f.value for f in observe(HERE, TRIANGLE, RANGED_TICKS + 1)] == [0]


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 100.0))
def test_what_is_found_depends_on_neither_axes_nor_scale_nor_order(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    here, places = rng.normal(size=3), rng.normal(size=(4, 3)) * np.array([1.0, 1.0, rng.choice([0.0, 1.0])])
    here[2] *= float(rng.integers(2))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    assume(np.min(np.abs(spread(directions(here, places)) - HELD_SPREAD)) > 1e-6)  # else rounding decides
    turned = observe(scale * (turn @ here) + 5.0, scale * (places[::-1] @ turn.T) + 5.0)
    assert turned == observe(here, places)
