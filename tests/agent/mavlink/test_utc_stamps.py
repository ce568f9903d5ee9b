"""UTC of fixes on another clock: what is taken for an offset of the clocks, and what for a late fix."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.mavlink.utc_stamps import ROLLOVER_S, UtcStamps, unrolled

UNIX_S = 1.8e9


def shifts(late_s: list[float]) -> list[float | None]:
    """What is added to the stamps of fixes that come so late."""
    stamps = UtcStamps()
    return [stamps.shift_s(UNIX_S + 0.2 * k, UNIX_S + 0.2 * k + each) for k, each in enumerate(late_s)]


@given(st.lists(st.floats(0.0, 0.45), min_size=1, max_size=60))
def test_fixes_of_a_clock_that_agrees_are_left_alone(late_s: list[float]) -> None:
    assert shifts(late_s) == [0.0] * len(late_s)


@given(
    st.floats(-1e9, 1e9).filter(lambda s: not -2.3 < s < 0.6), st.lists(st.floats(0.0, 0.3), min_size=3, max_size=60)
)
def test_fixes_of_another_clock_are_shifted_by_what_the_quickest_are_late(
    apart_s: float, late_s: list[float]
) -> None:
    found = shifts([apart_s + each for each in late_s])
    assert found[:2] == [None, None]
    assert all(each == pytest.approx(apart_s + 0.15, abs=0.16) for each in found[2:])


def test_late_fixes_among_quick_ones_and_single_wrong_stamps_move_nothing() -> None:
    late_s = [0.1, 0.2, 4.0, 0.1, 0.3, 1e6, 0.1, -50.0, 0.2, 1.4, 0.1]
    assert shifts(late_s) == [0.0] * len(late_s)


def test_a_clock_that_is_set_in_flight_is_followed_after_three_fixes() -> None:
    found = shifts([0.1] * 10 + [3600.1] * 5 + [0.1] * 5)
    assert found[:12] == [0.0] * 12
    assert found[12:15] == pytest.approx([3600.1] * 3)
    assert found[17:] == [0.0] * 3


@given(st.floats(1.3e9, 2e9), st.integers(-3, 3), st.floats(-1e6, 1e6))
def test_the_turns_of_the_week_are_those_that_bring_it_near(unix_s: float, turns: int, off_s: float) -> None:
    assert unrolled(unix_s + turns * ROLLOVER_S, unix_s + off_s) == pytest.approx(unix_s, abs=1e-5)
