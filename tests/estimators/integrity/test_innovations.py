"""Whose measurements contradict the rest: what is told of a receiver that drifts, jumps, or is good."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.estimator import Estimate, Status
from estimators.factory import make_estimator
from estimators.integrity.finding import Finding, Gravity, What
from estimators.integrity.innovations import InnovationMonitor, Residuals
from estimators.model.layout import Layout, position
from estimators.model.measurements import Kind, empty_rows, input_rows, position_rows, range_row
from estimators.model.members import MemberChange
from estimators.settings import EstimatorSettings

PERIOD_S = 0.1
SHARED = EstimatorSettings(
    kind="dmhe_shared", window=6, share_inputs="fleet", unknown_inputs="hold", systematic_errors=True, robust=True
)


def residuals(squares: dict[int, float], ranges: dict[tuple[int, int], float] | None = None) -> Residuals:
    """A fix of each agent whose three rows have these normalised squares, and ranges between pairs."""
    tables = [empty_rows(), *(position_rows(0, slot, np.zeros(3), np.ones(3)) for slot in squares)]
    tables += [range_row(0, one, other, 5.0, 0.01) for one, other in (ranges or {})]
    by_pair = list((ranges or {}).values())
    found = np.concatenate([*(np.full(3, square) for square in squares.values()), np.array(by_pair)])
    return Residuals(np.concatenate(tables), found, np.ones(len(found)))


def after(
    monitor: InnovationMonitor,
    ticks: int,
    squares: dict[int, float],
    ranges: dict[tuple[int, int], float] | None = None,
) -> tuple[Finding, ...]:
    for _ in range(ticks):
        found = monitor.observe(residuals(squares, ranges))
    return found


def test_receivers_that_fit_are_not_told_of() -> None:
    rng = np.random.default_rng(1)
    monitor = InnovationMonitor(5, 0, PERIOD_S)
    for _ in range(600):
        assert monitor.observe(residuals({slot: float(rng.chisquare(3) / 3) for slot in range(5)})) == ()
    assert monitor.averages().squares[:, Kind.POSITION] == pytest.approx(np.ones(5), abs=0.6)


def test_one_outlier_is_no_contradiction_however_slow_the_receiver_is() -> None:
    # GIVEN a receiver with a fix a second
    monitor = InnovationMonitor(5, 0, PERIOD_S)
    for second in range(30):
        for tick in range(10):
            square = 1e6 if second == 20 else 1.0
            assert monitor.observe(residuals({0: square} if tick == 0 else {})) == ()


@pytest.mark.parametrize(("slot", "gravity"), [(0, Gravity.ALARM), (3, Gravity.DEGRADED)])
def test_a_receiver_that_stays_off_is_told_of_and_loses_its_weight(slot: int, gravity: Gravity) -> None:
    # GIVEN five drones, one with fixes three sigma off for good
    monitor = InnovationMonitor(5, 0, PERIOD_S)
    fixes = dict.fromkeys(range(5), 1.0) | {slot: 9.0}
    # WHEN they have come for three seconds THEN that is told, the graver for the own one
    [finding] = after(monitor, 30, fixes)
    assert (finding.what, finding.about, finding.gravity) == (What.FIXES_CONTRADICT, slot, gravity)
    assert finding.value is not None
    assert finding.limit is not None
    assert finding.value > finding.limit
    # and its rows are to get no weight
    assert np.flatnonzero(monitor.ignored.receivers).tolist() == [slot]
    # and after ten seconds more the position is taken to be held by the others
    [finding] = after(monitor, 100, fixes)
    assert (finding.what, finding.gravity) == (What.FIXES_IGNORED, Gravity.DEGRADED)
    # and once they agree they count again
    assert after(monitor, 100, dict.fromkeys(range(5), 1.0)) == ()
    assert not monitor.ignored.any()


def test_of_three_drones_nobody_can_tell_whose_receiver_is_wrong() -> None:
    monitor = InnovationMonitor(3, 0, PERIOD_S)
    [finding] = after(monitor, 300, {0: 9.0, 1: 1.0, 2: 1.0})
    assert finding.what is What.FIXES_CONTRADICT
    assert not monitor.ignored.any()


def ignored_pairs(monitor: InnovationMonitor) -> list[list[int]]:
    return np.argwhere(np.triu(monitor.ignored.pairs)).tolist()


def test_ranges_that_stay_off_lose_their_weight_where_fixes_that_fit_hold_both_ends() -> None:
    monitor, good = InnovationMonitor(3, 0, PERIOD_S), dict.fromkeys(range(3), 1.0)
    assert after(monitor, 30, good, {(0, 1): 1.0, (2, 1): 9.0}) == ()
    assert ignored_pairs(monitor) == [[1, 2]]
    assert np.argwhere(monitor.averages().ignored_pairs).tolist() == [[1, 2], [2, 1]]
    # and once they agree they count again
    after(monitor, 100, good, {(0, 1): 1.0, (2, 1): 1.0})
    assert ignored_pairs(monitor) == []


@pytest.mark.parametrize("fixes", [{0: 1.0, 1: 1.0}, {0: 1.0, 1: 1.0, 2: 9.0}], ids=["no fixes", "fixes off as well"])
def test_ranges_to_a_drone_that_no_fitting_fix_holds_keep_their_weight(fixes: dict[int, float]) -> None:
    monitor = InnovationMonitor(3, 0, PERIOD_S)
    after(monitor, 100, fixes, {(0, 1): 1.0, (1, 2): 8.0})
    assert ignored_pairs(monitor) == []


def test_drones_without_receivers_are_no_witnesses() -> None:
    # GIVEN five drones of which two have no fixes WHEN one of the three receivers is off THEN nobody can tell which
    monitor = InnovationMonitor(5, 0, PERIOD_S)
    [finding] = after(monitor, 100, {0: 9.0, 1: 1.0, 2: 1.0})
    assert finding.what is What.FIXES_CONTRADICT
    assert not monitor.ignored.any()


def test_a_receiver_that_has_stopped_contradicts_nothing_any_more() -> None:
    monitor = InnovationMonitor(3, 0, PERIOD_S)
    assert after(monitor, 100, {0: 9.0, 1: 1.0, 2: 1.0})
    assert after(monitor, 120, {1: 1.0, 2: 1.0}) == ()


def test_averages_are_by_sensor_and_by_pair_and_unknown_where_nothing_came() -> None:
    monitor = InnovationMonitor(3, 0, PERIOD_S)
    for _ in range(200):
        monitor.observe(residuals({0: 2.0}, {(0, 1): 4.0, (2, 0): 6.0}))
    told = monitor.averages()
    assert told.squares[0, [Kind.POSITION, Kind.RANGE]] == pytest.approx([2.0, 5.0], abs=0.1)
    assert told.pairs[0, 1] == told.pairs[1, 0] == pytest.approx(4.0, abs=0.1)
    assert told.pairs[2, 0] == pytest.approx(6.0, abs=0.1)
    assert np.isnan(told.squares[1, Kind.POSITION])
    assert np.isnan(told.pairs[1, 2])


def test_what_is_known_stays_with_its_drone_when_the_fleet_changes() -> None:
    monitor = InnovationMonitor(5, 0, PERIOD_S)
    after(monitor, 100, dict.fromkeys(range(5), 1.0) | {3: 9.0})
    fresh = {6: (np.zeros(6), np.eye(6))}
    monitor.change_members(MemberChange.between(Layout((1, 2, 3, 4, 5)), (2, 3, 4, 5, 6), 2, fresh))
    assert np.flatnonzero(monitor.ignored.receivers).tolist() == [2]
    told = monitor.averages().squares[:, Kind.POSITION]
    assert told[[0, 2]] == pytest.approx([1.0, 9.0], abs=0.4)
    assert np.isnan(told[4])


def spoofed_flight(rate_mps: float, agents: int) -> list[tuple[Estimate, float]]:
    """Hovering drones; after ten seconds the first one's fixes drift off; estimates and errors of its own."""
    rng = np.random.default_rng(2)
    places = np.array([[0, 0, -5], [20, 0, -8], [0, 20, -11], [-15, -10, -4], [10, -20, -9]], float)[:agents]
    prior = np.concatenate([np.concatenate((place, np.zeros(3))) for place in places])
    estimator = make_estimator(SHARED, Layout(tuple(range(1, agents + 1))), 0, prior, np.eye(6 * agents), PERIOD_S)
    found = []
    for tick in range(300):
        off_m = np.array([max(0.0, rate_mps * PERIOD_S * (tick - 100)), 0.0, 0.0])
        tables = [
            position_rows(tick, slot, place + rng.normal(0, 0.4, 3) + (off_m if slot == 0 else 0.0), np.full(3, 0.16))
            for slot, place in enumerate(places)
            if tick % 2 == 0
        ]
        tables += [
            range_row(tick, one, other, float(np.linalg.norm(places[one] - places[other]) + rng.normal(0, 0.1)), 0.01)
            for one in range(agents)
            for other in range(one)
        ]
        inputs = [input_rows(tick - 1, slot, rng.normal(0, 0.05, 3), np.full(3, 0.0025)) for slot in range(agents)]
        estimator.begin(tick, np.concatenate(tables), np.concatenate(inputs))
        estimate = estimator.solve()
        found.append((estimate, float(np.linalg.norm(estimate.mean[position(0)] - places[0]))))
    return found


def test_a_dragged_receiver_is_told_of_in_time_and_moves_its_drone_no_further() -> None:
    # GIVEN five hovering drones of which one is dragged away by 1 m/s for 20 s
    flight = spoofed_flight(1.0, 5)
    # THEN nothing is told before
    assert all(not estimate.findings for estimate, _ in flight[:100])
    # and no estimate that is more than 3 m off while five sigma are less says that it is well
    for estimate, error_m in flight:
        sigma_m = float(np.sqrt(np.trace(estimate.covariance[position(0), position(0)])))
        assert not (error_m > 3.0 and 5.0 * sigma_m <= 3.0 and estimate.status is Status.OK)
    # and it is told as one whose fixes contradict, and the position is held by the others
    first = next(tick for tick, (estimate, _) in enumerate(flight) if estimate.findings)
    assert 100 < first < 180
    assert flight[first][0].status is Status.NOT_OBSERVABLE
    assert flight[-1][1] < 1.0
