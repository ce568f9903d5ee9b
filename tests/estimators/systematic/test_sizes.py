"""Sizes of the slow errors' priors: how they begin, what they follow, and within which limits."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from estimators.model.layout import Layout
from estimators.model.measurements import empty_rows
from estimators.model.members import MemberChange
from estimators.model.unknown_motion import TILTED_MPS2
from estimators.systematic import slow_errors
from estimators.systematic.sizes import ACCEL_MPS2, PAIR_M, SystematicSizes

Array = NDArray[np.float64]
DT = 0.1


def taught(agents: int, errors: Array, ticks: int = 300) -> SystematicSizes:
    """Without any row, by estimates of the errors that are sure."""
    sizes = SystematicSizes(Layout(tuple(range(1, agents + 1))), DT)
    for _ in range(ticks):
        nothing = np.zeros(3 * agents)
        sizes.learn(empty_rows(), nothing, nothing + 0.1, errors, np.full(len(errors), 1e-12))
    return sizes


@pytest.mark.parametrize("agents", [1, 2, 5])
def test_the_first_sizes_are_positive_and_equal_for_all(agents: int) -> None:
    sizes = SystematicSizes(Layout(tuple(range(1, agents + 1))), DT).sizes()
    assert sizes.shape == (slow_errors.count(agents),)
    assert (sizes > 0.0).all()
    assert np.ptp(sizes[slow_errors.pairs(agents)] if agents > 1 else [0.0]) == 0.0
    for slot in range(agents):
        np.testing.assert_array_equal(sizes[slow_errors.wander_of(slot)], sizes[slow_errors.wander_of(0)])
        np.testing.assert_allclose(sizes[slow_errors.acceleration_of(slot, agents)], ACCEL_MPS2[0])


@pytest.mark.parametrize("agents", [1, 3])
def test_own_and_common_wander_together_are_the_receivers(agents: int) -> None:
    made = SystematicSizes(Layout(tuple(range(1, agents + 1))), DT)
    sizes = made.sizes()
    whole = sizes[slow_errors.wander_of(0)] ** 2 + sizes[slow_errors.common(agents)] ** 2
    assert whole == pytest.approx(made._wanders.sizes_m()[0] ** 2, rel=1e-5)
    if agents == 1:
        assert (sizes[slow_errors.common(agents)] < 0.01).all()  # nobody to share it with


@pytest.mark.parametrize(("error_mps2", "expected"), [(0.0, 0.02), (0.1, 0.1), (5.0, 1.0)])
def test_the_error_of_accelerations_follows_its_estimates(error_mps2: float, expected: float) -> None:
    errors = np.zeros(slow_errors.count(2))
    errors[slow_errors.acceleration_of(1, 2)] = error_mps2 * np.array([1.0, -1.0, 1.0])
    sizes = taught(2, errors).sizes()
    # and without fixes, as here, the horizontal ones are at least those of a tilted attitude
    across = max(expected, TILTED_MPS2)
    np.testing.assert_allclose(sizes[slow_errors.acceleration_of(1, 2)], [across, across, expected], rtol=0.02)
    still = [TILTED_MPS2, TILTED_MPS2, ACCEL_MPS2[1]]
    np.testing.assert_allclose(sizes[slow_errors.acceleration_of(0, 2)], still, rtol=0.02)


@pytest.mark.parametrize("bias_m", [0.0, 0.2, 5.0])
def test_the_bias_of_ranges_stays_within_its_limits(bias_m: float) -> None:
    errors = np.zeros(slow_errors.count(3))
    errors[slow_errors.pairs(3)] = bias_m
    size = taught(3, errors).sizes()[slow_errors.pairs(3)]
    # where nobody knows how far receivers wander, ranges cannot tell: not less than at the start
    np.testing.assert_allclose(size, min(max(bias_m, PAIR_M[0]), PAIR_M[2]), rtol=0.02)


def test_one_bad_pair_is_not_all() -> None:
    errors = np.zeros(slow_errors.count(4))
    errors[slow_errors.pair_of(0, 1, 4)] = 5.0
    assert (taught(4, errors).sizes()[slow_errors.pairs(4)] <= PAIR_M[0]).all()


def test_who_stays_keeps_his_size() -> None:
    errors = np.zeros(slow_errors.count(2))
    errors[slow_errors.acceleration_of(1, 2)] = 0.8
    made = taught(2, errors)
    made.change_members(MemberChange.between(Layout((1, 2)), (7, 2), 2, {7: (np.zeros(6), np.eye(6))}))
    sizes = made.sizes()
    np.testing.assert_allclose(sizes[slow_errors.acceleration_of(1, 2)], 0.8, rtol=0.02)
    np.testing.assert_allclose(sizes[slow_errors.acceleration_of(0, 2)], ACCEL_MPS2[0])
