"""Bodies of the state that are no vehicles: what is assumed of their motion, their limits and their ranges."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.factory import make_estimator
from estimators.model.layout import BodyKind, Layout, block, position
from estimators.model.limits import state_limits
from estimators.model.measurements import RowTable, empty_inputs, input_rows, position_rows, range_row
from estimators.model.unknown_motion import TARGET_ACCEL_VARIANCE
from estimators.settings import EstimatorSettings, LimitsTable, TargetLimits, VehicleLimits
from estimators.systematic import slow_errors
from estimators.systematic.sizes import DRIFT_M, TARGET_PAIR_M, TARGET_SENSOR_M, SystematicSizes
from estimators.window.assembly import open_window
from estimators.window.history import ANCHOR_ACCEL_VARIANCE

DT = 0.1
KINDS = {7: BodyKind.TARGET, 8: BodyKind.ANCHOR}
LAYOUT = Layout.of((1, 2, 7, 8), KINDS)


def test_a_layout_says_what_its_bodies_are() -> None:
    assert LAYOUT.kinds == (BodyKind.VEHICLE, BodyKind.VEHICLE, BodyKind.TARGET, BodyKind.ANCHOR)
    assert LAYOUT.target_slots == (2, 3)
    assert LAYOUT.is_vehicle.tolist() == [True, True, False, False]
    assert Layout((1, 2)) == Layout.of((1, 2))
    with pytest.raises(ValueError, match="1 kinds for 2 bodies"):
        Layout((1, 2), (BodyKind.TARGET,))


def test_unknown_accelerations_are_those_of_each_kind_also_after_a_change() -> None:
    settings = EstimatorSettings(kind="dmhe_shared", other_accel_variance=2.0)
    window = open_window(settings, LAYOUT, DT)
    for tick in (0, 1):
        window.open(tick)
    expected = np.repeat([2.0, 2.0, TARGET_ACCEL_VARIANCE, ANCHOR_ACCEL_VARIANCE], 3)
    np.testing.assert_array_equal(window.inputs()[1][0], expected)


def test_limits_are_those_of_each_kind() -> None:
    table = LimitsTable(vehicle=VehicleLimits(floor_m=10.0), target=TargetLimits(floor_m=-2.0, ceiling_m=5.0))
    limits = state_limits(EstimatorSettings(limits=table), LAYOUT)
    assert limits is not None
    assert limits.high[position(0)].tolist() == [np.inf, np.inf, -10.0]
    assert limits.low[position(2)].tolist() == [-np.inf, -np.inf, -5.0]
    assert limits.high[position(3)].tolist() == [np.inf, np.inf, 2.0]


def test_ranges_to_a_target_have_a_bias_of_their_own_size() -> None:
    sizes = SystematicSizes(LAYOUT, DT).sizes()
    agents = LAYOUT.size
    assert sizes[slow_errors.pair_of(0, 2, agents)] == TARGET_PAIR_M
    assert sizes[slow_errors.pair_of(2, 3, agents)] == TARGET_PAIR_M
    assert sizes[slow_errors.pair_of(0, 1, agents)] > TARGET_PAIR_M
    # and most of it is of the target's sensor
    assert sizes[slow_errors.drifts(agents)].tolist() == [DRIFT_M, DRIFT_M, TARGET_SENSOR_M, TARGET_SENSOR_M]


PLACES = np.array([[0.0, 0, -40], [30, 0, -50], [0, 30, -45], [30, 30, -60], [15, 5, 0]])
"""Four drones over a target."""


def rows(tick: int, rng: np.random.Generator, target: bool) -> RowTable:
    tables = [position_rows(tick, each, PLACES[each] + 0.1 * rng.normal(size=3), [0.01] * 3) for each in range(4)]
    for each in range(4 if target else 0):
        away = float(np.linalg.norm(PLACES[each] - PLACES[4]))
        tables.append(range_row(tick, each, 4, away + 0.1 * rng.normal(), 0.01))
    return np.concatenate(tables)


@pytest.mark.parametrize("kind", ["dmhe_pre_ekf", "dmhe_shared", "dekf_ci"])
@pytest.mark.parametrize("body", [BodyKind.TARGET, BodyKind.ANCHOR])
def test_a_target_that_joins_is_found_by_ranges_and_leaves_without_a_trace(kind: str, body: BodyKind) -> None:
    # GIVEN one drone's estimator of four hovering drones
    rng = np.random.default_rng(5)
    settings = EstimatorSettings(kind=kind, window=4, rounds=0, other_accel_variance=0.01)  # type: ignore[arg-type]
    mean = np.concatenate([[*place, 0, 0, 0] for place in PLACES[:4]])
    estimator = make_estimator(settings, Layout((1, 2, 3, 4)), 0, mean, np.eye(24), DT)

    def fly(first: int, last: int, target: bool) -> np.ndarray:
        for tick in range(first, last):
            push = [input_rows(tick - 1, each, np.zeros(3), 0.01) for each in range(4)]
            estimator.begin(tick, rows(tick, rng, target), np.concatenate(push) if tick else empty_inputs())
            found.append(estimator.solve())
        return found[-1].mean

    found: list = []
    fly(0, 10, target=False)
    # WHEN a target joins, some metres off
    prior = np.array([*(PLACES[4] + [4.0, -3.0, 5.0]), 0, 0, 0]), np.diag([25.0] * 3 + [0.25] * 3)
    estimator.change_members((1, 2, 3, 4, 9), 1, {9: prior}, {9: body})
    last = fly(10, 60, target=True)
    # THEN it is found, as sure as that is
    off = last[position(4)] - PLACES[4]
    assert np.linalg.norm(off) < 0.5
    covariance = found[-1].covariance[position(4), position(4)]
    assert float(off @ np.linalg.solve(covariance, off)) < 16.0
    # and what stands still is known to
    if body is BodyKind.ANCHOR:
        assert np.sqrt(found[-1].covariance.diagonal()[block(4)][3:].max()) < 0.15
    # WHEN it goes
    before = last[block(0)]
    estimator.change_members((1, 2, 3, 4), 1, {})
    assert estimator.layout == Layout((1, 2, 3, 4))
    assert fly(60, 61, target=False)[block(0)] == pytest.approx(before, abs=0.2)


def test_the_bias_of_a_targets_sensor_is_told_once_drones_have_been_around_it() -> None:
    # GIVEN four drones that circle a beacon at different heights, and ranges to it that are all 0.3 m too long
    rng, bias_m, beacon = np.random.default_rng(8), 0.3, np.array([5.0, 3.0, 0.0])
    period_s, lap_s = 0.5, 40.0

    def state(slot: int, tick: int) -> np.ndarray:
        phase, turn = 2.0 * np.pi * (tick * period_s / lap_s + slot / 4.0), 2.0 * np.pi / lap_s
        place = np.array([30.0 * np.cos(phase), 30.0 * np.sin(phase), -15.0 - 15.0 * slot])
        return np.concatenate([place, 30.0 * turn * np.array([-np.sin(phase), np.cos(phase), 0.0])])

    settings = EstimatorSettings(kind="dmhe_shared", window=5, rounds=0, systematic_errors=True)
    mean = np.concatenate([state(slot, 0) for slot in range(4)])
    estimator = make_estimator(settings, Layout((1, 2, 3, 4)), 0, mean, np.eye(24), period_s)
    last = None
    for tick in range(100):
        if tick == 10:
            prior = np.array([*(beacon + 1.0), 0.0, 0.0, 0.0]), np.diag([9.0] * 3 + [1e-7] * 3)
            estimator.change_members((1, 2, 3, 4, 9), 1, {9: prior}, {9: BodyKind.ANCHOR})
        at = [state(slot, tick) for slot in range(4)]
        tables = [position_rows(tick, s, at[s][:3] + 0.1 * rng.normal(size=3), [0.01] * 3) for s in range(4)]
        for slot in range(4 if tick >= 10 else 0):
            away = float(np.linalg.norm(at[slot][:3] - beacon)) + bias_m + 0.2 * rng.normal()
            tables.append(range_row(tick, slot, 4, away, 0.04))
        push = []
        for slot in range(4 if tick else 0):
            pushed = (at[slot][3:] - state(slot, tick - 1)[3:]) / period_s
            push.append(input_rows(tick - 1, slot, pushed, 0.01))
        estimator.begin(tick, np.concatenate(tables), np.concatenate(push) if tick else empty_inputs())
        last = estimator.solve()
    # THEN what is common to them is taken for the sensor's, as sure as that is, and the beacon is where it is
    assert last is not None
    assert last.range_biases is not None
    told, sigma = last.range_biases.target_m, last.range_biases.target_sigma_m
    assert abs(told[4] - bias_m) < min(0.1, 3.0 * sigma[4])
    assert np.isnan(told[:4]).all()
    assert last.range_biases.bias_m[0, 4] == pytest.approx(bias_m, abs=0.15)
    assert last.range_biases.sigma_m[0, 4] < 0.2
    assert np.linalg.norm(last.mean[position(4)] - beacon) < 0.3
