"""The measurement window: whatever the order of arrival, every record in its place, once; and how it slides."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.algorithms.moving_horizon import MovingHorizonEstimator
from estimators.estimator import Status
from estimators.factory import make_estimator
from estimators.model.layout import Layout
from estimators.model.measurements import (
    Kind,
    RowTable,
    empty_inputs,
    empty_rows,
    input_rows,
    position_rows,
    range_row,
    speed_row,
    velocity_rows,
)
from estimators.settings import EstimatorSettings
from estimators.settings import Kind as EstimatorKind
from estimators.window.history import MeasurementWindow
from estimators.window.solving import solve_window
from tests.support import builders

ESTIMATORS: tuple[EstimatorKind, ...] = ("dmhe_pre_ekf", "dmhe", "dekf_ci", "centralized_ekf")
FLEET = Layout((1, 2, 3))


def window_at(tick: int, ticks: int = 2, **options: str) -> MeasurementWindow:
    window = MeasurementWindow(FLEET, ticks, other_accel_variance=4 / 3, **options)  # type: ignore[arg-type]
    window.advance(tick)
    return window


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_any_order_of_arrival_gives_the_same_window(seed: int) -> None:
    # GIVEN the records of a window, in packets of any size, in any order, some of them repeated
    rng = np.random.default_rng(seed)
    problem, _ = builders.random_window(np.random.default_rng(seed % 7), ticks=3)
    rows = problem.rows
    shuffled = rng.permutation(np.concatenate([rows, rows[rng.integers(0, len(rows), 5)]]))
    packets = np.split(shuffled, np.sort(rng.integers(0, len(shuffled), 4)))
    window = window_at(3, ticks=3)
    for packet in packets:
        window.insert(packet, empty_inputs())
    # THEN the window holds each once, in one order, so that its solution is the same bit by bit
    found, start = window.rows()
    np.testing.assert_array_equal(found, rows)
    np.testing.assert_array_equal(start, problem.start)
    table = EstimatorSettings(tolerance=1e-9)
    solution, expected = (
        solve_window(each, table) for each in (problem._replace(rows=found, start=start), problem)
    )
    np.testing.assert_allclose(solution.path, expected.path, rtol=0, atol=1e-12)
    np.testing.assert_allclose(solution.next_information, expected.next_information, rtol=1e-12)


@pytest.mark.parametrize("kind", ["dmhe_pre_ekf", "dmhe"])
def test_late_rows_give_the_estimate_of_rows_in_time(kind: EstimatorKind) -> None:
    # GIVEN two estimators with the same prior; one gets a tick's rows and inputs one tick late, out of order
    rng = np.random.default_rng(6)
    truth, accel = builders.fly(rng, 3, 4, 0.1)
    kinds = [(slot, kind) for slot in range(3) for kind in (Kind.POSITION, Kind.RANGE)]
    tables = [[builders.row_of(kind, rng, tick, slot, 3) for slot, kind in kinds] for tick in range(5)]
    rows = [builders.measured(builders.joined(table), truth, 1e-3, rng) for table in tables]
    table = EstimatorSettings(kind=kind, window=4, tolerance=1e-9)
    in_time, late = (
        MovingHorizonEstimator(table, FLEET, 0, truth[0] + 0.1, np.eye(18), 0.1) for _ in range(2)
    )
    for tick in range(5):
        inputs = builders.all_inputs(tick, accel, 0.01)
        in_time.begin(tick, rows[tick], inputs)
        if tick == 3:
            late.begin(tick, empty_rows(), empty_inputs())
        elif tick == 4:
            before = builders.all_inputs(3, accel, 0.01)
            late.arrival = in_time.arrival  # while the window grows, each tick's solution moves it
            late.begin(tick, np.concatenate([rows[4], rows[3]])[::-1], np.concatenate([inputs, before]))
        else:
            late.begin(tick, rows[tick], inputs)
        estimates = in_time.solve(), late.solve()
        # THEN they differ while the rows are missing, and agree once they are there
        difference = np.abs(estimates[0].mean - estimates[1].mean).max()
        assert difference > 1e-3 if tick == 3 else difference < 1e-12
    assert late.dropped == 0


def test_rows_go_to_their_tick() -> None:
    window = window_at(10)
    tables = [position_rows(t, 0, np.full(3, float(t)), np.ones(3)) for t in (8, 9, 10, 11)]
    window.insert(np.concatenate(tables[::-1]), empty_inputs())
    rows, start = window.rows()
    # what is newer than the window waits for its tick
    np.testing.assert_array_equal(start, [0, 3, 6, 9])
    for table, (a, b) in zip(tables, pairwise(start), strict=False):
        np.testing.assert_array_equal(np.sort(rows[a:b], order="x"), np.sort(table, order="x"))
    window.advance(11)
    rows, start = window.rows()
    assert rows["tick"].tolist() == [9] * 3 + [10] * 3 + [11] * 3
    assert start.tolist() == [0, 3, 6, 9]


def test_too_late_is_counted_and_ignored() -> None:
    window = window_at(10)
    window.insert(position_rows(7, 0, np.zeros(3), np.ones(3)), input_rows(7, 0, np.ones(3), 1.0))
    window.insert(position_rows(8, 0, np.zeros(3), np.ones(3)), input_rows(8, 0, np.ones(3), 1.0))
    assert window.dropped == 4
    assert window.refused == 0
    assert len(window.rows()[0]) == 3


@pytest.mark.parametrize("kind", ESTIMATORS)
def test_estimators_count_what_is_too_late(kind: EstimatorKind) -> None:
    estimator = make_estimator(EstimatorSettings(kind=kind), FLEET, 0, np.zeros(18), np.eye(18), 0.1)
    for tick in range(6):
        late = position_rows(tick - 4, 1, np.zeros(3), np.ones(3)) if tick >= 4 else empty_rows()
        now = position_rows(tick, 0, np.zeros(3), np.ones(3))
        estimator.begin(tick, np.concatenate([late, now]), empty_inputs())
        estimator.solve()
    assert estimator.dropped == 6


def test_same_instant_by_different_sensors_is_not_a_repetition() -> None:
    # GIVEN rows that differ in one part of their identity each
    window = window_at(2)
    base = range_row(2, 0, 1, 5.0, 0.1)
    others = [
        range_row(1, 0, 1, 5.0, 0.1),
        range_row(2, 0, 1, 5.0, 0.1, offset_s=0.01),
        range_row(2, 0, 2, 5.0, 0.1),
        range_row(2, 1, 0, 5.0, 0.1),
        speed_row(2, 0, 5.0, 0.1),
        position_rows(2, 0, np.full(3, 5.0), np.ones(3), observer=1),
        position_rows(2, 0, np.full(3, 5.0), np.ones(3)),
        velocity_rows(2, 0, np.full(3, 5.0), np.ones(3)),
    ]
    window.insert(np.concatenate([base, *others]), empty_inputs())
    window.insert(np.concatenate([base, *others]), empty_inputs())
    assert len(window.rows()[0]) == 6 + 9
    assert window.dropped == window.refused == 0


def test_first_report_of_an_input_stays() -> None:
    window = window_at(2)
    window.insert(empty_rows(), input_rows(1, 2, [1.0, 2.0, 3.0], 0.5))
    window.insert(empty_rows(), input_rows(1, 2, [9.0, 9.0, 9.0], 0.1))
    accel, variance = window.inputs()
    np.testing.assert_array_equal(accel, [[0.0] * 9, [0.0] * 6 + [1.0, 2.0, 3.0]])
    np.testing.assert_array_equal(variance[0], np.full(9, 4 / 3))
    np.testing.assert_array_equal(variance[1], [4 / 3] * 6 + [0.5] * 3)


def test_one_exchange_seen_from_both_ends_is_used_once() -> None:
    # GIVEN ranges 0-1 from both ends in one tick, from the upper end alone in another, and one to a third agent
    rows = np.concatenate(
        [range_row(1, 1, 0, 5.1, 0.1), range_row(2, 0, 1, 5.0, 0.1), range_row(2, 1, 0, 5.1, 0.1),
         range_row(2, 1, 2, 7.0, 0.1)]
    )  # fmt: skip

    def used(reciprocal: str) -> list[tuple[int, int, int]]:
        window = window_at(2, reciprocal_ranges=reciprocal)
        window.insert(rows, empty_inputs())
        table, start = window.rows()
        assert start[-1] == len(table)
        return [(int(r["tick"]), int(r["agent"]), int(r["other"])) for r in table]

    # THEN "independent" uses all, "shared" the lower end's where there is one
    assert used("independent") == [(1, 1, 0), (2, 0, 1), (2, 1, 0), (2, 1, 2)]
    assert used("shared") == [(1, 1, 0), (2, 0, 1), (2, 1, 2)]


def test_ages_of_the_agents() -> None:
    # GIVEN a window whose first tick is 3: of what came before nothing is known
    window = window_at(3)
    assert window.ages().tolist() == [1, 1, 1]
    window.advance(5)
    # WHEN agent 0 observes agent 1 at tick 4 and a pair of agent 2 speaks of tick 5
    window.insert(position_rows(4, 1, np.zeros(3), np.ones(3), observer=0), empty_inputs())
    window.hear(2, 5)
    # THEN it is the observers that were heard
    assert window.ages().tolist() == [1, 3, 0]
    window.advance(9)
    assert window.ages().tolist() == [5, 7, 4]
    window.hear(0, 2)  # older than what is known
    assert window.ages().tolist() == [5, 7, 4]


# --- how an estimator slides its window -------------------------------------------------------------------------


def fix(tick: int, slot: int = 0) -> RowTable:
    return position_rows(tick, slot, np.full(3, 0.1 * tick), np.full(3, 0.01))


def test_window_grows_to_its_length_and_then_slides() -> None:
    # GIVEN a moving horizon estimator with N = 3 that starts at tick 5
    table = EstimatorSettings(window=3)
    estimator = make_estimator(table, FLEET, 0, np.zeros(18), np.eye(18), 0.1)
    firsts, priors = [], []
    for tick in range(5, 13):
        estimator.begin(tick, fix(tick), input_rows(tick - 1, 0, np.zeros(3), 0.01))
        firsts.append(estimator.outgoing(0).tick)
        priors.append(estimator.outgoing(0).information.copy())
        estimator.mix(0, {})
        estimate = estimator.solve()
        assert estimate.tick == tick
        assert estimate.status is Status.OK
    # THEN the window starts at 5 until it is full, and the arrival cost moves from t = N on (t < N in line 18)
    assert firsts == [5, 5, 5, 5, 6, 7, 8, 9]
    for k in range(3):
        np.testing.assert_array_equal(priors[k + 1], priors[k])
    for k in range(3, 7):
        assert np.abs(priors[k + 1] - priors[k]).max() > 1e-3


@pytest.mark.parametrize("kind", ESTIMATORS)
def test_first_tick(kind: EstimatorKind) -> None:
    # GIVEN rows at the first tick
    estimator = make_estimator(EstimatorSettings(kind=kind), FLEET, 0, np.ones(18), 4 * np.eye(18), 0.1)
    estimator.begin(0, fix(0), empty_inputs())
    estimate = estimator.solve()
    # THEN a moving horizon estimator reports its prior (it has no window yet), a filter has used them
    assert estimate.status is Status.OK
    if kind in ("dmhe_pre_ekf", "dmhe"):
        np.testing.assert_array_equal(estimate.mean, np.ones(18))
        np.testing.assert_allclose(estimate.covariance, 4 * np.eye(18), rtol=1e-14)
    else:
        np.testing.assert_allclose(estimate.mean[:3], 0.01 / 4.01, rtol=1e-9)
        np.testing.assert_allclose(np.diag(estimate.covariance)[:3], 4 * 0.01 / 4.01, rtol=1e-9)


@pytest.mark.parametrize("kind", ESTIMATORS)
def test_ages_and_no_data(kind: EstimatorKind) -> None:
    # GIVEN an agent that hears from agent 2 until tick 3 and from nobody afterwards
    estimator = make_estimator(EstimatorSettings(kind=kind), FLEET, 0, np.zeros(18), np.eye(18), 0.1)
    estimates = []
    for tick in range(8):
        rows = np.concatenate([fix(tick), fix(tick, 1)]) if tick <= 3 else empty_rows()
        estimator.begin(tick, rows, empty_inputs())
        estimates.append(estimator.solve())
    assert estimates[3].age_ticks.tolist() == [0, 0, 4]
    assert estimates[7].age_ticks.tolist() == [4, 4, 8]
    # THEN it says so once nothing is left in its window (2 ticks back) or, for a filter, in its tick
    still = 5 if kind in ("dmhe_pre_ekf", "dmhe") else 3
    assert [e.status for e in estimates] == [Status.OK] * (still + 1) + [Status.NO_DATA] * (7 - still)


@pytest.mark.parametrize("kind", ESTIMATORS)
@pytest.mark.parametrize("then", [3, 4, 6, 0])
def test_ticks_grow_by_one(kind: EstimatorKind, then: int) -> None:
    estimator = make_estimator(EstimatorSettings(kind=kind), FLEET, 0, np.zeros(18), np.eye(18), 0.1)
    estimator.begin(4, empty_rows(), empty_inputs())
    estimator.solve()
    with pytest.raises(ValueError, match=f"tick {then} after 4: ticks grow by one"):
        estimator.begin(then, empty_rows(), empty_inputs())


def test_centralised_filter_has_no_neighbours() -> None:
    estimator = make_estimator(EstimatorSettings(kind="centralized_ekf"), FLEET, 0, np.zeros(18), np.eye(18), 0.1)
    estimator.begin(0, empty_rows(), empty_inputs())
    assert estimator.rounds == 0
    with pytest.raises(RuntimeError, match="exchanges nothing"):
        estimator.outgoing(0)
    with pytest.raises(RuntimeError, match="exchanges nothing"):
        estimator.mix(0, {})


def test_layout_errors() -> None:
    with pytest.raises(ValueError, match="distinct"):
        Layout((1, 1))
    with pytest.raises(ValueError, match="at least one"):
        Layout(())
    with pytest.raises(KeyError, match=r"agent 9 is not in the fleet \(1, 2, 3\)"):
        FLEET.slot(9)
    assert FLEET.slot(3) == 2
    assert FLEET.dimension == 18
