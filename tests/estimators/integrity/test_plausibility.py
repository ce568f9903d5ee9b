"""Measurements that cannot be: out of all reach of the estimate."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.integrity.finding import Gravity, What
from estimators.integrity.plausibility import PlausibilityMonitor, Presented
from estimators.model.measurements import (
    RowTable,
    anchor_range_row,
    position_rows,
    range_row,
    relative_rows,
    speed_row,
    velocity_rows,
)

PERIOD_S = 0.1
STATES = np.array([0.0, 0.0, -5.0, 10.0, 0.0, 0.0, 30.0, 40.0, -5.0, 0.0, 0.0, 0.0])
"""Drone 1 flies north at 10 m/s, drone 2 hovers 50 m away."""


def presented(rows: RowTable, tick: int = 100, *, sigma: float = 0.1, mean: np.ndarray = STATES) -> Presented:
    return Presented(tick, (1, 2), rows, 99, mean, np.full(12, sigma))


def refused(rows: RowTable, **options: float) -> list[bool]:
    monitor = PlausibilityMonitor(1, PERIOD_S)
    monitor.observe(presented(rows, **options))
    return monitor.refused.tolist()


@pytest.mark.parametrize(("off_m", "expected"), [(0.0, False), (900.0, False), (1100.0, True), (1e6, True)])
def test_a_fix_is_impossible_a_kilometre_from_where_the_drone_is(off_m: float, expected: bool) -> None:
    # GIVEN a drone that has flown 1 m since the estimate
    rows = position_rows(100, 0, [1.0 + off_m, 0.0, -5.0], [1e-14] * 3)
    assert refused(rows) == [expected] * 3  # all of it or nothing
    # an estimate that is unsure by 100 m refuses nothing nearer than 600 m more
    assert refused(rows, sigma=100.0) == [off_m > 1600.0] * 3


@pytest.mark.parametrize(("off", "expected"), [(0.0, False), (90.0, False), (110.0, True)])
def test_a_velocity_and_a_speed_are_impossible_beyond_a_hundred_metres_a_second(off: float, expected: bool) -> None:
    assert refused(velocity_rows(100, 0, [10.0, off, 0.0], [0.1] * 3)) == [expected] * 3
    assert refused(speed_row(100, 0, 10.0 + off, 0.1)) == [expected]


@pytest.mark.parametrize(("off_m", "expected"), [(0.0, False), (900.0, False), (1100.0, True)])
def test_a_range_is_impossible_a_kilometre_from_the_distance(off_m: float, expected: bool) -> None:
    assert refused(range_row(100, 0, 1, 49.4 + off_m, 0.01)) == [expected]
    assert refused(anchor_range_row(100, 0, [1.0, 100.0, -5.0], 100.0 + off_m, 0.01)) == [expected]


@pytest.mark.parametrize(("off_m", "expected"), [(0.0, False), (900.0, False), (1100.0, True)])
def test_a_sighting_is_impossible_as_a_whole_and_no_other_one_with_it(off_m: float, expected: bool) -> None:
    # GIVEN what drone 1 sees of two others in one picture, of which it is wrong about the distance to the second
    mean = np.concatenate((STATES, [1.0, 0.0, 45.0, 0.0, 0.0, 0.0]))
    right = relative_rows(100, 0, 2, [0.0, 0.0, 50.0], 0.1, 0.1)
    far = relative_rows(100, 0, 1, np.array([29.0, 40.0, 0.0]) / 49.4 * (49.4 + off_m), 0.1, 0.1)
    monitor = PlausibilityMonitor(1, PERIOD_S)
    monitor.observe(Presented(100, (1, 2, 3), np.concatenate((right, far)), 99, mean, np.full(18, 0.1)))
    assert monitor.refused.tolist() == [False] * 3 + [expected] * 3


def test_of_whom_nothing_is_believed_nothing_is_impossible() -> None:
    mean = np.array([*STATES[:6], *[np.nan] * 6])
    rows = np.concatenate((position_rows(100, 1, [1e6, 0.0, 0.0], [0.1] * 3), range_row(100, 0, 1, 9e4, 0.1)))
    monitor = PlausibilityMonitor(1, PERIOD_S)
    assert monitor.observe(presented(rows, mean=mean)) == ()
    assert not monitor.refused.any()


def test_it_is_told_for_a_second_and_an_alarm_where_it_is_the_own() -> None:
    monitor = PlausibilityMonitor(1, PERIOD_S)
    (own,) = monitor.observe(presented(position_rows(100, 0, [1e4, 0.0, -5.0], [0.1] * 3)))
    assert (own.what, own.gravity, own.about) == (What.IMPOSSIBLE, Gravity.ALARM, 1)
    assert own.value == pytest.approx(1e4, abs=2.0)
    other = range_row(101, 1, 0, 9e4, 0.1)
    found = monitor.observe(presented(other, 101))
    assert [(each.gravity, each.about) for each in found] == [(Gravity.ALARM, 1), (Gravity.DEGRADED, 2)]
    empty = other[:0]
    assert {each.about for each in monitor.observe(presented(empty, 110))} == {1, 2}
    assert {each.about for each in monitor.observe(presented(empty, 111))} == {2}
    assert monitor.observe(presented(empty, 112)) == ()


def test_who_is_refused_for_three_seconds_one_and_all_is_shut_out() -> None:
    monitor = PlausibilityMonitor(1, PERIOD_S)
    far, near = ([1e4, 0.0, -5.0], [0.0, 0.0, -5.0])
    for tick in range(100, 160, 2):
        place = near if tick == 120 else far
        monitor.observe(presented(position_rows(tick, 0, place, [0.1] * 3), tick))
        # THEN one that was taken counts for all before it
        assert monitor.shut_out() == ((1,) if tick - 120 >= 30 else ())
    monitor.forget()
    assert monitor.shut_out() == ()
