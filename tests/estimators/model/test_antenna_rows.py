"""Rows of antennas beside the bodies: value, gradient, and what tells one antenna from another."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimators.integrity.observability import row_jacobian
from estimators.model.layout import Layout
from estimators.model.measurements import empty_inputs, is_shifted, range_row, speed_row
from estimators.model.second_order import linearisation_variance
from estimators.window.history import MeasurementWindow

EPS, STEP = 1e-3, 1e-5
VECTOR = st.tuples(*[st.floats(-2.0, 2.0)] * 3)


@given(VECTOR, VECTOR, st.floats(-0.05, 0.05), st.integers(0, 10_000))
def test_value_and_gradient_are_those_of_the_antennas(
    between: tuple[float, float, float], moves: tuple[float, float, float], offset_s: float, seed: int
) -> None:
    # GIVEN two drones, a range between antennas and the speed of one
    state = 10.0 * np.random.default_rng(seed).normal(size=12)
    ranged = range_row(0, 1, 0, 9.0, 0.01, offset_s=offset_s, shift_m=between)
    rows = np.concatenate([ranged, speed_row(0, 1, 2.0, 0.04, shift_mps=moves)])

    def truth(x: np.ndarray) -> np.ndarray:
        away = x[6:9] + offset_s * x[9:] - x[:3] - offset_s * x[3:6] + between
        return np.sqrt([away @ away + EPS**2, (x[9:] + moves) @ (x[9:] + moves) + EPS**2])

    # THEN the rows say the distance of the antennas and the antenna's speed
    predicted, jacobian = row_jacobian(rows, state, EPS)
    assert predicted == pytest.approx(truth(state), rel=1e-12)
    # AND their gradient is that of the numeric twin
    numeric = np.array([(truth(state + p) - truth(state - p)) / (2 * STEP) for p in STEP * np.eye(12)]).T
    np.testing.assert_allclose(jacobian, numeric, atol=2e-7)


def test_a_shift_is_as_good_as_a_moved_drone_where_the_linearisation_is_judged() -> None:
    state, covariance, arm = 5.0 * np.arange(12.0), np.diag(np.arange(1.0, 13.0)), np.array([0.3, -0.2, 0.5])
    moved = state.copy()
    moved[:3] += arm
    found = linearisation_variance(range_row(0, 0, 1, 1.0, 0.01, shift_m=arm)[0], state, covariance, EPS)
    assert found == pytest.approx(linearisation_variance(range_row(0, 0, 1, 1.0, 0.01)[0], moved, covariance, EPS))
    assert found != pytest.approx(linearisation_variance(range_row(0, 0, 1, 1.0, 0.01)[0], state, covariance, EPS))
    faster = state.copy()
    faster[3:6] += arm
    found = linearisation_variance(speed_row(0, 0, 1.0, 0.01, shift_mps=arm)[0], state, covariance, EPS)
    assert found == pytest.approx(linearisation_variance(speed_row(0, 0, 1.0, 0.01)[0], faster, covariance, EPS))
    assert found != pytest.approx(linearisation_variance(speed_row(0, 0, 1.0, 0.01)[0], state, covariance, EPS))


def test_ranges_between_other_antennas_are_no_repetition() -> None:
    # GIVEN one exchange seen from both ends, and one between other antennas of the same drones in the same tick
    window = MeasurementWindow(Layout((1, 2)), 3, other_accel_variance=1.0, reciprocal_ranges="shared")
    window.open(0)
    rows = [
        range_row(0, 0, 1, 9.0, 0.01, shift_m=(0.3, 0.0, 0.0)),
        range_row(0, 1, 0, 9.0, 0.01, shift_m=(-0.3, 0.001, 0.0)),
        range_row(0, 1, 0, 9.2, 0.01, shift_m=(0.3, 0.0, 0.0)),
    ]
    window.insert(np.concatenate(rows), empty_inputs())
    # THEN the exchange counts once, the other as itself
    kept, _ = window.rows()
    assert sorted(kept["value"].tolist()) == [9.0, 9.2]
    assert is_shifted(kept)
    assert not is_shifted(range_row(0, 0, 1, 9.0, 0.01))
