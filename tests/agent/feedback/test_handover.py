"""How a feed begins: at the autopilot's own position, and from there to the estimate."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.feedback.handover import LARGEST_HORIZONTAL_M, RATE_MPS, Handover

METRES = st.floats(-6.0, 6.0)


def test_it_begins_where_the_autopilot_believes_to_be_and_ends_at_the_estimate() -> None:
    handover = Handover()

    handover.begin(np.array((0.6, -0.8, 2.0)), 10.0)
    assert handover.shift_m == pytest.approx((-0.6, 0.8, -2.0))
    handover.go_on(11.0)
    assert handover.shift_m == pytest.approx((-0.36, 0.48, -1.6))
    assert handover.rate_mps == pytest.approx((0.24, -0.32, 0.4))
    handover.go_on(20.0)
    assert handover.shift_m.tolist() == [0.0, 0.0, 0.0]
    handover.go_on(20.1)
    assert handover.rate_mps.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("apart_m", [None, (3.1, 0.0, 0.0), (0.0, 0.0, 7.0), (math.nan, 0.0, 0.0)])
def test_an_autopilot_that_is_lost_or_says_nothing_is_set_to_the_estimate(
    apart_m: tuple[float, float, float] | None,
) -> None:
    handover = Handover()
    handover.begin(np.array((0.5, 0.5, 0.5)), 9.0)

    handover.begin(None if apart_m is None else np.array(apart_m), 10.0)

    assert handover.shift_m.tolist() == [0.0, 0.0, 0.0]


@given(st.tuples(METRES, METRES, METRES), st.lists(st.floats(0.0, 3.0), min_size=1, max_size=30))
def test_it_never_turns_grows_or_hurries(apart_m: tuple[float, float, float], pauses_s: list[float]) -> None:
    handover, at_s = Handover(), 0.0
    handover.begin(np.array(apart_m), at_s)
    for pause_s in pauses_s:
        before_m = handover.shift_m
        at_s += pause_s
        change_m = handover.go_on(at_s)

        assert before_m + change_m == pytest.approx(handover.shift_m)
        assert handover.rate_mps * pause_s == pytest.approx(change_m)
        assert np.hypot(*change_m[:2]) <= RATE_MPS * pause_s + 1e-9
        assert abs(change_m[2]) <= RATE_MPS * pause_s + 1e-9
        assert (handover.shift_m * before_m >= 0.0).all()
        assert (np.abs(handover.shift_m) <= np.abs(before_m) + 1e-12).all()
    assert np.hypot(*handover.shift_m[:2]) <= LARGEST_HORIZONTAL_M
